"""Base class of policies with two damper states, chosen axle by axle from a control law.

The law gives a value for each strut from the velocity v and the acceleration a of the body above
it and from its rate of extension e' (v and a positive upwards, extension positive). An axle is in
the high state while the sum over its two struts is positive. v is integrated from the
accelerometers, e' is measured at the struts.
"""

import abc
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from road_envs.core.config import Positive, Settings
from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator


@dataclass(kw_only=True)
class TwoStateDamper(Settings, abc.ABC):
    """Policy with state `high` where the law is positive, else ride.

    `bias` shifts the threshold by a share of the running mean magnitude of the sum; a positive one
    makes `high` more frequent. Needs the observation group "struts".
    """

    high: Literal["handling", "soft_high"] = "soft_high"
    leak: Annotated[Positive, "Hz", "corner of the integration of body rates"] = 0.2
    bias: float = 0.0
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Set the body motion and the mean magnitude to zero."""
        self.context, self.body = context, BodyMotionEstimator(context, self.leak)
        self.mean_magnitude = np.zeros((context.n_vehicles, 2))
        self.decay = np.exp(-context.interval)  # time constant of 1 s

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,) for the next control interval, from observations (N, d)."""
        self.body.update(observations)
        v, a = self.body.at_strut_mounts(self.body.v), self.body.at_strut_mounts(self.body.a)
        work = self.law(v, a, self.context.signal("extension_rate", observations).astype(float))
        axles = work.reshape(-1, 2, 2).sum(axis=2)
        self.mean_magnitude = self.decay * self.mean_magnitude + (1.0 - self.decay) * np.abs(axles)
        firm = axles + self.bias * self.mean_magnitude > 0
        return self.context.switch_axles(firm, "ride", self.high)

    @abc.abstractmethod
    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """Return a value for each strut (N, 4) from v [m/s], a [m/s²] and e' [m/s], all (N, 4)."""
