"""The judge's side of the border: records go out to an entry, what can be trusted comes back."""

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
"""Seconds after a time limit in which the guard must have given its verdict."""

STARTUP_TIMEOUT = 300.0
"""Seconds in which the server must have loaded its libraries."""


class SandboxClient:
    """Runs entries in processes of their own, one run at a time; closed by a `with` statement.

    `hidden` folders are kept from the entries where the platform can. `alone` says that this
    process has no children but those of the host, so that all that are left may be ended.
    """

    def __init__(
        self, limits: Limits | None = None, hidden: Sequence[Path] = (), *, alone: bool = False
    ):
        self.limits = limits or Limits()
        self.run_status: RunStatus | None = None  # on the last run
        self.hidden = tuple(str(path.resolve()) for path in hidden)
        self._alone = alone
        self._scratch = TempFolder()
        self._home = self._scratch.path
        self._runs = 0
        self._namespaces: bool | None = None
        if alone:
            processes.become_subreaper()
        self._server = self._start()  # it loads its libraries while the judge drives

    def __enter__(self) -> "SandboxClient":
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()
        self._scratch.close()

    @property
    def isolation(self) -> str:
        """What keeps entries in: "namespaces", or "process" where those are not to be had."""
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
        """As `entry.reconstruct_all`, of an estimator made from `reference`. Raises EntryError.

        Entries of one `cache` share their compiled kernels.
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
            ran = [told.seed for told in response.trainings]
            if ran not in ([*seeds], [*seeds[:1]]):
                raise EntryError(f"it ran the training seeds {ran} and not {list(seeds)}")
            assert self.run_status is not None
            memory, isolation = self.run_status.memory, self.isolation
            found = (_read_checked_run(folder, told, records) for told in response.trainings)
            return [
                dataclasses.replace(outcome, peak_memory=memory, isolation=isolation)
                for outcome in found
            ]

        return self._run(request, training, records, cache, training_runs)

    def describe(self, reference: str, settings: Mapping[str, Any]) -> dict[str, Any]:
        """As `entries.describe`, of an estimator that the judge never loads. Raises EntryError."""
        request = Request(reference=reference, settings=dict(settings))
        return self._run(request, [], [], "", lambda folder, response: response.description or {})

    def _run(
        self,
        request: Request,
        training: Sequence[tuple[Record, Profile]],
        records: Sequence[Record],
        cache: str,
        take: Callable[[Path, Response], T],
    ) -> T:
        self._runs += 1
        folder = self._home / str(self._runs)
        try:
            messages.write_request(folder, request, training, records)
            run_status = self.run_status = self._start_run(folder, cache)
            if (why := _describe_violation(run_status, self.limits)) is not None:
                raise EntryError(why)
            response = messages.read_response(folder)
            if response is None:
                raise EntryError(_describe_missing_response(run_status))
            if response.failure is not None:
                raise EntryError(response.failure)
            return take(folder, response)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _start_run(self, folder: Path, cache: str) -> RunStatus:
        isolation: Any = self.isolation
        launch = LaunchRequest(
            folder=str(folder.resolve()),
            limits=self.limits,
            isolation=isolation,
            private=_private_cache(cache) if isolation == "namespaces" else (),
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
            spent = time.monotonic() - begin
            return RunStatus(outcome="supervisor", status=status, seconds=spent)

    def _start(self) -> subprocess.Popen[bytes]:
        self._namespaces = None
        with (self._home / "said.txt").open("ab") as said:
            return subprocess.Popen(
                [sys.executable, "-P", "-m", "leaderboard.sandbox.server"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=said,
                env=worker_environment(self._home),
                cwd=self._home,
                start_new_session=True,
            )

    def _may_use_namespaces(self) -> bool:
        """Whether the server may have namespaces, which is the first thing that it says."""
        if self._namespaces is None:
            try:
                self._namespaces = bool(json.loads(self._read_line(STARTUP_TIMEOUT))["namespaces"])
            except (OSError, ValueError, KeyError, TypeError) as error:
                said = (self._home / "said.txt").read_text(encoding="utf-8", errors="replace")
                raise RuntimeError(f"the server of entries does not start: {said}") from error
        return self._namespaces

    def _read_line(self, seconds: float) -> bytes:
        """The next line that the server says. Raises OSError if it says none in time."""
        handle, said = self._server.stdout.fileno(), b""  # type: ignore[union-attr]
        end = time.monotonic() + seconds
        while not said.endswith(b"\n"):
            ready, _, _ = select.select([handle], [], [], max(0.0, end - time.monotonic()))
            text = os.read(handle, 1 << 16) if ready else b""
            if not text:
                raise OSError("silence")
            said += text
        return said

    def _stop(self) -> int:
        """End the server and its guards, which end their guests; its exit status."""
        server = self._server
        for stream in (server.stdin, server.stdout):
            if stream is not None:
                stream.close()
        try:
            status = server.wait(timeout=2.0)
        except subprocess.TimeoutExpired:
            processes.kill_group(server.pid)
            status = server.wait()
        if self._alone:
            processes.kill_descendants()
        return status


def _read_checked_run(folder: Path, told: TrainingReport, records: Sequence[Record]) -> TrainingRun:
    outcome = messages.read_training_run(folder, told, records)
    for k, (estimate, record) in enumerate(zip(outcome.estimates, records, strict=True), start=1):
        try:
            check_estimate(estimate, record)
        except EstimateError as error:
            raise EntryError(
                f"test drive {k} of {len(records)}, seed {told.seed}: {error}"
            ) from None
    return outcome


def _describe_violation(run_status: RunStatus, limits: Limits) -> str | None:
    """In one sentence, what ended a run other than the entry itself."""
    match run_status.outcome:
        case "time":
            return f"it was ended after {limits.seconds:g} s, the time limit"
        case "memory":
            return f"it was ended when it held more than {limits.memory:g} GiB, the memory limit"
        case "processes":
            return f"it was ended when it had more than {limits.processes} processes"
        case "supervisor":
            return (
                f"the process that watched over it was ended by {describe_exit(run_status.status)}"
            )
    return None


def _describe_missing_response(run_status: RunStatus) -> str:
    words = run_status.output_tail.strip().splitlines()
    said = f"; its last words: {words[-1].strip()[:200]}" if words else ""
    return f"its process ended without an answer, by {describe_exit(run_status.status)}{said}"


def describe_exit(status: int) -> str:
    """An exit status, or the name of the signal, that ended a process."""
    if status >= 0:
        return f"exit status {status}"
    return Signals(-status).name if -status in set(Signals) else f"signal {-status}"


def _private_cache(name: str) -> tuple[tuple[str, str], ...]:
    """The kernels that an entry compiles, put in the place of the judge's.

    An entry may write there what it likes; the judge, and other entries, never load it. It starts
    as a copy of what the judge has compiled.
    """
    judges = _numba.CACHE
    if not name or not judges.is_dir():
        return ()
    own = judges.parent / "entries" / judges.name / name
    if not own.is_dir():
        fresh = own.with_name(f".{own.name}.{os.getpid()}")
        fresh.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(judges, fresh, dirs_exist_ok=True)
        try:
            os.rename(fresh, own)
        except OSError:  # another job was faster
            shutil.rmtree(fresh, ignore_errors=True)
    return ((str(own), str(judges)),)


def _json_line(data: Mapping[str, Any]) -> bytes:
    return (json.dumps(data) + "\n").encode()
