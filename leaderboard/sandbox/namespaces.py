"""Linux namespaces of an entry: no network, no other processes, write access to its folder only.

The supervisor enters new user, process, network and IPC namespaces (`enter_namespaces`); the
worker, its child, enters a new mount namespace and drops all privileges (`confine`). See
namespaces(7), mount_setattr(2) and capabilities(7). Only libc is needed.
"""

import ctypes
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from leaderboard.sandbox.processes import libc

NEW_MOUNTS, NEW_IPC, NEW_USERS, NEW_PIDS, NEW_NETWORK = (
    0x00020000, 0x08000000, 0x10000000, 0x20000000, 0x40000000,
)  # fmt: skip
BIND, RECURSIVE, PRIVATE = 4096, 16384, 1 << 18
NO_SUID, NO_DEV, NO_EXEC = 2, 4, 8
SYS_MOUNT_SETATTR, AT_FDCWD, AT_RECURSIVE, ATTR_RDONLY = 442, -100, 0x8000, 1
PR_CAPBSET_DROP, PR_SET_NO_NEW_PRIVS, LAST_CAPABILITY = 24, 38, 63
CAPABILITY_VERSION_3 = 0x20080522


class _MountAttributes(ctypes.Structure):
    _fields_ = tuple(
        (name, ctypes.c_uint64) for name in ("attr_set", "attr_clr", "propagation", "userns_fd")
    )


def available() -> bool:
    """Return whether the kernel grants namespaces to this process, by trying in a child."""
    if sys.platform != "linux":
        return False
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            enter_namespaces()
            worker = os.fork()
            if worker == 0:
                confine(None, [], [])
                os._exit(0)
            status = os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1])
        except OSError:
            pass
        finally:
            os._exit(status != 0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def enter_namespaces() -> None:
    """Enter new user, network, IPC and (for children) PID namespaces. Raises OSError."""
    user, group = os.geteuid(), os.getegid()
    flags = NEW_USERS | NEW_PIDS | NEW_NETWORK | NEW_IPC
    _raise_on_error(libc.unshare(ctypes.c_int(flags)), "unshare")
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/uid_map").write_text(f"{user} {user} 1")
    Path("/proc/self/gid_map").write_text(f"{group} {group} 1")


def confine(
    folder: Path | None, bind_mounts: Sequence[tuple[Path, Path]], hidden: Sequence[Path]
) -> None:
    """Make all files read-only but those in `folder` and `bind_mounts`, and drop all privileges.

    Each pair in `bind_mounts` mounts the first folder over the second; `hidden` folders look
    empty. Raises OSError.
    """
    _raise_on_error(libc.unshare(ctypes.c_int(NEW_MOUNTS)), "unshare")
    _mount("none", "/", "", RECURSIVE | PRIVATE)
    shared_memory = Path("/dev/shm")
    writable = [shared_memory, *(target for _, target in bind_mounts)]
    if folder is not None:
        _mount(folder, folder, "", BIND)
        writable.append(folder)
    for source, target in bind_mounts:
        _mount(source, target, "", BIND)
    for target in hidden:
        _mount("tmpfs", target, "tmpfs", NO_SUID | NO_DEV | NO_EXEC, "size=4k")
    if shared_memory.is_dir():
        _mount("tmpfs", shared_memory, "tmpfs", NO_SUID | NO_DEV, "size=256m")
    _set_mount_attributes(Path("/"), AT_RECURSIVE, set_=ATTR_RDONLY)
    for target in filter(Path.is_dir, writable):
        _set_mount_attributes(target, 0, clear=ATTR_RDONLY)
    try:
        _mount("proc", "/proc", "proc", NO_SUID | NO_DEV | NO_EXEC)
    except OSError:  # refused where /proc is masked; its process numbers are of no use here then
        pass
    _drop_privileges()


def _drop_privileges() -> None:
    for capability in range(LAST_CAPABILITY + 1):
        libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)  # an error above the kernel's last
    _raise_on_error(libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), "prctl")
    header = (ctypes.c_uint32 * 2)(CAPABILITY_VERSION_3, 0)
    _raise_on_error(libc.capset(header, (ctypes.c_uint32 * 6)()), "capset")


def _mount(source: object, target: object, kind: str, flags: int, data: str = "") -> None:
    words = [os.fsencode(str(word)) for word in (source, target, kind, data)]
    status = libc.mount(words[0], words[1], words[2], ctypes.c_ulong(flags), words[3])
    _raise_on_error(status, f"mount {target}")


def _set_mount_attributes(target: Path, flags: int, set_: int = 0, clear: int = 0) -> None:
    attributes = _MountAttributes(set_, clear, 0, 0)
    status = libc.syscall(
        ctypes.c_long(SYS_MOUNT_SETATTR),
        ctypes.c_int(AT_FDCWD),
        os.fsencode(target),
        ctypes.c_uint(flags),
        ctypes.byref(attributes),
        ctypes.c_size_t(ctypes.sizeof(attributes)),
    )
    _raise_on_error(status, f"mount_setattr {target}")


def _raise_on_error(status: int, what: str) -> None:
    if status != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")
