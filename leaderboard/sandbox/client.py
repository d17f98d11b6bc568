"""Client of the sandbox, in the host: runs entries in guests and checks every reply.

What an entry says about itself counts for nothing but its settings, `causal` and `lag`. Its name is
checked against an allow-list, its code is hashed from its files, its time is compared with the
processor time of the guest, and its causality is tested on the test drives.
"""

import dataclasses
import json
import random
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

import estimators
from estimators.api import CalibrationDrive, DeclaresLibraries, check_estimate
from leaderboard.entries import entry_files
from leaderboard.entries.entry import (
    MAX_LAG,
    Calibrations,
    Entry,
    EntryError,
    TrainingRun,
    reconstruct_all,
)
from leaderboard.sandbox import bubblewrap, messages, processes, worker
from leaderboard.sandbox.guest import Guest
from leaderboard.sandbox.limits import Limits, guest_environment
from road_envs.core.atomic_io import TempFolder
from road_envs.core.code_digest import cache_home
from road_envs.core.config import ConfigError
from road_envs.kernels import _numba
from road_envs.records.record import Estimate, Profile, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters

LARGEST_HEIGHT = 1e6
"""Largest height and standard deviation [m] of an estimate."""

LARGEST_COUNT = 1e12
"""Largest number of parameters."""

UNSEEN_TIME = 0.05
"""Processor time [s] of one request beyond the reported time that is not charged to an entry."""

EQUALITY_TOLERANCE = 1e-9
"""Largest difference [m] of estimates that count as equal, for rounding."""

RETESTED_DRIVES = 2
"""Number of test drives that are estimated again with other samples from a secret point on."""

LOOKS_AHEAD = "claims to be causal, but its estimate of a test drive depends on later samples"
REMEMBERS = "its estimate of a test drive depends on the drives that it has seen before"
ONE_TRAINING = "its training does not depend on the seed"
NOT_RETESTED = "could not be run again to test its causality and its memory"


