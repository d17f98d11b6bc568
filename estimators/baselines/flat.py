"""Level road: the baseline that every estimator must beat."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from estimators.preprocessing import mask_record
from road_envs.core.config import Settings
from road_envs.records.record import Estimate, Record, profile_stations
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, kw_only=True)
class FlatEstimator(Settings):
    """Baseline: zero everywhere; its in-band error is the level of the truth by definition."""

    causal: ClassVar[bool] = True

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Return zero heights (2, M) [m]. Raises RecordError."""
        notes = mask_record(record).notes
        stations = profile_stations(record.length)
        return Estimate(stations, np.zeros((2, stations.size)), notes=notes)
