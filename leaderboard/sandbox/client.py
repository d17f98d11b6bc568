"""Client of the sandbox, in the host: runs entries in guests and checks every reply.

What an entry says about itself counts for nothing but its settings, `causal` and `lag`. Its name is
checked against an allow-list, its code is hashed from its files, its time is compared with the
clock of the host and the processor time of the guest, and a second guest tests on the test drives
whether it is causal and forgets the drives before.
"""

import dataclasses
import errno
import os
import random
import secrets
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

import estimators
from estimators.api import CalibrationDrive, check_estimate
from leaderboard.entries import entry_files
from leaderboard.entries.entries import is_ours
from leaderboard.entries.entry import (
    MAX_LAG,
    Calibrations,
    Entry,
    EntryError,
    TrainingRun,
    are_equal,
    reconstruct_all,
)
from leaderboard.entries.imports import imported_versions
from leaderboard.sandbox import bubblewrap, estimator_handler, messages, processes
from leaderboard.sandbox.guest import Guest, MachineError
from leaderboard.sandbox.launch import start_guest, twice
from leaderboard.sandbox.limits import UNLIMITED, Limits
from leaderboard.sandbox.retest import NOT_CAUSAL, NOT_RETESTED, compare_answers, draw_questions
from road_envs.core.atomic_io import TempFolder
from road_envs.records.record import Estimate, Profile, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters

LARGEST_HEIGHT = 1e6  # largest height and standard deviation [m] of an estimate
LARGEST_COUNT = 1e12  # largest number of parameters

UNSEEN_TIME = 0.05
"""Time [s] of one request beyond the reported time that is not charged to an entry: messages."""

ONE_TRAINING = "its training does not depend on the seed"


