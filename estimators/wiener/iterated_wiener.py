"""Wiener smoother, iterated: the struts' nonlinear force residuals are subtracted from the signals.

Friction and damper curves keep a linear estimator above the error bound. Both are functions of the
strut motion, which the estimate provides. Each pass computes their deviation from the equivalent
dampers (its expectation where the motion is uncertain), subtracts it from the accelerations and
smooths again (`smoother.py`). A dozen passes come close to the accuracy of the maximum a posteriori
estimate with the nonlinear vehicle, at the cost of Fourier transforms.

A vehicle that departs from its description is adapted to the very drive (`adaptation.py`, `adapt`).

Limitations: as `wiener`; where wheels leave the ground the passes diverge and the result is no
better than that of `wiener`.
"""

from dataclasses import dataclass
from typing import ClassVar

from estimators.map_smoother.identified_vehicle import CalibratedByIdentification
from estimators.wiener.smoother import smooth_record
from road_envs.core.config import Count, Positive
from road_envs.records.record import Estimate, Record
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, kw_only=True)
class IteratedWiener(CalibratedByIdentification):
    """Up to `passes` passes of the Wiener smoother for a vehicle with these `instruments`."""

    causal: ClassVar[bool] = False

    passes: Count = 15
    std_factor: Positive = 0.88
    adapt: bool = True

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Estimate both wheel paths. Raises ConfigError, RecordError."""
        record, car = self.as_identified(record, car)
        adapt = self.adapt and self.identified is None
        return smooth_record(record, car, self.instruments, self.passes, self.std_factor, adapt)
