"""Wiener smoother: the best linear estimate from the whole record for a known vehicle.

The vehicle is linearised about rest with equivalent dampers; the nonlinear residual of the strut
forces is noise of known spectrum (`road_envs.analysis.statistical_linearization`). The roughness,
and with it dampers and noise, is estimated per segment from the record (`spectral_model.py`), so no
training is needed. Missing, clipped or truncated signals only remove information (`smoother.py`).

A vehicle that departs from its description is adapted to the very drive (`adaptation.py`, `adapt`).

Limitations: rough roads at speed, where wheels leave the ground; speed or mode changes within a
segment. Friction limits the accuracy: with linear struts the error would reach the bound.
"""

from dataclasses import dataclass
from typing import ClassVar

from estimators.map_smoother.identified_vehicle import CalibratedByIdentification
from estimators.wiener.smoother import smooth_record
from road_envs.core.config import Positive
from road_envs.records.record import Estimate, Record
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, kw_only=True)
class Wiener(CalibratedByIdentification):
    """One pass of the Wiener smoother for a vehicle with these `instruments`."""

    causal: ClassVar[bool] = False

    std_factor: Positive = 0.93
    adapt: bool = True

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Estimate both wheel paths. Raises ConfigError, RecordError."""
        record, car = self.as_identified(record, car)
        adapt = self.adapt and self.identified is None
        return smooth_record(record, car, self.instruments, 1, self.std_factor, adapt)
