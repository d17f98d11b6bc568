"""Mean of the training roads: the score of memory without any measurement.

Each station is the average of the training roads that reach it, per wheel path; beyond the longest
the road is zero. On new roads this is close to `flat`, since independent roads average out. On a
board whose test road is a modified training road it is nearly the truth and shows that the board
rewards memory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from estimators.api import Profiles, Records, copy_with, require_fitted, validate_weights
from estimators.preprocessing import mask_record, sample_profile
from road_envs.core.config import Settings
from road_envs.records.record import Estimate, Profile, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, kw_only=True)
class Mean(Settings):
    """Baseline: the mean training road, independent of the record."""

    causal: ClassVar[bool] = True
    uses_seed: ClassVar[bool] = False
    z: np.ndarray | None = field(default=None, init=False, repr=False, compare=False)
    """Mean heights (2, M) [m] at the stations of the longest training road."""

    def fit(self, records: Records, truths: Profiles, car: VehicleParameters, seed: int) -> Self:
        """Average the truths; records, car and seed are unused."""
        return copy_with(self, z=_mean_profile(truths))

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return the mean road, cut or extended by zeros. Raises RecordError, NotFittedError."""
        mean, notes = require_fitted(self.z, self), mask_record(record).notes
        stations = profile_stations(record.length)
        z = np.zeros((2, stations.size))
        shared = min(stations.size, mean.shape[1])
        z[:, :shared] = mean[:, :shared]
        return Estimate(stations, z, notes=notes)

    def weights(self) -> dict[str, np.ndarray]:
        """Return `z` (2, M). Raises NotFittedError."""
        return {"z": require_fitted(self.z, self)}

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """Return a copy with these weights. Raises ValueError."""
        (z,) = validate_weights(weights, {"z": (2, None)})
        return copy_with(self, z=z)


def _mean_profile(truths: Sequence[Profile]) -> np.ndarray:
    """Return mean heights (2, M) [m] over the truths that reach each station."""
    stations = profile_stations(max(truth.s[-1] + truth.ds for truth in truths))
    total, count = np.zeros((2, stations.size)), np.zeros(stations.size)
    for truth in truths:
        reached = stations <= truth.s[-1] + 1e-9
        total[:, reached] += sample_profile(truth, stations[reached])
        count += reached
    return total / np.maximum(count, 1)
