"""Processes of this machine: who descends from whom, what they use, and how to end them all.

Linux tells by /proc. Elsewhere a process knows only the group that it started.
"""

import ctypes
import os
import signal
import sys
import time
from pathlib import Path
from typing import NamedTuple

PROC = Path("/proc")
PAGE = os.sysconf("SC_PAGE_SIZE")
LINUX = sys.platform == "linux"
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36

libc = ctypes.CDLL(None, use_errno=True)


class Process(NamedTuple):
    """A process and the memory [bytes] that it holds."""

    pid: int
    parent: int
    resident: int


def die_with_parent(number: signal.Signals = signal.SIGKILL) -> None:
    """Have this process sent a signal when the one that started it ends (Linux)."""
    if LINUX:
        libc.prctl(PR_SET_PDEATHSIG, int(number), 0, 0, 0)


def become_subreaper() -> None:
    """Become the parent of every descendant whose own parent ends (Linux)."""
    if LINUX:
        libc.prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def descendants(root: int) -> list[Process]:
    """Children of `root`, their children and so on; none where /proc does not tell."""
    if not LINUX:
        return []
    children: dict[int, list[Process]] = {}
    for entry in os.scandir(PROC):
        if entry.name.isdigit() and (process := _read_process(int(entry.name))) is not None:
            children.setdefault(process.parent, []).append(process)
    found, front = [], [root]
    while front:
        born = [child for pid in front for child in children.get(pid, ())]
        found += born
        front = [child.pid for child in born]
    return found


def proportional_memory(processes: list[Process]) -> int:
    """Memory [bytes] of some processes, a page that several of them share counted once."""
    return sum(_proportional_memory(process) for process in processes)


def kill_descendants(timeout: float = 10.0) -> dict[int, int]:
    """Kill every descendant of this process and wait for them; their exit statuses by number.

    It has to `become_subreaper`. What still runs after `timeout` [s] cannot be killed by anyone.
    """
    statuses: dict[int, int] = {}
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        for process in descendants(os.getpid()):
            kill(process.pid)
        try:
            while (found := os.waitpid(-1, os.WNOHANG))[0]:
                statuses[found[0]] = found[1]
        except ChildProcessError:
            return statuses
        time.sleep(0.002)
    return statuses


def kill(pid: int) -> None:
    """Kill a process if it is there."""
    try:
        os.kill(pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        pass


def kill_group(pid: int) -> None:
    """Kill the process group that `pid` leads, if it is there."""
    try:
        os.killpg(pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        pass


def _read_process(pid: int) -> Process | None:
    """A process as /proc knows it; None if it has gone or is a zombie."""
    try:
        text = (PROC / str(pid) / "stat").read_text()
    except OSError:
        return None
    fields = text.rpartition(")")[2].split()  # its name, before, may hold anything
    return Process(pid, int(fields[1]), PAGE * int(fields[21]))


def _proportional_memory(process: Process) -> int:
    try:
        text = (PROC / str(process.pid) / "smaps_rollup").read_text()
    except OSError:
        return process.resident
    line = next((line for line in text.splitlines() if line.startswith("Pss:")), "")
    return 1024 * int(line.split()[1]) if line else process.resident
