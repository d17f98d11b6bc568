"""Wiener smoother, again and again with the struts' nonlinear forces taken out of the signals.

Friction and the dampers' curves are what keeps a linear estimator from the bound. They are laws of
the struts' motion, which the estimate itself tells: so their deviation from the equivalent dampers
is computed, with its expected value where the motion is uncertain, taken out of the accelerations,
and the smoother runs again (`smoothing.py`). A dozen passes come near to what the maximum a
posteriori road through the nonlinear car has, at the price of Fourier transforms.

Known to fail: as `wiener`; where wheels leave the ground the passes do not converge, and it is no
better than that one.
"""

from dataclasses import dataclass
from typing import ClassVar

from estimators.wiener.smoother import smooth_record
from road_envs.config import STRICT
from road_envs.data.record import Estimate, Record
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, kw_only=True)
class IteratedWiener:
    """At most `passes` of the smoother for a car with these `instruments`."""

    __pydantic_config__ = STRICT
    causal: ClassVar[bool] = False

    instruments: str = "paper"
    passes: int = 15
    std_factor: float = 0.88

    def __post_init__(self):
        if self.passes < 1:
            raise ValueError(f"passes must be at least 1, got {self.passes}")

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Both wheel paths. Raises ConfigError, ValueError."""
        return smooth_record(record, car, self.instruments, self.passes, self.std_factor)
