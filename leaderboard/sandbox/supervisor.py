"""Supervisor of one run of an entry: enforces limits, captures output, kills leftover processes.

The server forks a supervisor for each run, which forks the worker. The supervisor becomes the
parent of all orphaned descendants of the worker, so none outlives the run.
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
"""Interval [s] of the checks of memory and number of processes."""

OUTPUT_TAIL_SIZE = 4000
"""Number of last bytes of the output that are kept; the rest is only counted."""


@dataclass(frozen=True, kw_only=True)
class LaunchRequest:
    """Request to run an entry: its folder, limits, isolation and visible files."""

    __pydantic_config__ = STRICT

    folder: str
    limits: Limits = field(default_factory=Limits)
    isolation: Literal["namespaces", "process"] = "process"
    bind_mounts: tuple[tuple[str, str], ...] = ()  # folder and the folder that it replaces
    hidden: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RunStatus:
    """Outcome and resource use of a run; `status` is negative for a signal, as in `subprocess`."""

    __pydantic_config__ = STRICT

    outcome: RunOutcome
    status: int = 0
    seconds: float = 0.0
    memory: float = 0.0  # [GiB], peak
    output_size: int = 0  # [bytes]
    output_tail: str = ""


def run(launch: LaunchRequest) -> RunStatus:
    """Fork the worker, wait for its end, and kill the processes that it leaves behind."""
    processes.become_subreaper()
    if launch.isolation == "namespaces":
        namespaces.enter_namespaces()
    output, write_end = os.pipe()
    start = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _run_worker(launch, write_end)
    os.close(write_end)
    for number in (signal.SIGTERM, signal.SIGINT):  # when the server ends or is interrupted
        signal.signal(number, lambda *_: (processes.kill_descendants(), os._exit(1)))
    processes.die_with_parent(signal.SIGTERM)
    monitor = _Monitor(launch.limits, pid, output, start)
    outcome = monitor.wait()
    processes.kill(pid)
    processes.kill_group(pid)
    statuses = processes.kill_descendants()
    if pid not in statuses:
        statuses[pid] = monitor.status or 0
    monitor.drain()
    return RunStatus(
        outcome=outcome,
        status=os.waitstatus_to_exitcode(statuses[pid]),
        seconds=time.monotonic() - start,
        memory=max(monitor.memory, _largest_child()) / GIB,
        output_size=monitor.output_size,
        output_tail=monitor.output_tail.decode(errors="replace"),
    )


class _Monitor:
    """Monitor of a running worker: time, memory, processes and output."""

    def __init__(self, limits: Limits, pid: int, output: int, start: float):
        self.limits, self.pid = limits, pid
        self.end = start + limits.seconds
        self.output_size, self.output_tail, self.memory = 0, b"", 0
        self.status: int | None = None
        self.output: int | None = output
        os.set_blocking(output, False)
        self._pidfd = os.pidfd_open(pid) if hasattr(os, "pidfd_open") else None
        self._next_check = start

    def wait(self) -> RunOutcome:
        """Wait for the worker to exit or to exceed a limit, and return which."""
        while not self._has_ended():
            if (now := time.monotonic()) > self.end:
                return "time"
            if now >= self._next_check:
                self._next_check = now + POLL_INTERVAL
                if (outcome := self._check_limits()) is not None:
                    return outcome
            self._wait_for_output(min(self._next_check, self.end) - now)
        return "exited"

    def drain(self) -> None:
        """Read the rest of the output."""
        while self._read_output():
            pass

    def _has_ended(self) -> bool:
        if self.status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.status = status if pid else None
        return self.status is not None

    def _check_limits(self) -> RunOutcome | None:
        running = processes.descendants(os.getpid())
        used = sum(process.resident for process in running)
        if used > self.limits.memory * GIB and len(running) > 1:
            # the sum counts shared pages several times; the exact value is slow to read
            used = processes.proportional_memory(running)
        self.memory = max(self.memory, used)
        if used > self.limits.memory * GIB:
            return "memory"
        return "processes" if len(running) > self.limits.processes else None

    def _wait_for_output(self, seconds: float) -> None:
        handles = [handle for handle in (self.output, self._pidfd) if handle is not None]
        if self._pidfd is None:  # the end of the worker does not wake `select`: poll it
            seconds = min(seconds, 0.02)
        ready, _, _ = select.select(handles, [], [], max(0.0, seconds))
        if self.output in ready:
            self._read_output()

    def _read_output(self) -> bool:
        """Read printed output; return False if there is none at the moment or no more."""
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
    """Return the peak memory [bytes] of the largest child process that has ended."""
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _run_worker(launch: LaunchRequest, output: int) -> None:
    """Turn this process into the worker and run the entry. Never returns."""
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
            bind_mounts = [(Path(source), Path(target)) for source, target in launch.bind_mounts]
            namespaces.confine(folder, bind_mounts, [Path(path) for path in launch.hidden])
        processes.die_with_parent()
        _set_resource_limits(launch.limits)
        work = folder / "work"
        work.mkdir()
        os.chdir(work)
        environment = worker_environment(work)
        os.environ.clear()
        os.environ.update(environment)
        worker.run(folder)
        sys.stdout.flush()
        sys.stderr.flush()
        status = 0
    except BaseException as error:
        os.write(2, f"{type(error).__name__}: {error}\n".encode())
    finally:
        os._exit(status)


def _set_resource_limits(limits: Limits) -> None:
    """Set the limits that the kernel enforces. Reserved but unused memory does not count."""
    values: Mapping[str, int] = {
        "RLIMIT_CORE": 0,
        "RLIMIT_FSIZE": int(limits.file * GIB),
        "RLIMIT_DATA": int(limits.memory * GIB) + _mapped_memory(),
        "RLIMIT_CPU": int(limits.seconds * max(1, os.cpu_count() or 1)) + 60,
    }
    for name, value in values.items():
        kind = getattr(resource, name)
        _, hard = resource.getrlimit(kind)
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(kind, (value, value))


def _mapped_memory() -> int:
    """Return the writable memory [bytes] that this process had mapped when it was forked."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return GIB
    return 1024 * next((int(x.split()[1]) for x in lines if x.startswith("VmData:")), 0)
