"""Client of the sandbox: sends records to an entry's process and returns checked estimates."""

import dataclasses
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from signal import Signals
from typing import Any, TypeVar

from estimators.api import EstimateError, check_estimate
from leaderboard.evaluation.entry import EntryError, TrainingRun
from leaderboard.sandbox import messages, processes
from leaderboard.sandbox.limits import Limits, worker_environment
from leaderboard.sandbox.messages import Request, Response, TrainingReport
from leaderboard.sandbox.supervisor import LaunchRequest, RunStatus
from road_envs import _numba
from road_envs._atomic_io import TempFolder
from road_envs.config import build
from road_envs.data.record import Profile, Record
from road_envs.vehicle.parameters import VehicleParameters

T = TypeVar("T")

GRACE_PERIOD = 60.0
"""Time [s] after the limit of a run within which the supervisor must report its status."""

STARTUP_TIMEOUT = 300.0
"""Time [s] within which the server must have loaded its libraries."""


class SandboxClient:
    """Runs entries in separate processes, one run at a time; a context manager.

    `hidden` folders look empty to the entries where the platform has namespaces.
    `owns_all_children` states that this process has no children but those of the client, so that
    all remaining ones can be killed.
    """

    def __init__(
        self,
        limits: Limits | None = None,
        hidden: Sequence[Path] = (),
        *,
        owns_all_children: bool = False,
    ):
        self.limits = limits or Limits()
        self.run_status: RunStatus | None = None  # of the last run
        self.hidden = tuple(str(path.resolve()) for path in hidden)
        self._owns_all_children = owns_all_children
        self._temp = TempFolder()
        self._home = self._temp.path
        self._runs = 0
        self._namespaces: bool | None = None
        if owns_all_children:
            processes.become_subreaper()
        self._server = self._start()  # loads its libraries while this process simulates drives

    def __enter__(self) -> "SandboxClient":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()
        self._temp.close()

    @property
    def isolation(self) -> str:
        """Isolation of the entries: "namespaces", or "process" where those are not available."""
        return "namespaces" if self._may_use_namespaces() and self.limits.namespaces else "process"

    def reconstruct(
        self,
        reference: str,
        settings: Mapping[str, Any],
        training: Sequence[tuple[Record, Profile]],
        records: Sequence[Record],
        car: VehicleParameters,
        seeds: Sequence[int],
        cache: str = "",
    ) -> list[TrainingRun]:
        """Run `entry.reconstruct_all` in a worker. Raises EntryError.

        Entries with the same `cache` share their compiled kernels.
        """
        request = Request(
            reference=reference,
            settings=dict(settings),
            seeds=tuple(seeds),
            training=len(training),
            tests=len(records),
            car=dataclasses.asdict(car),
        )

        def training_runs(folder: Path, response: Response) -> list[TrainingRun]:
            reported = [training.seed for training in response.trainings]
            if reported not in ([*seeds], [*seeds[:1]]):
                raise EntryError(
                    f"its response has the training seeds {reported}, requested were {list(seeds)}"
                )
            assert self.run_status is not None
            memory, isolation = self.run_status.memory, self.isolation
            runs = (_read_checked_run(folder, report, records) for report in response.trainings)
            return [
                dataclasses.replace(run, peak_memory=memory, isolation=isolation) for run in runs
            ]

        return self._run(request, training, records, cache, training_runs)

    def describe(self, reference: str, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Run `entries.describe` in a worker, without loading the code here. Raises EntryError."""
        request = Request(reference=reference, settings=dict(settings))
        return self._run(request, [], [], "", lambda folder, response: response.description or {})

    def _run(
        self,
        request: Request,
        training: Sequence[tuple[Record, Profile]],
        records: Sequence[Record],
        cache: str,
        read: Callable[[Path, Response], T],
    ) -> T:
        self._runs += 1
        folder = self._home / str(self._runs)
        try:
            messages.write_request(folder, request, training, records)
            run_status = self.run_status = self._start_run(folder, cache)
            if (failure := _describe_violation(run_status, self.limits)) is not None:
                raise EntryError(failure)
            response = messages.read_response(folder)
            if response is None:
                raise EntryError(_describe_missing_response(run_status))
            if response.failure is not None:
                raise EntryError(response.failure)
            return read(folder, response)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _start_run(self, folder: Path, cache: str) -> RunStatus:
        isolation: Any = self.isolation
        launch = LaunchRequest(
            folder=str(folder.resolve()),
            limits=self.limits,
            isolation=isolation,
            bind_mounts=_private_cache(cache) if isolation == "namespaces" else (),
            hidden=self.hidden,
        )
        begin = time.monotonic()
        try:
            os.write(self._server.stdin.fileno(), _json_line(dataclasses.asdict(launch)))  # type: ignore[union-attr]
            line = self._read_line(self.limits.seconds + GRACE_PERIOD)
            return build(RunStatus, json.loads(line), "run status")
        except (OSError, ValueError):
            status = self._stop()
            self._server = self._start()
            return RunStatus(outcome="supervisor", status=status, seconds=time.monotonic() - begin)

    def _start(self) -> subprocess.Popen[bytes]:
        self._namespaces = None
        with (self._home / "stderr.txt").open("ab") as stderr:
            return subprocess.Popen(
                [sys.executable, "-P", "-m", "leaderboard.sandbox.server"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                env=worker_environment(self._home),
                cwd=self._home,
                start_new_session=True,
            )

    def _may_use_namespaces(self) -> bool:
        """Return whether the kernel grants namespaces, which the first line of the server says."""
        if self._namespaces is None:
            try:
                self._namespaces = bool(json.loads(self._read_line(STARTUP_TIMEOUT))["namespaces"])
            except (OSError, ValueError, KeyError, TypeError) as error:
                log = (self._home / "stderr.txt").read_text(encoding="utf-8", errors="replace")
                raise RuntimeError(f"the sandbox server does not start: {log}") from error
        return self._namespaces

    def _read_line(self, seconds: float) -> bytes:
        """Read the next line from the server. Raises OSError on a timeout or at its end."""
        handle, line = self._server.stdout.fileno(), b""  # type: ignore[union-attr]
        end = time.monotonic() + seconds
        while not line.endswith(b"\n"):
            ready, _, _ = select.select([handle], [], [], max(0.0, end - time.monotonic()))
            text = os.read(handle, 1 << 16) if ready else b""
            if not text:
                raise OSError("no response of the sandbox server")
            line += text
        return line

    def _stop(self) -> int:
        """Stop the server, its supervisors and their workers; return the server's exit status."""
        server = self._server
        for stream in (server.stdin, server.stdout):
            if stream is not None:
                stream.close()
        try:
            status = server.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            processes.kill_group(server.pid)
            status = server.wait()
        if self._owns_all_children:
            processes.kill_descendants()
        return status


def _read_checked_run(
    folder: Path, report: TrainingReport, records: Sequence[Record]
) -> TrainingRun:
    run = messages.read_training_run(folder, report, records)
    for k, (estimate, record) in enumerate(zip(run.estimates, records, strict=True), start=1):
        try:
            check_estimate(estimate, record)
        except EstimateError as error:
            raise EntryError(
                f"test drive {k} of {len(records)}, seed {report.seed}: {error}"
            ) from None
    return run


def _describe_violation(run_status: RunStatus, limits: Limits) -> str | None:
    """Return why a run was stopped from outside, in one sentence; None if it was not."""
    match run_status.outcome:
        case "time":
            return f"stopped after {limits.seconds:g} s, the time limit"
        case "memory":
            return f"stopped for using more than {limits.memory:g} GiB, the memory limit"
        case "processes":
            return f"stopped for having more than {limits.processes} processes, the limit"
        case "supervisor":
            return f"its supervisor was ended by {describe_exit(run_status.status)}"
    return None


def _describe_missing_response(run_status: RunStatus) -> str:
    lines = run_status.output_tail.strip().splitlines()
    last = f"; its last output: {lines[-1].strip()[:200]}" if lines else ""
    return f"its process ended without a response, by {describe_exit(run_status.status)}{last}"


def describe_exit(status: int) -> str:
    """Return the exit status, or the name of the signal, that ended a process."""
    if status >= 0:
        return f"exit status {status}"
    return Signals(-status).name if -status in set(Signals) else f"signal {-status}"


def _private_cache(name: str) -> tuple[tuple[str, str], ...]:
    """Return the bind mount that replaces the kernel cache by one of the entry, () without a name.

    The cache of an entry starts as a copy of the shared one. Neither this process nor other entries
    ever load from it, so an entry cannot inject code through it.
    """
    shared = _numba.CACHE
    if not name or not shared.is_dir():
        return ()
    private = shared.parent / "entries" / shared.name / name
    if not private.is_dir():
        copy = private.with_name(f".{private.name}.{os.getpid()}")
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(shared, copy, dirs_exist_ok=True)
        try:
            os.rename(copy, private)
        except OSError:  # another job was faster
            shutil.rmtree(copy, ignore_errors=True)
    return ((str(private), str(shared)),)


def _json_line(data: Mapping[str, Any]) -> bytes:
    return (json.dumps(data) + "\n").encode()
