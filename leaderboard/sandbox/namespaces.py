"""Linux namespaces for an entry: no network, no other process, nothing to write but its folder.

The supervisor leaves the evaluator's users, processes, network and System V objects
(`enter_namespaces`); the worker, its child, leaves the evaluator's mounts and drops every privilege
(`confine`). See namespaces(7),
mount_setattr(2) and capabilities(7). No step needs a program or a library beyond libc.
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
    """Whether this process may have namespaces, found by trying in a child."""
    if sys.platform != "linux":
        return False
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            enter_namespaces()
            guest = os.fork()
            if guest == 0:
                confine(None, [], [])
                os._exit(0)
            status = os.waitstatus_to_exitcode(os.waitpid(guest, 0)[1])
        except OSError:
            pass
        finally:
            os._exit(status != 0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def enter_namespaces() -> None:
    """New users, and for children new process numbers, network and IPC. Raises OSError."""
    user, group = os.geteuid(), os.getegid()
    flags = NEW_USERS | NEW_PIDS | NEW_NETWORK | NEW_IPC
    _raise_on_error(libc.unshare(ctypes.c_int(flags)), "unshare")
    Path("/proc/self/setgroups").write_text("deny")
    Path("/proc/self/uid_map").write_text(f"{user} {user} 1")
    Path("/proc/self/gid_map").write_text(f"{group} {group} 1")


def confine(
    folder: Path | None, private: Sequence[tuple[Path, Path]], hidden: Sequence[Path]
) -> None:
    """Nothing can be written any more but in `folder` and in what stands in for other folders.

    Of each pair in `private` the first folder is put in the place of the second; `hidden` folders
    look empty. Raises OSError.
    """
    _raise_on_error(libc.unshare(ctypes.c_int(NEW_MOUNTS)), "unshare")
    _mount("none", "/", "", RECURSIVE | PRIVATE)
    open_to = [Path("/dev/shm"), *(place for _, place in private)]
    if folder is not None:
        _mount(folder, folder, "", BIND)
        open_to.append(folder)
    for source, place in private:
        _mount(source, place, "", BIND)
    for place in hidden:
        _mount("tmpfs", place, "tmpfs", NO_SUID | NO_DEV | NO_EXEC, "size=4k")
    if open_to[0].is_dir():
        _mount("tmpfs", open_to[0], "tmpfs", NO_SUID | NO_DEV, "size=256m")
    _set_mount_attributes(Path("/"), AT_RECURSIVE, set_=ATTR_RDONLY)
    for place in filter(Path.is_dir, open_to):
        _set_mount_attributes(place, 0, clear=ATTR_RDONLY)
    try:
        _mount("proc", "/proc", "proc", NO_SUID | NO_DEV | NO_EXEC)
    except OSError:  # refused where the judge's own /proc is masked; its numbers lead nowhere then
        pass
    _drop_privileges()


def _drop_privileges() -> None:
    for capability in range(LAST_CAPABILITY + 1):
        libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)  # beyond the kernel's last one: an error
    _raise_on_error(libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), "prctl")
    header = (ctypes.c_uint32 * 2)(CAPABILITY_VERSION_3, 0)
    _raise_on_error(libc.capset(header, (ctypes.c_uint32 * 6)()), "capset")


def _mount(source: object, place: object, kind: str, flags: int, data: str = "") -> None:
    words = [os.fsencode(str(word)) for word in (source, place, kind, data)]
    done = libc.mount(words[0], words[1], words[2], ctypes.c_ulong(flags), words[3])
    _raise_on_error(done, f"mount {place}")


def _set_mount_attributes(place: Path, flags: int, set_: int = 0, clear: int = 0) -> None:
    attributes = _MountAttributes(set_, clear, 0, 0)
    done = libc.syscall(
        ctypes.c_long(SYS_MOUNT_SETATTR),
        ctypes.c_int(AT_FDCWD),
        os.fsencode(place),
        ctypes.c_uint(flags),
        ctypes.byref(attributes),
        ctypes.c_size_t(ctypes.sizeof(attributes)),
    )
    _raise_on_error(done, f"mount_setattr {place}")


def _raise_on_error(status: int, what: str) -> None:
    if status != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")