class SandboxClient(ExitStack):
    """Runs entries in guests, one at a time; a context manager.

    Estimators of this package that use the same libraries share a guest with a child for each run;
    an entry from outside has a new guest for each run. `owns_all_children` states that this process
    has no children but those of the client, so that all remaining ones can be killed. `code` has
    folders with a copy of the code of entries from outside, by reference; the code of others is
    read from where it is.
    """

    def __init__(
        self,
        limits: Limits,
        *,
        owns_all_children: bool = False,
        code: Mapping[str, Path] = MappingProxyType({}),
    ):
        """Raises ConfigError if bubblewrap is requested and cannot be used."""
        super().__init__()
        self.limits = limits
        self._bubblewrap = bubblewrap.is_used(self.limits.isolation)
        self.guest: Guest | None = None  # of the last run
        self._code = code
        self._folder = self.enter_context(TempFolder())
        self._folder.chmod(0o755)  # a guest has another user
        self._snapshots: dict[str, tuple[str, Path]] = {}
        self._ours: dict[tuple[str, ...], Guest] = {}  # by the libraries that they have loaded
        self._home = self._folder  # of the last guest
        self._pipes = bubblewrap.count_pipes() if self._bubblewrap else 0
        self.isolation = "bubblewrap" if self._bubblewrap else "process"
        if owns_all_children:
            processes.become_subreaper()
            self.callback(processes.kill_descendants)
        self.callback(self._close_guests)

    def describe(self, reference: str) -> dict[str, Any]:
        """Return settings, causality, lag [m], version, imports and, of a package, the name of its
        entry point, without loading the code here. Raises EntryError.
        """
        code, folder = self._snapshot(reference)
        guest = self._start(reference)
        try:
            about = {"reference": reference, "settings": dict[str, Any](), "car": None}
            head, _ = call(guest, messages.encode({"do": "start", **about}))
        finally:
            self._end(guest)
        causal, lag = head.get("causal"), head.get("lag")
        if not isinstance(causal, bool):
            raise EntryError("cannot be constructed: its attribute causal must be True or False")
        lag = messages.number(head, "lag", 1e9)
        if causal and lag > MAX_LAG:
            raise EntryError(
                f"cannot be constructed: a causal estimate may be at most {MAX_LAG:g} m behind the "
                f"front axle, its lag is {lag:g} m; declare causal = False"
            )
        known = {"settings": messages.settings(head.get("settings")), "causal": causal, "lag": lag}
        known |= {"code": code, "imports": imported_versions(str(folder))}
        return known | {k: x for k, x in head.items() if k == "name" and isinstance(x, str)}

    def reconstruct(
        self,
        entry: Entry,
        training: Sequence[tuple[Record, Profile]],
        records: Sequence[Record],
        car: VehicleParameters,
        seeds: Sequence[int],
        *,
        calibrations: Calibrations = (),
        retest: bool = False,
    ) -> list[TrainingRun]:
        """Run `entry.reconstruct_all` in a guest. Raises EntryError.

        With `retest`, an entry from outside is asked again in a second guest, which runs first in
        half of the cases: does it look ahead or remember?
        """
        ours = is_ours(entry.reference)
        if not ours and entry.code:
            code, folder = self._snapshot(entry.reference)
            other = {x.split()[0] for x in {*imported_versions(str(folder))} ^ {*entry.imports}}
            if code != entry.code or other:
                what = "files" if code != entry.code else f"imports ({', '.join(sorted(other))})"
                raise EntryError(f"its {what} have changed since the run was planned")
        order, secret = list(range(len(records))), random.SystemRandom()
        if not ours:
            secret.shuffle(order)

        def run(asked: Sequence[Record], seeds: Sequence[int], order: Sequence[int], known):
            if questions and self._bubblewrap:  # other guests may have had its drives or roads
                self._pipes = bubblewrap.forget_guests(self._pipes)
            guest = self._start(entry.reference)
            try:
                session = self._session(guest, entry, car)
                # of others each by itself: two that happen to be equal say nothing of the third
                alone = session.needs_training and not ours
                parts = [[one] for one in seeds] if alone else [seeds]
                runs = [
                    made
                    for part in parts
                    for made in reconstruct_all(session, training, asked, part, order, known)
                ]
            finally:
                self._end(guest)
            return runs, session.needs_training, guest.peak_memory

        def run_again() -> tuple[list[Estimate], str]:
            known = [calibrations[q.drive] for q in questions] if calibrations else ()
            asked = [q.record for q in questions]
            try:
                runs, *_ = twice(lambda: run(asked, [seed], range(len(asked)), known))
            except EntryError as error:
                return [], str(error).replace(";", ",")  # which parts notes
            return runs[0].estimates, ""

        seed, causal = secret.choice(seeds), bool(entry.causal)
        questions = draw_questions(records, order, causal, secret) if retest and not ours else []
        again_first = bool(questions) and secret.random() < 0.5
        with bubblewrap.alone() if questions and self._bubblewrap else nullcontext():
            again, reason = run_again() if again_first else ([], "")
            runs, trains, peak_memory = run(records, seeds, order, calibrations)
            if questions and not again_first:
                again, reason = run_again()
        unasked = bool(questions) and not again
        tested = [f"{NOT_RETESTED}: {reason}"] if unasked else []
        if again:
            first = next((one for one in runs if one.seed == seed), runs[0])
            tested = compare_answers(questions, first, again, entry.lag)
        if not ours and trains and len(runs) > 1:
            if all(are_equal(runs[0].estimates, one.estimates) for one in runs):
                runs, tested = runs[:1], [ONE_TRAINING, *tested]
        looks_ahead = unasked or not set(NOT_CAUSAL).isdisjoint(tested)
        found = {"peak_memory": peak_memory, "isolation": self.isolation, "notes": tuple(tested)}
        return [dataclasses.replace(one, **found, looks_ahead=looks_ahead) for one in runs]

    def _snapshot(self, reference: str) -> tuple[str, Path]:
        """Return the digest of an outside entry's code and the folder with a copy of it."""
        if is_ours(reference):
            return "", Path()
        if reference not in self._snapshots:
            if not self._bubblewrap and self.limits.isolation != "process":
                raise EntryError(
                    f"not run: {bubblewrap.obstacle()}; an estimator from outside this package "
                    "would have the rights of the user; if you trust it: --isolation process"
                )
            folder = self._folder / f"entry-{len(self._snapshots)}"
            try:
                code = entry_files.snapshot(reference, folder, self._code.get(reference))
            except EntryError as error:  # what was copied is no part of the next one
                shutil.rmtree(folder, ignore_errors=True)
                raise _copy_error(error, error) from None
            self._snapshots[reference] = code, folder
            for path in folder.rglob("*"):  # a time would tell each guest how long the run lasts
                os.utime(path, (0, 0))
        return self._snapshots[reference]

    def _start(self, reference: str) -> Guest:
        if is_ours(reference):
            libraries = getattr(estimators.REGISTRY.get(reference), "libraries", ())
            loaded = ("estimators.registry", *libraries)
            guest = self._ours.get(libraries) or self._new_guest(None, loaded)
            self._ours[libraries] = guest
        else:
            guest = self._new_guest(self._snapshot(reference)[1])
        self.guest = guest
        guest.start_run(self.limits)
        return guest

    def _new_guest(self, code: Path | None, libraries: Sequence[str] = ()) -> Guest:
        # it sees the name of its code's folder, which must not tell how many were before it
        self._home = home = self._folder / secrets.token_hex(8)
        try:
            if code is not None:  # of its own: how fast a file is read says nothing of others
                code = Path(shutil.copytree(code, home.with_suffix(".code")))
            return start_guest(
                estimator_handler.__name__, home, self.limits, isolated=self._bubblewrap,
                code=code, libraries=libraries,
            )  # fmt: skip
        except OSError as error:
            shutil.rmtree(home.with_suffix(".code"), ignore_errors=True)
            failure = MachineError(f"this machine did not start its guest: {error}")
            raise _copy_error(error, failure) from None

    def _session(self, guest: Guest, entry: Entry, car: VehicleParameters) -> "_RemoteSession":
        start = {"do": "start", "reference": entry.reference, "settings": entry.settings}
        head, _ = call(guest, messages.encode({**start, "car": dataclasses.asdict(car)}))
        trains, calibrates = (head.get(name) is True for name in ("needs_training", "calibrates"))
        # of others the host finds out whether the seed makes a difference
        uses_seed = head.get("uses_seed") is True or not is_ours(entry.reference)
        return _RemoteSession(guest, trains, calibrates, uses_seed)

    def _end(self, guest: Guest) -> None:
        """End a run: only a guest of our own that has finished properly is kept."""
        ours = [libraries for libraries, kept in self._ours.items() if kept is guest]
        if ours and sys.exc_info()[0] is None:
            guest.send_end()
            return
        guest.close()
        shutil.rmtree(self._home.with_suffix(".code"), ignore_errors=True)
        for libraries in ours:
            del self._ours[libraries]

    def _close_guests(self) -> None:
        while self._ours:
            self._ours.popitem()[1].close()


