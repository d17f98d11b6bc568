"""Entries and how they are run: training records and truths and test records in, estimates out.

All code of an entry runs in a `_Session`, which never receives the truth of a test drive.
"""

import copy
import dataclasses
import json
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from estimators.api import (
    Calibratable,
    CalibrationDrive,
    EstimateError,
    Estimator,
    NotFittedError,
    Trainable,
    check_estimate,
    declared_lag,
    uses_seed,
)
from road_envs.core.config import Settings
from road_envs.records.record import Estimate, Profile, Record
from road_envs.vehicle.parameters import VehicleParameters

BUILTIN = "builtin"
"""Reference of an entry whose estimates the evaluation computes itself, from the truth."""

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,39}")
"""Pattern of the name of a row. It is part of the names of files and of addresses of pages."""

MAX_LAG = 10.0  # largest lag [m] of an estimator that counts as causal
Calibrations = Sequence[Sequence[CalibrationDrive]]
"""Drives of the vehicle of each test record, empty without calibration."""


@dataclass(frozen=True, kw_only=True)
class Entry(Settings):
    """An estimator on the leaderboard, described so that any process can construct it.

    `reference` is a registered name, "module:Class", or a path: a wheel, a folder with an installed
    package, or a file of weights. `lag` [m] is the distance of a causal estimate behind the front
    axle, at most MAX_LAG; `code` is the version of its sources and weights; `imports` has those of
    what an entry from outside imports, where the run is planned; `failure` is the reason why it
    cannot be constructed.
    """

    name: str
    reference: str
    settings: dict[str, Any] = field(default_factory=dict)
    causal: bool | None = None
    lag: float = 0.0
    code: str = ""
    imports: tuple[str, ...] = ()
    failure: str | None = None

    @property
    def imported(self) -> str:
        """The text of its `imports`, as rows name them."""
        return ", ".join(self.imports)


class EntryError(Exception):
    """An estimator that cannot be evaluated; the message is one sentence."""


@dataclass(frozen=True)
class TrainingRun:
    """Estimates of all test records after one training, with their cost."""

    estimates: list[Estimate]
    train_seconds: float
    estimate_seconds: float
    parameters: int  # number of fitted parameters
    seed: int = 0  # of the training
    peak_memory: float | None = None  # [GiB] of the process that ran all trainings
    isolation: str = "none"
    notes: tuple[str, ...] = ()  # what the evaluation has found out about the entry
    looks_ahead: bool = False  # a causal estimator whose estimate depends on later samples
    calibrate_seconds: float | None = None  # of all calibrations; None: there was none


def needs_training(estimator: Estimator) -> bool:
    """Return whether an estimator is trainable and has no weights yet. Raises EntryError."""
    if not isinstance(estimator, Trainable):
        return False
    rule = "weights() must raise NotFittedError until there are arrays to return"
    try:
        weights = estimator.weights()
    except NotFittedError:
        return True
    except Exception as error:
        raise EntryError(f"{rule}, not {describe_error(error)}") from error
    for name, value in weights.items():
        if not isinstance(value, np.ndarray):
            raise EntryError(f"{rule}; it returned {name!r} as {type(value).__name__}")
    return False


class _Session(Protocol):
    """An estimator that is trained and asked for estimates, in this process or in another."""

    needs_training: bool
    calibrates: bool
    uses_seed: bool

    def fit(self, training: Sequence[tuple[Record, Profile]], seed: int) -> tuple[int, float]:
        """Train anew if needed; return the number of fitted parameters and the time [s]."""

    def calibrate(self, drives: Sequence[CalibrationDrive]) -> float:
        """Calibrate what was trained to the vehicle of `drives`; return the time [s] it took."""

    def estimate(self, record: Record) -> tuple[Estimate, float]:
        """Return a valid estimate and the time [s] it took."""


