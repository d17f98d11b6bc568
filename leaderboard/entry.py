"""The seam between judge and entry: records and training truths go in, estimates come out.

An entry's code runs here and nowhere else, and the truth of a test drive never gets here.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimators.protocol import Estimator, NotFittedError, Trainable, check_estimate
from road_envs.record import Estimate, Profile, Record
from road_envs.vehicle import VehicleParameters


class EntryError(Exception):
    """An estimator that cannot be judged, said in one sentence."""


@dataclass(frozen=True)
class Outcome:
    """What came of one training and its test records."""

    estimates: list[Estimate]
    train_seconds: float
    estimate_seconds: float
    parameters: int  # numbers learnt


def learns(estimator: Estimator) -> bool:
    """Whether the judge trains an estimator: it can learn, and brings no weights of its own."""
    if not isinstance(estimator, Trainable):
        return False
    try:
        estimator.weights()
    except NotFittedError:
        return True
    return False


def reconstruct(
    estimator: Estimator,
    training: Sequence[tuple[Record, Profile]],
    records: Sequence[Record],
    car: VehicleParameters,
    seed: int,
) -> Outcome:
    """Train the estimator if it learns, then estimate every record. Raises EntryError."""
    doing = f"training with seed {seed}"
    try:
        start, parameters = time.perf_counter(), 0
        if learns(estimator):
            seen, truths = [list(part) for part in zip(*training, strict=True)]
            estimator = estimator.fit(seen, truths, car, seed)  # type: ignore[attr-defined]
        if isinstance(estimator, Trainable):
            parameters = sum(np.size(array) for array in estimator.weights().values())
        trained = time.perf_counter()
        estimates = []
        for k, record in enumerate(records, start=1):
            doing = f"estimating test drive {k} of {len(records)}, seed {seed}"
            estimate = estimator.estimate(record, car)
            check_estimate(estimate, record)
            estimates.append(estimate)
    except (Exception, SystemExit) as error:
        said = " ".join(str(error).split()) or "no message"
        raise EntryError(f"{doing}: {type(error).__name__}: {said}") from error
    return Outcome(estimates, trained - start, time.perf_counter() - trained, parameters)
