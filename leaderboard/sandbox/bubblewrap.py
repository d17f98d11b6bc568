"""The container of a guest: the command line of bubblewrap (bwrap, version 0.8 or newer).

The guest sees the interpreter, its packages, this project's packages and the code of its entry,
all read-only; an empty folder in memory of its own; a bare /dev and a /proc with nothing but
itself. It has no network, no capabilities, no other user's processes and no Unix sockets of the
host. It ends with the process that started it.

Code from outside runs behind a filter of system calls (`seccomp`). A host that is root starts the
guest as root without capabilities but those to become another user, which `worker` uses before it
loads the entry: each guest has a user of its own. Any other host uses a user namespace.
"""

import fcntl
import importlib.util
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from threading import Timer
from types import MappingProxyType

from leaderboard.sandbox import seccomp
from leaderboard.sandbox.limits import GIB, Limits
from road_envs.core.code_digest import PACKAGES, ROOT, cache_home
from road_envs.core.config import ConfigError

HOME = Path("/tmp/guest")  # working folder of a guest
IN_MEMORY = (HOME, Path("/dev/shm"))  # folders that a guest can write to
ENTRY = Path("/entry")  # folder with the code of the entry
SHARED_CACHE = Path("/shared-cache")  # compiled kernels, for a guest that must not write there
NOBODY = 65534  # user and group of a guest in a user namespace

GUEST_USERS = ((0x70000000, 2**28), (61184, 4335))
"""First number and count of users that nobody has, of whom a host that is root chooses one for a
guest; the second range is for hosts in a namespace of few users.
"""

SYSTEM = ("/lib", "/lib32", "/lib64", "/bin", "/etc/ld.so.cache", "/etc/alternatives")
"""Paths of the operating system that programs need, beside PARTS of /usr and /usr/local."""

PARTS = ("bin", "include", "lib", "lib32", "lib64", "libexec", "share", "pyvenv.cfg")
"""What a guest sees below a prefix where programs are installed: results may lie in /usr/src."""

COUNTERS = tuple(Path("/proc", name) for name in (
    "stat", "vmstat", "diskstats", "loadavg", "interrupts", "softirqs", "schedstat", "zoneinfo",
    "buddyinfo", "slabinfo", "pagetypeinfo", "timer_list", "locks", "vmallocinfo", "uptime",
    "sys/fs/dentry-state", "sys/fs/inode-nr", "sys/fs/inode-state", "sys/fs/file-nr",
    "sys/fs/aio-nr", "sys/fs/quota", "sys/kernel/pty/nr", "crypto", "kallsyms", "modules",
    "meminfo", "acpi", "bus", "driver", "fs", "irq", "pressure", "scsi", "tty", "/dev/zero",
))  # fmt: skip
"""Files and folders with counts of the machine, such as the look-ups of a file system, by which one
guest could tell another a number: empty. A shared mapping of /dev/zero is memory of no process."""

BATCH, FEWEST, MOST = 2**10, 2**17, 2**24
"""Numbers of pipes that a processor takes at once; the fewest and most that hide others."""

SHARED_MEMORY = 2**28  # size [bytes] of a guest's /dev/shm


