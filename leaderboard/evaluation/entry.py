"""Entries and how they are run: training records and truths and test records in, estimates out.

All code of an entry runs in `reconstruct`, which never receives the truth of a test drive.
"""

import dataclasses
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimators.api import Estimator, NotFittedError, Trainable, check_estimate
from road_envs.config import STRICT
from road_envs.data.record import Estimate, Profile, Record
from road_envs.vehicle.parameters import VehicleParameters

BUILTIN = "judge"
"""Reference of an entry whose estimates the evaluation computes itself, from the truth."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """An estimator on the leaderboard, described so that any process can construct it.

    `reference` is a registered name, "module:Class", or the path of an .npz from `train`; `lag` [m]
    is the distance of a causal estimate behind the front axle; `code` is the version of its sources
    and weights; `failure` is the reason why it cannot be constructed.
    """

    __pydantic_config__ = STRICT

    name: str
    reference: str
    settings: dict[str, Any] = field(default_factory=dict)
    causal: bool | None = None
    lag: float = 0.0
    code: str = ""
    failure: str | None = None


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


def reconstruct_all(
    estimator: Estimator,
    training: Sequence[tuple[Record, Profile]],
    records: Sequence[Record],
    car: VehicleParameters,
    seeds: Sequence[int],
) -> Iterator[TrainingRun]:
    """Yield one run for each training seed. Raises EntryError.

    Yields the first run only if the training does not depend on the seed, that is, if the second
    run gives the same estimates.
    """
    first: list[Estimate] = []
    for seed in seeds if needs_training(estimator) else seeds[:1]:
        training_run = reconstruct(estimator, training, records, car, seed)
        if first and _equal_estimates(training_run.estimates, first):
            return
        yield training_run
        first = first or training_run.estimates


def reconstruct(
    estimator: Estimator,
    training: Sequence[tuple[Record, Profile]],
    records: Sequence[Record],
    car: VehicleParameters,
    seed: int,
) -> TrainingRun:
    """Train the estimator if it needs training, then estimate every record. Raises EntryError."""
    step = f"training with seed {seed}"
    try:
        start = time.perf_counter()
        if needs_training(estimator):
            training_records, truths = [list(part) for part in zip(*training, strict=True)]
            estimator = estimator.fit(training_records, truths, car, seed)  # type: ignore[attr-defined]
        end_of_training = time.perf_counter()
        parameters = sum(np.size(array) for array in _weights(estimator))
        estimates = []
        for k, record in enumerate(records, start=1):
            step = f"estimating test drive {k} of {len(records)}, seed {seed}"
            estimate = estimator.estimate(record, car)
            check_estimate(estimate, record)
            estimates.append(estimate)
    except (Exception, SystemExit) as error:
        raise EntryError(f"{step}: {describe_error(error)}") from error
    estimate_seconds = time.perf_counter() - end_of_training
    return TrainingRun(estimates, end_of_training - start, estimate_seconds, parameters, seed)


def get_settings(estimator: Estimator | None) -> dict[str, Any]:
    """Return the constructor arguments of an estimator, {} if it is no dataclass."""
    if estimator is None or not dataclasses.is_dataclass(estimator):
        return {}
    return {f.name: getattr(estimator, f.name) for f in dataclasses.fields(estimator) if f.init}


def describe_error(error: BaseException) -> str:
    """Return class and message of an error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split()) or 'no message'}"


def _weights(estimator: Estimator) -> list[np.ndarray]:
    return list(estimator.weights().values()) if isinstance(estimator, Trainable) else []


def _equal_estimates(first: Sequence[Estimate], second: Sequence[Estimate]) -> bool:
    return len(first) == len(second) and all(
        np.array_equal(a.z, b.z) for a, b in zip(first, second, strict=True)
    )
