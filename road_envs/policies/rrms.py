"""Running RMS (Els, "The ride comfort vs. handling compromise for off-road vehicles", thesis,
Pretoria 2006): handling when the lateral acceleration, over about a second, exceeds the vertical.
"""

from dataclasses import dataclass, field

import numpy as np

from road_envs.config import STRICT
from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator, RunningRms


@dataclass(kw_only=True)
class RunningRmsPolicy:
    """Handling on all struts if the RMS of the lateral over `window` [s] exceeds `ratio` times that
    of the heave acceleration, else ride. Needs the instruments "planar".
    """

    __pydantic_config__ = STRICT

    window: float = 1.0
    ratio: float = 1.0
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        for name in ("window", "ratio"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    def reset(self, context: PolicyContext) -> None:
        """Forget the past."""
        self.context, self.body = context, BodyMotionEstimator(context, leak=1.0)
        self.lateral, self.vertical = (
            RunningRms(context, self.window),
            RunningRms(context, self.window),
        )

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Ride or handling."""
        return self.context.switch_axles(self.firm_axles(observations), "ride", "handling")

    def firm_axles(self, observations: np.ndarray) -> np.ndarray:
        """Which axles (N, 2) are to be in handling."""
        heave = (
            self.context.accelerations(observations).transpose(0, 2, 1)
            @ self.body.sensors_to_motion[0]
        )
        vertical = self.vertical.add(heave)
        lateral = self.lateral.add(self.context.signal("planar", observations)[:, 1])
        return np.repeat((lateral > self.ratio * vertical)[:, None], 2, axis=1)