class SandboxClient:
    """Runs entries in guests, one at a time; a context manager.

    Estimators of this package that use the same libraries share a guest with a child for each run;
    an entry from outside has a new guest for each run. `owns_all_children` states that this process
    has no children but those of the client, so that all remaining ones can be killed. `code` has
    folders with a copy of the code of entries from outside, by reference; the code of others is
    read from where it is.
    """

    def __init__(
        self,
        limits: Limits | None = None,
        *,
        owns_all_children: bool = False,
        code: Mapping[str, Path] = MappingProxyType({}),
    ):
        """Raises ConfigError if bubblewrap is requested and cannot be used."""
        self.limits = limits or Limits()
        self.guest: Guest | None = None  # of the last run
        self._owns_all_children, self._code = owns_all_children, code
        self._temp = TempFolder()
        self._temp.path.chmod(0o755)  # a guest has another user
        self._snapshots: dict[str, tuple[str, Path]] = {}
        self._ours: dict[tuple[str, ...], Guest] = {}  # by the libraries that they have loaded
        self._count = 0
        obstacle = bubblewrap.obstacle()
        if self.limits.isolation == "bubblewrap" and obstacle is not None:
            self._temp.close()
            raise ConfigError(f"{obstacle}; install it, or choose the isolation process")
        self._bubblewrap = obstacle is None and self.limits.isolation != "process"
        if owns_all_children:
            processes.become_subreaper()

    def __enter__(self) -> "SandboxClient":
        return self

    def __exit__(self, *_: object) -> None:
        self._close_guests()
        if self._owns_all_children:
            processes.kill_descendants()
        self._temp.close()

    @property
    def isolation(self) -> str:
        """Isolation of the entries: "bubblewrap" or "process"."""
        return "bubblewrap" if self._bubblewrap else "process"

    def describe(self, reference: str) -> dict[str, Any]:
        """Return settings, causality, lag [m], version and, of a package, the name of its entry
        point, without loading the code here. Raises EntryError.
        """
        code, _ = self._snapshot(reference)
        guest = self._start(reference)
        try:
            head = self._begin(guest, reference, {}, None)
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
        name = head.get("name")
        return {**known, "code": code, **({"name": name} if isinstance(name, str) else {})}

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

        With `retest`, an entry from outside runs a second time: does it look ahead or remember?
        """
        ours = entry_files.is_ours(entry.reference)
        if not ours and self._snapshot(entry.reference)[0] != entry.code and entry.code:
            raise EntryError("its files have changed since the run was planned")
        order = list(range(len(records)))
        if not ours:
            random.SystemRandom().shuffle(order)
        guest = self._start(entry.reference)
        try:
            session = self._session(guest, entry, car)
            runs = list(reconstruct_all(session, training, records, seeds, order, calibrations))
        finally:
            self._end(guest)
        found: dict[str, Any] = {"peak_memory": guest.peak_memory, "isolation": self.isolation}
        if not ours and session.needs_training and len(runs) < len(seeds):
            found["notes"] = (ONE_TRAINING,)
        if retest and not ours:
            tested = self._retest(
                entry,
                training,
                records,
                car,
                seeds[0],
                run=runs[0],
                last=order[-1],
                calibrations=calibrations,
            )
            found["looks_ahead"] = LOOKS_AHEAD in tested or NOT_RETESTED in tested
            found["notes"] = (*found.get("notes", ()), *tested)
        return [dataclasses.replace(run, **found) for run in runs]

    def _retest(
        self,
        entry: Entry,
        training: Sequence[tuple[Record, Profile]],
        records: Sequence[Record],
        car: VehicleParameters,
        seed: int,
        *,
        run: TrainingRun,
        last: int,
        calibrations: Calibrations,
    ) -> list[str]:
        """Compare estimates of `run` with those of a new guest, independent of the first.

        It begins with the drive that was estimated `last`, and causal estimators must not change
        before the point from which on the samples of a drive were replaced.
        """
        secret = random.SystemRandom()
        number = min(RETESTED_DRIVES, len(records)) if entry.causal else 0
        drives = secret.sample(range(len(records)), number)
        changed = [_replace_future(records[k], secret) for k in drives]
        asked = [records[last], *(record for record, _ in changed)]
        known = [calibrations[k] for k in (last, *drives)] if calibrations else ()
        guest = self._start(entry.reference)
        try:
            session = self._session(guest, entry, car)
            (again,) = reconstruct_all(session, training, asked, [seed], None, known)
        except EntryError:
            return [NOT_RETESTED]
        finally:
            self._end(guest)
        notes = []
        if _differ(again.estimates[0], run.estimates[last], np.inf):
            notes.append(REMEMBERS)
        for k, (record, start), estimate in zip(drives, changed, again.estimates[1:], strict=True):
            # between two samples one may interpolate
            first = start - entry.lag - float(np.diff(record.s).max())
            if _differ(estimate, run.estimates[k], first) and LOOKS_AHEAD not in notes:
                notes.append(LOOKS_AHEAD)
        return notes

    def _snapshot(self, reference: str) -> tuple[str, Path]:
        """Return the digest of an outside entry's code and the folder with a copy of it."""
        if entry_files.is_ours(reference):
            return "", Path()
        if reference not in self._snapshots:
            if not self._bubblewrap and self.limits.isolation != "process":
                raise EntryError(
                    f"not run: {bubblewrap.obstacle()}; an estimator from outside this package "
                    "would have the rights of the user; if you trust it: --isolation process"
                )
            folder = self._temp.path / f"entry-{len(self._snapshots)}"
            source = str(self._code.get(reference, reference))
            self._snapshots[reference] = entry_files.snapshot(source, folder), folder
        return self._snapshots[reference]

    def _start(self, reference: str) -> Guest:
        if entry_files.is_ours(reference):
            kind = estimators.REGISTRY.get(reference)
            libraries = kind.libraries if isinstance(kind, DeclaresLibraries) else ()
            guest = self._ours.get(libraries) or self._new_guest(None, libraries)
            self._ours[libraries] = guest
        else:
            guest = self._new_guest(self._snapshot(reference)[1])
        self.guest = guest
        guest.start_run(self.limits)
        return guest

    def _new_guest(self, code: Path | None, libraries: tuple[str, ...] = ()) -> Guest:
        self._count += 1
        home = self._temp.path / str(self._count)
        home.mkdir()
        isolated, cache = self._bubblewrap, cache_home()
        has_cache = (cache / _numba.CACHE.name).is_dir()
        read_only: dict[Path, Path] = {}
        writable: dict[Path, Path] = {}
        entry, shared = code, cache
        if isolated and code is not None:
            entry, shared = bubblewrap.ENTRY, bubblewrap.SHARED_CACHE
            read_only[code] = entry
        if has_cache and isolated:
            if code is None:
                writable[cache] = bubblewrap.HOME / cache.name
            else:
                needed = [cache / _numba.CACHE.name, *cache.glob("*.json")]
                read_only |= {path: shared / path.name for path in needed}
        becomes_nobody = isolated and code is not None and bubblewrap.must_become_nobody()
        setup = worker.Setup(
            limits=self.limits,
            entry=None if entry is None else str(entry),
            user=bubblewrap.NOBODY if becomes_nobody else None,
            serves_many=code is None,
            libraries=libraries,
            cache=(str(shared), _numba.CACHE.name) if has_cache and code is not None else None,
        )
        words = [sys.executable, "-P", "-s", "-m", worker.__name__]
        words.append(json.dumps(dataclasses.asdict(setup)))
        inside = bubblewrap.HOME if isolated else home
        environment = guest_environment(inside, whole_path=not isolated)
        environment["XDG_CACHE_HOME"] = str(inside)
        if code is None and not isolated:
            environment["XDG_CACHE_HOME"] = str(cache.parent)
        if isolated:
            words = bubblewrap.command(
                words, environment, self.limits, read_only, writable, becomes_nobody=becomes_nobody
            )
        try:
            return Guest(words, environment, home)
        except EntryError as error:
            raise RuntimeError(f"the sandbox does not start: {error}") from error

    def _begin(
        self, guest: Guest, reference: str, settings: Mapping[str, Any], car: Any
    ) -> dict[str, Any]:
        start = {"reference": reference, "settings": dict(settings), "car": car}
        return call(guest, messages.encode(start))[0]

    def _session(self, guest: Guest, entry: Entry, car: VehicleParameters) -> "_RemoteSession":
        head = self._begin(guest, entry.reference, entry.settings, dataclasses.asdict(car))
        trains, calibrates = (head.get(name) is True for name in ("needs_training", "calibrates"))
        # of others the host finds out whether the seed makes a difference
        uses_seed = head.get("uses_seed") is True or not entry_files.is_ours(entry.reference)
        return _RemoteSession(guest, trains, calibrates, uses_seed)

    def _end(self, guest: Guest) -> None:
        """End a run: only a guest of our own that has finished properly is kept."""
        ours = [libraries for libraries, kept in self._ours.items() if kept is guest]
        if ours and sys.exc_info()[0] is None:
            guest.send_end()
            return
        guest.close()
        for libraries in ours:
            del self._ours[libraries]

    def _close_guests(self) -> None:
        while self._ours:
            self._ours.popitem()[1].close()