@contextmanager
def command(
    words: Sequence[str],
    environment: Mapping[str, str],
    limits: Limits,
    *,
    user: int | None,
    from_outside: bool,
    read_only: Mapping[Path, Path] = MappingProxyType({}),
    writable: Mapping[Path, Path] = MappingProxyType({}),
) -> Iterator[tuple[list[str], list[int]]]:
    """Return the command line of the container that runs `words`, and open files to be inherited.

    The mappings name the folders and files that it sees, by their path on the host. The guest may
    become `user`; what is `from_outside` runs behind the filter of system calls.
    """
    program = seccomp.program() if from_outside else None
    mounts = {**_system_mounts(), **read_only}
    parents = {
        parent for target in [*mounts.values(), *writable.values()] for parent in target.parents
    }
    line = [shutil.which("bwrap") or "bwrap", *_privileges(user is not None)]
    line += ["--die-with-parent", "--new-session"]
    for parent in sorted(parents | {HOME.parent}, key=lambda path: len(path.parts))[1:]:
        line += ["--perms", "0755", "--dir", str(parent)]  # else hidden from nobody
    for source, target in mounts.items():
        if source.is_symlink() and source == target:
            line += ["--symlink", os.readlink(source), str(target)]
        else:
            line += ["--ro-bind", str(source), str(target)]
    line += ["--proc", "/proc", "--dev", "/dev"]
    for path in filter(Path.exists, COUNTERS):
        folder = ["--tmpfs", str(path), "--remount-ro", str(path)]
        line += folder if path.is_dir() else ["--ro-bind", os.devnull, str(path)]
    for path, size in zip(IN_MEMORY, (int(limits.file * GIB), SHARED_MEMORY), strict=True):
        line += ["--perms", "1777", "--size", str(size), "--tmpfs", str(path)]
    for source, target in writable.items():
        line += ["--bind", str(source), str(target)]
    line += ["--remount-ro", "/dev", "--remount-ro", "/", "--chdir", str(HOME), "--clearenv"]
    for name, value in environment.items():
        line += ["--setenv", name, value]
    with tempfile.TemporaryFile() as file:
        file.write(program or b"")
        file.seek(0)
        handles = [] if program is None else [file.fileno()]
        for handle in handles:
            line += ["--seccomp", str(handle)]
        yield [*line, "--", *words], handles


@cache
def obstacle() -> str | None:
    """Return why bubblewrap cannot be used here, None if it can, by running a program in it."""
    if shutil.which("bwrap") is None:
        return "bubblewrap is not installed (the program bwrap)"
    numpy = importlib.util.find_spec("numpy")
    needed = [str(ROOT / "estimators" / "__init__.py"), numpy and numpy.origin]
    user = guest_user()
    become = "" if user is None else f"import os; os.setuid({user}); "
    code = f"{become}import socket; [open(path).close() for path in {needed}]"
    words = [sys.executable, "-S", "-c", code]
    try:
        with command(words, {}, Limits(), user=user, from_outside=True) as (line, handles):
            ended = subprocess.run(
                line, capture_output=True, errors="replace", timeout=30.0, pass_fds=handles
            )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"bubblewrap cannot be started: {error}"
    reason = " ".join(ended.stderr.split())[-200:]
    return None if ended.returncode == 0 else f"bubblewrap is refused here: {reason}"


def is_used(isolation: str) -> bool:
    """Return whether guests run in bubblewrap. Raises ConfigError if they have to and cannot."""
    if isolation == "bubblewrap" and (reason := obstacle()) is not None:
        raise ConfigError(f"{reason}; install it, or choose the isolation process")
    return isolation != "process" and obstacle() is None


@contextmanager
def alone() -> Iterator[None]:
    """Wait until no other process of this machine is in this context, and stay in it.

    A guest that runs beside two others keeps what the first has told it for the second: files that
    it has mapped are not dropped. Where the file system has no locks, nothing is waited for. A wait
    of more than a second is told on standard error.
    """
    words = "waiting for the guest of another run on this machine, beside which none is started"
    told = Timer(1.0, print, [words], {"file": sys.stderr, "flush": True})
    with open(shutil.which("bwrap") or os.devnull, "rb") as file:
        told.start()
        try:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)
        finally:
            told.cancel()
        yield


def forget_guests(before: int) -> int:
    """Drop what guests have left since the count of pipes was `before`; return the count."""
    forget_pipes(before)
    forget_reads([cache_home()])
    return count_pipes()