class LocalSession:
    """A session with an estimator in this process; raises what that raises, and EstimateError."""

    def __init__(self, estimator: Estimator, car: VehicleParameters):
        self.needs_training = needs_training(estimator)
        self.calibrates = isinstance(estimator, Calibratable)
        self.uses_seed = uses_seed(estimator)
        self._estimator, self._trained, self._car = estimator, estimator, car
        self._calibrated = estimator

    def fit(self, training: Sequence[tuple[Record, Profile]], seed: int) -> tuple[int, float]:
        start = time.perf_counter()
        if self.needs_training:
            records, truths = [list(part) for part in zip(*training, strict=True)]
            self._trained = self._estimator.fit(records, truths, self._car, seed)  # type: ignore[attr-defined]
        self._calibrated = self._trained
        seconds = time.perf_counter() - start
        weights = self._trained.weights() if isinstance(self._trained, Trainable) else {}
        return sum(map(np.size, weights.values())), seconds

    def calibrate(self, drives: Sequence[CalibrationDrive]) -> float:
        start = time.perf_counter()
        self._calibrated = self._trained.calibrate(drives, self._car)  # type: ignore[attr-defined]
        return time.perf_counter() - start

    def estimate(self, record: Record) -> tuple[Estimate, float]:
        start = time.perf_counter()
        # a copy: an estimator may use its arrays again
        estimate = copy.deepcopy(self._calibrated.estimate(record, self._car))
        check_estimate(estimate, record)
        if any(map(np.ma.is_masked, vars(estimate).values())):
            raise EstimateError("some of its numbers are masked: fill them by estimated ones")
        return estimate, time.perf_counter() - start


def reconstruct_all(
    session: _Session,
    training: Sequence[tuple[Record, Profile]],
    records: Sequence[Record],
    seeds: Sequence[int],
    order: Sequence[int] | None = None,
    calibrations: Calibrations = (),
) -> Iterator[TrainingRun]:
    """Yield one run for each training seed; ask for the estimates in `order`. Raises EntryError.

    `calibrations`: drives of the vehicle of each record, or nothing. Yields the first run only if
    the training does not depend on the seed, by its own account or by the second estimates.
    """
    first: list[Estimate] = []
    for seed in seeds if session.needs_training and session.uses_seed else seeds[:1]:
        step, seconds = f"training with seed {seed}", 0.0
        calibrate_seconds: float | None = 0.0 if calibrations and session.calibrates else None
        estimates: dict[int, Estimate] = {}
        try:
            parameters, train_seconds = session.fit(training, seed)
            for k in order or range(len(records)):
                if calibrate_seconds is not None:
                    step = f"calibrating to the vehicle of test drive {k + 1}, seed {seed}"
                    calibrate_seconds += session.calibrate(calibrations[k])
                step = f"estimating test drive {k + 1} of {len(records)}, seed {seed}"
                estimates[k], duration = session.estimate(records[k])
                seconds += duration
        except (Exception, SystemExit) as error:
            reason = str(error) if isinstance(error, EntryError) else describe_error(error)
            raise EntryError(f"{step}: {reason}") from error
        ordered = [estimates[k] for k in range(len(records))]
        if first and are_equal(ordered, first):
            return
        yield TrainingRun(
            ordered, train_seconds, seconds, parameters, seed, calibrate_seconds=calibrate_seconds
        )
        first = first or ordered


def get_settings(estimator: Estimator | None) -> dict[str, Any]:
    """Return the constructor arguments of an estimator, {} if it is no dataclass."""
    if estimator is None or not dataclasses.is_dataclass(estimator):
        return {}
    return {f.name: getattr(estimator, f.name) for f in dataclasses.fields(estimator) if f.init}


def describe_estimator(estimator: Estimator) -> dict[str, Any]:
    """Return settings, causality and lag [m] of an estimator, as JSON types."""
    settings = json.loads(json.dumps(get_settings(estimator), default=str, allow_nan=False))
    return {"settings": settings, "causal": estimator.causal, "lag": declared_lag(estimator)}


def describe_error(error: BaseException) -> str:
    """Return class and message of an error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split()) or 'no message'}"


def are_equal(first: Sequence[Estimate], second: Sequence[Estimate]) -> bool:
    """Return whether all heights and deviations are equal."""
    return all(
        np.array_equal(a.z, b.z) and np.array_equal(a.z_std, b.z_std)  # type: ignore[arg-type]
        for a, b in zip(first, second, strict=True)
    )
