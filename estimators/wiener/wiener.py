"""Wiener smoothers: estimates from the whole record for a known vehicle, in the frequency domain.

The vehicle is linearised about rest with equivalent dampers; the nonlinear residual of the strut
forces is noise of known spectrum (`road_envs.analysis.statistical_linearization`). The roughness,
and with it dampers and noise, is estimated per segment from the record (`spectral_model.py`), so no
training is needed. Missing, clipped or truncated signals only remove information (`smoother.py`).

    wiener            the best linear estimate. With linear struts the error would reach the bound
    iterated_wiener   each further pass computes the deviation of friction and damper curves from
                      the equivalent dampers on the estimated strut motion (its expectation where
                      that is uncertain), subtracts it from the accelerations and smooths again
                      (`iteration.py`): a dozen passes come close to the maximum a posteriori
                      estimate with the nonlinear vehicle, at the cost of Fourier transforms

A vehicle that departs from its description is adapted to the very drive (`adaptation.py`, `adapt`).

Limitations: rough roads at speed, where wheels leave the ground (there the passes diverge, and the
result is no better than that of `wiener`); speed or mode changes within a segment.
"""

from dataclasses import dataclass
from typing import ClassVar

from estimators.map_smoother.identified_vehicle import CalibratedByIdentification
from estimators.wiener.smoother import smooth_record
from road_envs.core.config import Count, Positive
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
        return self._estimate(record, car, 1)

    def _estimate(self, record: Record, car: VehicleParameters, passes: int) -> Estimate:
        record, car = self.as_identified(record, car)
        adapt = self.adapt and self.identified is None
        return smooth_record(record, car, self.instruments, passes, self.std_factor, adapt)


@dataclass(frozen=True, kw_only=True)
class IteratedWiener(Wiener):
    """Up to `passes` passes of the Wiener smoother for a vehicle with these `instruments`."""

    passes: Count = 15
    std_factor: Positive = 0.88

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Estimate both wheel paths. Raises ConfigError, RecordError."""
        return self._estimate(record, car, self.passes)