class _RemoteSession:
    """A session with an estimator in a guest."""

    def __init__(
        self, guest: Guest, needs_training: bool, calibrates: bool, uses_seed: bool = True
    ):
        self.needs_training, self.calibrates = needs_training, calibrates
        self.uses_seed = uses_seed
        self._guest = guest

    def fit(self, training: Sequence[tuple[Record, Profile]], seed: int) -> tuple[int, float]:
        """Train the estimator if it needs training. Raises EntryError."""
        sent = training if self.needs_training else []
        head, _, seconds = self._timed(messages.encode_training(sent, seed))
        return int(messages.number(head, "parameters", LARGEST_COUNT)), seconds

    def calibrate(self, drives: Sequence[CalibrationDrive]) -> float:
        """Calibrate the estimator to the vehicle of these drives. Raises EntryError."""
        return self._timed(messages.encode_calibration(drives))[2]

    def estimate(self, record: Record) -> tuple[Estimate, float]:
        """Return the estimate of a record. Raises EntryError, EstimateError."""
        stations = profile_stations(record.length)
        size = 2 * stations.size

        def size_of_arrays(head: dict[str, Any]) -> int:
            if "failure" in head:
                return 0
            messages.number(head, "seconds", self._guest.limits.seconds)
            return 8 * size * (2 if head.get("std") is True else 1)

        head = {"do": "estimate", "length": record.length, **messages.signals_head([record])}
        request = messages.encode(head, messages.record_arrays(record))
        _, data, seconds = self._timed(request, size_of_arrays)
        arrays = np.frombuffer(data).reshape(-1, 2, stations.size)
        estimate = Estimate(stations, arrays[0], arrays[1] if len(arrays) > 1 else None)
        check_estimate(estimate, record)
        largest = float(np.abs(arrays).max(initial=0.0))
        if largest > LARGEST_HEIGHT:
            raise EntryError(f"heights up to {largest:.3g} m, the limit is {LARGEST_HEIGHT:g} m")
        return estimate, seconds

    def _timed(self, request: bytes, *size: Callable) -> tuple[dict[str, Any], bytes, float]:
        """Return a reply and its time [s]: the reported one unless more processor time was used."""
        before = self._guest.cpu_seconds()
        head, data = call(self._guest, request, *size)
        used = self._guest.cpu_seconds() - before
        reported = messages.number(head, "seconds", self._guest.limits.seconds)
        return head, data, reported if used < reported + UNSEEN_TIME else used


def call(guest: Guest, request: bytes, *size: Callable) -> tuple[dict[str, Any], bytes]:
    """Send a request and return the reply. Raises EntryError, also for a reported failure."""
    head, data = guest.call(request, *size)
    if "failure" in head:
        raise EntryError(messages.text(head["failure"]))
    return head, data


def _replace_future(record: Record, secret: random.Random) -> tuple[Record, float]:
    """Return a record with other accelerations from a random station [m] on, and that station."""
    start = record.length * secret.uniform(0.1, 0.9)
    rng = np.random.default_rng(secret.getrandbits(128))
    noise = np.nanstd(record.a) * rng.standard_normal(record.a.shape)
    return dataclasses.replace(record, a=record.a + np.where(record.s >= start, noise, 0.0)), start


def _differ(first: Estimate, second: Estimate, end: float) -> bool:
    """Return whether two estimates differ before the station `end` [m]."""
    before = first.s < end
    change = np.abs(first.z - second.z)[:, before]
    return bool(change.max(initial=0.0) > EQUALITY_TOLERANCE)
