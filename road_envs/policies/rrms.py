"""Running-RMS strategy: handling while lateral acceleration exceeds vertical acceleration.

Els, "The ride comfort vs. handling compromise for off-road vehicles", thesis, Pretoria 2006.
"""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from road_envs.core.config import Positive, Settings
from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator, RunningRms
from road_envs.policies.fixed import Mode


@dataclass(kw_only=True)
class RunningRmsPolicy(Settings):
    """Policy with the state `firm` while the lateral RMS exceeds `ratio` times the RMS of heave.

    Both are RMS accelerations over `window`. Needs the observation group "planar".
    """

    window: Annotated[Positive, "s", "window of both RMS"] = 1.0
    ratio: Annotated[Positive, "", "lateral RMS over the RMS of heave"] = 1.0
    firm: Annotated[Mode, "", "state of both axles in a turn"] = "handling"
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Reset the running RMS."""
        self.context, self.body = context, BodyMotionEstimator(context, leak=1.0)
        self.lateral = RunningRms(context, self.window)
        self.vertical = RunningRms(context, self.window)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,) of ride or the firm state on each axle."""
        return self.context.switch_axles(self.firm_axles(observations), "ride", self.firm)

    def firm_axles(self, observations: np.ndarray) -> np.ndarray:
        """Return which axles (N, 2) are firm."""
        samples = self.context.accelerations(observations).transpose(0, 2, 1)
        vertical = self.vertical.add(samples @ self.body.sensors_to_motion[0])
        lateral = self.lateral.add(self.context.signal("planar", observations)[:, 1])
        return np.repeat((lateral > self.ratio * vertical)[:, None], 2, axis=1)
