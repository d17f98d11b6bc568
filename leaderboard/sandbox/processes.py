"""Process trees of this machine: descendants of a process, their memory, and killing them.

Descendants are read from /proc, so only on Linux. Elsewhere only process groups can be killed.
"""

import ctypes
import os
import resource
import signal
import sys
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

PROC = Path("/proc")
PAGE, TICKS = os.sysconf("SC_PAGE_SIZE"), os.sysconf("SC_CLK_TCK")
LINUX = sys.platform == "linux"
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36

INODE = 1024  # memory [bytes] that an empty file takes up
libc = ctypes.CDLL(None, use_errno=True)


class _Process(NamedTuple):
    """A process: its parent, resident memory [bytes] and processor time [s].

    The processor time is that of all its threads and of the ended children that it has waited for.
    """

    pid: int
    parent: int
    resident: int
    cpu: float


def die_with_parent() -> None:
    """Let the kernel kill this process when its parent ends (Linux only)."""
    if LINUX:
        libc.prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)


def become_subreaper() -> None:
    """Become the parent of every descendant whose own parent ends (Linux only)."""
    if LINUX:
        libc.prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def tree(root: int) -> list[_Process]:
    """Return `root` and all its descendants, level by level; [] where there is no /proc."""
    if not LINUX:
        return []
    children: dict[int, list[_Process]] = {}
    result: list[_Process] = []
    for entry in os.scandir(PROC):
        with suppress(OSError):  # it may have ended
            if entry.name.isdigit():
                text = (PROC / entry.name / "stat").read_bytes()
                fields = text.rpartition(b")")[2].split()  # the name in brackets may be any bytes
                cpu, memory = sum(map(int, fields[11:15])) / TICKS, PAGE * int(fields[21])
                process = _Process(int(entry.name), int(fields[1]), memory, cpu)
                children.setdefault(process.parent, []).append(process)
                result += [process] if process.pid == root else []
    level = [root]
    while level:
        below = [child for pid in level for child in children.get(pid, ())]
        result += below
        level = [child.pid for child in below]
    return result


def memory_of_files(pid: int, folders: Iterable[Path]) -> int:
    """Return the memory [bytes] of the inodes of file systems in memory, mounted for a process."""
    with suppress(OSError):
        found = [os.statvfs(f"{PROC}/{pid}/root{folder}") for folder in folders]
        return INODE * sum(x.f_files - x.f_ffree for x in found)
    return 0


def set_limits(pid: int, values: Mapping[str, int]) -> None:
    """Set limits of a process that the kernel enforces, by their names in `resource`.

    That of its writable memory is beyond what it has mapped. Nothing is set if it has ended. Where
    the memory of the machine runs short, such a process is ended first.
    """
    with suppress(OSError):
        (PROC / str(pid) / "oom_score_adj").write_text("1000")
    mapped = size_of(pid, "status", "VmData") or 2**30
    for name, value in values.items():
        kind = getattr(resource, name)
        with suppress(ProcessLookupError):
            _, hard = resource.prlimit(pid, kind)
            value += mapped if name == "RLIMIT_DATA" else 0
            value = value if hard == resource.RLIM_INFINITY else min(value, hard)
            resource.prlimit(pid, kind, (value, value))


def size_of(pid: int, file: str, name: str) -> int:
    """Return a size [bytes] from a file of /proc; 0 if the process no longer exists."""
    try:
        lines = (PROC / str(pid) / file).read_bytes().splitlines()
    except OSError:
        return 0
    return 1024 * next((int(x.split()[1]) for x in lines if x.startswith(f"{name}:".encode())), 0)


def kill_descendants(timeout: float = 10.0) -> None:
    """Kill all descendants of this process, which must have called `become_subreaper`, and wait."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        for process in tree(os.getpid())[1:]:
            kill(process.pid)
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        time.sleep(0.002)


def kill(pid: int) -> None:
    """Kill a process if it exists, or with a negative number the process group of its leader."""
    with suppress(ProcessLookupError, PermissionError):
        os.kill(pid, signal.SIGKILL)