@dataclasses.dataclass
class _RemoteSession:
    """A session with an estimator in a guest; raises EntryError, and `estimate` EstimateError."""

    _guest: Guest
    needs_training: bool
    calibrates: bool
    uses_seed: bool = True

    def fit(self, training: Sequence[tuple[Record, Profile]], seed: int) -> tuple[int, float]:
        sent, seed = (training, seed) if self.needs_training else ([], 0)  # which tells nothing
        head, _, seconds = self._timed(messages.encode_drives("fit", sent, seed=seed))
        return int(messages.number(head, "parameters", LARGEST_COUNT)), seconds

    def calibrate(self, drives: Sequence[CalibrationDrive]) -> float:
        sent = [(drive.record, drive.profile) for drive in drives]
        survey, names = [drive.survey_std for drive in drives], [drive.name for drive in drives]
        request = messages.encode_drives("calibrate", sent, survey=survey, names=names)
        return self._timed(request)[2]

    def estimate(self, record: Record) -> tuple[Estimate, float]:
        stations = profile_stations(record.length)
        size = 2 * stations.size

        def size_of_arrays(head: dict[str, Any]) -> int:
            if "failure" in head:
                return 0
            messages.number(head, "seconds", UNLIMITED.seconds)  # a stop of both counts there
            return 8 * size * (2 if head.get("std") is True else 1)

        request = messages.encode_drives("estimate", [(record, None)])
        _, data, seconds = self._timed(request, size_of_arrays)
        arrays = np.frombuffer(data).reshape(-1, 2, stations.size)
        estimate = Estimate(stations, arrays[0], arrays[1] if len(arrays) > 1 else None)
        check_estimate(estimate, record)
        largest = float(np.abs(arrays).max(initial=0.0))
        if largest > LARGEST_HEIGHT:
            raise EntryError(f"heights up to {largest:.3g} m, the limit is {LARGEST_HEIGHT:g} m")
        return estimate, seconds

    def _timed(self, request: bytes, *size: Callable) -> tuple[dict[str, Any], bytes, float]:
        """Return a reply and its time [s]: the reported one unless more has passed or was used, at
        most that.

        Work in a process that was not waited for shows in the clock of the host alone.
        """
        before, start = self._guest.cpu_seconds(), time.perf_counter()
        head, data = call(self._guest, request, *size)
        passed = time.perf_counter() - start
        used = max(passed, self._guest.cpu_seconds() - before)
        reported = messages.number(head, "seconds", UNLIMITED.seconds)
        return head, data, min(reported, used) if used < reported + UNSEEN_TIME else used


def _copy_error(error: Exception, otherwise: EntryError) -> EntryError:
    """Return the error of a copy of code that failed: that it did not fit, or `otherwise`."""
    # a `shutil.Error` has what the operating system said in its text alone
    if any(os.strerror(code) in str(error) for code in (errno.ENOSPC, errno.EDQUOT)):
        return MachineError("this machine has no space left for its code: set TMPDIR elsewhere")
    return type(otherwise)(str(otherwise)[:300])


def call(guest: Guest, request: bytes, *size: Callable) -> tuple[dict[str, Any], bytes]:
    """Send a request and return the reply. Raises EntryError, also for a reported failure."""
    head, data = guest.call(request, *size)
    if "failure" in head:
        raise EntryError(messages.text(head["failure"]))
    return head, data