def forget_reads(more: Iterable[Path] = ()) -> None:
    """Drop what guests have read from the memory of the machine: files that they see, and `more`.

    A guest could tell from the time of a read which files another one has read, 0.5 % of a thousand
    excepted, and from that of a look-up which names it has looked up in vain: only root can drop
    those. What a running process has mapped stays. Names of files are all in memory afterwards.
    """
    with suppress(OSError):
        Path("/proc/sys/vm/drop_caches").write_text("2")  # of names, not of what files contain
    left = [str(path) for path in (*_system_mounts(), *more)]
    while left:
        with suppress(OSError), os.scandir(left.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    left.append(entry.path)
                elif entry.is_file(follow_symlinks=False):
                    with suppress(OSError), open(entry.path, "rb", buffering=0) as file:
                        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def count_pipes() -> int:
    """Return the largest number that the kernel now gives a pipe; each processor has a batch."""
    return max(next(_open_pipes(cpu, 1)) for cpu in os.sched_getaffinity(0))


def forget_pipes(before: int) -> None:
    """Open pipes, a random number on each processor, since guests read the numbers of their own.

    `before` is the count before a guest: up to four times as many as since are opened, FEWEST to
    MOST. Their order of magnitude remains, one or two bits. Sockets have numbers of the same count.
    """
    hiding = max(FEWEST, min(4 * (count_pipes() - before), MOST))
    for cpu in sorted(os.sched_getaffinity(0)):
        for _ in _open_pipes(cpu, BATCH + secrets.randbelow(BATCH + hiding)):
            pass
        hiding = 0  # the first one takes from the count of all


def _open_pipes(cpu: int, count: int) -> Iterator[int]:
    """Open and close pipes on a processor; yield their numbers."""
    allowed = os.sched_getaffinity(0)
    with suppress(OSError):  # it may have been taken away meanwhile
        os.sched_setaffinity(0, {cpu})
    try:
        for _ in range(count):
            ends = os.pipe()
            number = os.fstat(ends[0]).st_ino
            for end in ends:
                os.close(end)
            yield number
    finally:
        os.sched_setaffinity(0, allowed)


def is_root() -> bool:
    """Return whether a guest with code from outside has to give up the user of the host."""
    return os.geteuid() == 0


def guest_user() -> int | None:
    """Return a user and group for a new guest with code from outside; None if it has no choice."""
    if not is_root():
        return None
    lines = Path("/proc/self/uid_map").read_text(encoding="ascii").splitlines()
    mapped = [range(int(x[0]), int(x[0]) + int(x[2])) for x in map(str.split, lines)]
    for first, count in GUEST_USERS:
        if any(first in users and first + count - 1 in users for users in mapped):
            return first + secrets.randbelow(count)
    return NOBODY


def _privileges(becomes_another: bool) -> list[str]:
    if is_root():
        words = ["--unshare-ipc", "--unshare-pid", "--unshare-net", "--unshare-uts"]
        words += ["--unshare-cgroup-try", "--cap-drop", "ALL"]
        if becomes_another:
            words += ["--cap-add", "CAP_SETUID", "--cap-add", "CAP_SETGID"]
        return words
    identity = ["--uid", str(NOBODY), "--gid", str(NOBODY)]
    return ["--unshare-all", "--unshare-user", "--disable-userns", *identity]


def _system_mounts() -> dict[Path, Path]:
    """Return what every guest sees: system libraries, interpreter, packages, this project."""
    words = os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    prefixes = (sys.base_prefix, sys.base_exec_prefix, sys.prefix, sys.exec_prefix)
    wanted = [
        *map(Path, SYSTEM),
        *(Path(x, part) for x in ("/usr", "/usr/local", *prefixes) for part in PARTS),
        *(Path(p) for p in sys.path if Path(p).name in ("site-packages", "dist-packages")),
        *(ROOT / name for name in (*PACKAGES, "configs")),
        *(Path(word) for word in words if word.startswith("/")),
        Path(sys.executable),
    ]
    mounts: list[Path] = []
    paths = [Path(os.path.abspath(path)) for path in wanted]
    paths += [path.resolve() for path in paths]  # an environment may be reached by a link
    for path in sorted(dict.fromkeys(paths), key=lambda path: len(path.parts)):
        if path.exists() and not any(path.is_relative_to(mount) for mount in mounts):
            mounts.append(path)
    return {path: path for path in mounts}
