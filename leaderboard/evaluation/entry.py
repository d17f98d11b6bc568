"""The seam between judge and entry: records and training truths go in, estimates come out.

An entry's code runs here and nowhere else, and the truth of a test drive never gets here.
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
"""Reference of an entry that the judge itself answers for."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Who is judged: an estimator by name, with what it takes to make it anywhere.

    `reference` is a registered name, "module:Class", or the path of an .npz from `train`; `lag` [m]
    is how far behind the front axle a causal estimate stands; `code` is the version of its sources
    and weights; a `failure` says why it cannot be made.
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
    """An estimator that cannot be judged, said in one sentence."""


@dataclass(frozen=True)
class TrainingRun:
    """What came of one training and its test records."""

    estimates: list[Estimate]
    train_seconds: float
    estimate_seconds: float
    parameters: int  # numbers learnt
    seed: int = 0  # of the training
    peak_memory: float | None = None  # [GiB] of the process that ran all trainings
    isolation: str = "none"


def needs_training(estimator: Estimator) -> bool:
    """Whether the judge trains an estimator: it can learn, and brings no weights of its own."""
    if not isinstance(estimator, Trainable):
        return False
    try:
        estimator.weights()
    except NotFittedError:
        return True
    return False


def reconstruct_all(
    estimator: Estimator,
    training: Sequence[tuple[Record, Profile]],
    records: Sequence[Record],
    car: VehicleParameters,
    seeds: Sequence[int],
) -> Iterator[TrainingRun]:
    """One outcome for each training seed; the first alone where nothing is drawn from the seed,
    which is seen when the second gives the same answers. Raises EntryError.
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
    """Train the estimator if it learns, then estimate every record. Raises EntryError."""
    doing = f"training with seed {seed}"
    try:
        start = time.perf_counter()
        if needs_training(estimator):
            seen, truths = [list(part) for part in zip(*training, strict=True)]
            estimator = estimator.fit(seen, truths, car, seed)  # type: ignore[attr-defined]
        trained = time.perf_counter()
        parameters = sum(np.size(array) for array in _weights(estimator))
        estimates = []
        for k, record in enumerate(records, start=1):
            doing = f"estimating test drive {k} of {len(records)}, seed {seed}"
            estimate = estimator.estimate(record, car)
            check_estimate(estimate, record)
            estimates.append(estimate)
    except (Exception, SystemExit) as error:
        raise EntryError(f"{doing}: {describe_error(error)}") from error
    spent = time.perf_counter() - trained
    return TrainingRun(estimates, trained - start, spent, parameters, seed)


def get_settings(estimator: Estimator | None) -> dict[str, Any]:
    """What an estimator was constructed with."""
    if estimator is None or not dataclasses.is_dataclass(estimator):
        return {}
    return {f.name: getattr(estimator, f.name) for f in dataclasses.fields(estimator) if f.init}


def describe_error(error: BaseException) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split()) or 'no message'}"


def _weights(estimator: Estimator) -> list[np.ndarray]:
    return list(estimator.weights().values()) if isinstance(estimator, Trainable) else []


def _equal_estimates(some: Sequence[Estimate], others: Sequence[Estimate]) -> bool:
    return len(some) == len(others) and all(
        np.array_equal(a.z, b.z) for a, b in zip(some, others, strict=True)
    )
