"""Wiener smoother: the best linear estimate from the whole record, with the car known.

The car is linearised about rest, with the dampers that err least for the motion at hand; what its
struts do besides is noise of known spectrum (`road_envs.analysis.statistical_linearization`). The roughness, and with it
the dampers and that noise, is estimated from the record itself (`build_model.py`), stretch by stretch,
so that nothing is learnt beforehand. Missing, clipped or cut signals cost only what they would have
told (`smoothing.py`).

Known to fail: on rough roads at speed, where wheels leave the ground; when speed or mode change
within a stretch. Friction sets its limit: the same car with linear struts would be at the bound.
"""

from dataclasses import dataclass
from typing import ClassVar

from estimators.wiener.smoother import smooth_record
from road_envs.config import STRICT
from road_envs.data.record import Estimate, Record
from road_envs.vehicle.parameters import VehicleParameters


@dataclass(frozen=True, kw_only=True)
class Wiener:
    """The smoother for a car with these `instruments`."""

    __pydantic_config__ = STRICT
    causal: ClassVar[bool] = False

    instruments: str = "paper"
    std_factor: float = 0.93

    def estimate(self, record: Record, car: VehicleParameters) -> Estimate:
        """Both wheel paths. Raises ConfigError, ValueError."""
        return smooth_record(record, car, self.instruments, 1, self.std_factor)
