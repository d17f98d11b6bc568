"""The mean of the training roads: what memory of them is worth without any measurement.

At each station the heights of those training roads that reach so far are averaged, each wheel path
for itself. Beyond the longest of them nothing is remembered and the road is level at zero. On new
roads this is close to `flat` (independent roads average out); on a board whose test road is an
altered training road it is nearly the truth, and shows that the board asks for memory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from estimators.api import copy_with, require_fitted, validate_weights
from estimators.preprocessing import sample_profile
from road_envs.config import STRICT
from road_envs.data.record import Estimate, Profile, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, kw_only=True)
class Mean:
    """The mean training road, whatever was measured."""

    __pydantic_config__ = STRICT
    causal: ClassVar[bool] = True

    z: np.ndarray | None = field(default=None, init=False, repr=False, compare=False)
    """Mean heights (2, M) [m] on the grid, as far as the longest training road."""

    def fit(
        self,
        records: Sequence[Record],
        truths: Sequence[Profile],
        car: VehicleParameters,
        seed: int,
    ) -> Self:
        """Average the truths; records, car and seed play no part."""
        return copy_with(self, z=mean_profile(truths))

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """The mean road, cut or continued at zero to the record's length."""
        mean = require_fitted(self.z, self)
        stations = profile_stations(record.length)
        z = np.zeros((2, stations.size))
        shared = min(stations.size, mean.shape[1])
        z[:, :shared] = mean[:, :shared]
        return Estimate(stations, z)

    def weights(self) -> dict[str, np.ndarray]:
        """`z` (2, M)."""
        return {"z": require_fitted(self.z, self)}

    def with_weights(self, weights: Mapping[str, np.ndarray]) -> Self:
        """A copy with these weights. Raises ValueError."""
        (z,) = validate_weights(weights, {"z": (2, None)})
        return copy_with(self, z=z)


def mean_profile(truths: Sequence[Profile]) -> np.ndarray:
    """Mean heights (2, M) [m] on the grid over the truths that reach each station."""
    stations = profile_stations(max(truth.s[-1] + truth.ds for truth in truths))
    total, count = np.zeros((2, stations.size)), np.zeros(stations.size)
    for truth in truths:
        reached = stations <= truth.s[-1] + 1e-9
        total[:, reached] += sample_profile(truth, stations[reached])
        count += reached
    return total / np.maximum(count, 1)
