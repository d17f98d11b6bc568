"""Watches one run of an entry: time, memory, processes, output; ends all of it when it is over.

The guard is forked from the server for each run and forks the guest. It becomes the parent of
whatever the guest leaves behind, so nothing outlives it.
"""

import os
import resource
import select
import signal
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from leaderboard.sandbox import namespaces, processes, worker
from leaderboard.sandbox.limits import GIB, Limits, worker_environment
from road_envs.config import STRICT

RunOutcome = Literal["exited", "time", "memory", "processes", "supervisor"]

POLL_INTERVAL = 0.1
"""Seconds between two looks at memory and processes."""

OUTPUT_TAIL_SIZE = 4000
"""Bytes of output that are kept, the last ones; the rest is counted and thrown away."""


@dataclass(frozen=True, kw_only=True)
class LaunchRequest:
    """One run: where, how limited, and what it must not see."""

    __pydantic_config__ = STRICT

    folder: str
    limits: Limits = field(default_factory=Limits)
    isolation: Literal["namespaces", "process"] = "process"
    private: tuple[tuple[str, str], ...] = ()  # folders that stand in for others
    hidden: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RunStatus:
    """How a run went; `status` as of `subprocess`: below 0 the signal that ended it."""

    __pydantic_config__ = STRICT

    outcome: RunOutcome
    status: int = 0
    seconds: float = 0.0
    memory: float = 0.0  # [GiB] at its peak
    output_size: int = 0  # bytes
    output_tail: str = ""


def run(launch: LaunchRequest) -> RunStatus:
    """Fork the guest, watch it to its end, and end what it leaves behind."""
    processes.become_subreaper()
    if launch.isolation == "namespaces":
        namespaces.enter_namespaces()
    output, written = os.pipe()
    start = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _run_worker(launch, written)
    os.close(written)
    for number in (signal.SIGTERM, signal.SIGINT):  # when the server ends, or is told to
        signal.signal(number, lambda *_: (processes.kill_descendants(), os._exit(1)))
    processes.die_with_parent(signal.SIGTERM)
    watch = _Monitor(launch.limits, pid, output, start)
    outcome = watch.wait()
    processes.kill(pid)
    processes.kill_group(pid)
    statuses = processes.kill_descendants()
    if pid not in statuses:
        statuses[pid] = watch.status or 0
    watch.drain()
    return RunStatus(
        outcome=outcome,
        status=os.waitstatus_to_exitcode(statuses[pid]),
        seconds=time.monotonic() - start,
        memory=max(watch.memory, _largest_child()) / GIB,
        output_size=watch.output_size,
        output_tail=watch.output_tail.decode(errors="replace"),
    )


class _Monitor:
    """What is seen of a guest while it runs."""

    def __init__(self, limits: Limits, pid: int, output: int, start: float):
        self.limits, self.pid = limits, pid
        self.end = start + limits.seconds
        self.output_size, self.output_tail, self.memory = 0, b"", 0
        self.status: int | None = None
        self.output: int | None = output
        os.set_blocking(output, False)
        self._life = os.pidfd_open(pid) if hasattr(os, "pidfd_open") else None
        self._next_look = start

    def wait(self) -> RunOutcome:
        """Wait for the guest; a limit that it passes ends the wait."""
        while not self._has_ended():
            if (now := time.monotonic()) > self.end:
                return "time"
            if now >= self._next_look:
                self._next_look = now + POLL_INTERVAL
                if (outcome := self._check_limits()) is not None:
                    return outcome
            self._wait_for_output(min(self._next_look, self.end) - now)
        return "exited"

    def drain(self) -> None:
        """Read what is left of the output, for as long as nobody keeps it coming."""
        while self._read_output():
            pass

    def _has_ended(self) -> bool:
        if self.status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.status = status if pid else None
        return self.status is not None

    def _check_limits(self) -> RunOutcome | None:
        found = processes.descendants(os.getpid())
        held = sum(process.resident for process in found)
        if held > self.limits.memory * GIB and len(found) > 1:
            held = processes.proportional_memory(found)
        self.memory = max(self.memory, held)
        if held > self.limits.memory * GIB:
            return "memory"
        return "processes" if len(found) > self.limits.processes else None

    def _wait_for_output(self, seconds: float) -> None:
        waited = [handle for handle in (self.output, self._life) if handle is not None]
        if self._life is None:
            seconds = min(seconds, 0.02)
        ready, _, _ = select.select(waited, [], [], max(0.0, seconds))
        if self.output in ready:
            self._read_output()

    def _read_output(self) -> bool:
        """Take what was printed; False if there is nothing at the moment, or will be no more."""
        if self.output is None:
            return False
        try:
            text = os.read(self.output, 1 << 20)
        except BlockingIOError:
            return False
        if not text:
            self.output = None
        self.output_size += len(text)
        self.output_tail = (self.output_tail + text)[-OUTPUT_TAIL_SIZE:]
        return bool(text)


def _largest_child() -> int:
    """Peak memory [bytes] of the largest process that was waited for."""
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _run_worker(launch: LaunchRequest, output: int) -> None:
    """From here on this process is the entry's. Never returns."""
    status = 1
    try:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.closerange(3, resource.getrlimit(resource.RLIMIT_NOFILE)[0])
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_DFL)
        folder = Path(launch.folder)
        if launch.isolation == "namespaces":
            private = [(Path(a), Path(b)) for a, b in launch.private]
            namespaces.confine(folder, private, [Path(place) for place in launch.hidden])
        processes.die_with_parent()
        _set_resource_limits(launch.limits)
        work = folder / "work"
        work.mkdir()
        os.chdir(work)
        given = worker_environment(work)
        os.environ.clear()
        os.environ.update(given)
        worker.run(folder)
        sys.stdout.flush()
        sys.stderr.flush()
        status = 0
    except BaseException as error:
        os.write(2, f"{type(error).__name__}: {error}\n".encode())
    finally:
        os._exit(status)


def _set_resource_limits(limits: Limits) -> None:
    """What the kernel itself refuses. Memory that is only reserved does not count."""
    wanted: Mapping[str, int] = {
        "RLIMIT_CORE": 0,
        "RLIMIT_FSIZE": int(limits.file * GIB),
        "RLIMIT_DATA": int(limits.memory * GIB) + _mapped_memory(),
        "RLIMIT_CPU": int(limits.seconds * max(1, os.cpu_count() or 1)) + 60,
    }
    for name, value in wanted.items():
        kind = getattr(resource, name)
        _, most = resource.getrlimit(kind)
        value = value if most == resource.RLIM_INFINITY else min(value, most)
        resource.setrlimit(kind, (value, value))


def _mapped_memory() -> int:
    """Writable memory [bytes] that this process had already mapped when it was forked."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return GIB
    return 1024 * next((int(x.split()[1]) for x in lines if x.startswith("VmData:")), 0)
