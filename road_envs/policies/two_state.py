"""What two-state dampers have in common: an axle is firm while its dampers do the wanted work.

Of every strut a law makes a number from the body's velocity v and acceleration a above it and from
its rate of extension e' (all up positive, extension positive); an axle is firm while the sum of its
two numbers is positive. v comes from the accelerometers, e' from the struts' own instruments.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from road_envs.config import STRICT
from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import BodyMotionEstimator


@dataclass(kw_only=True)
class TwoStateDamper:
    """`high` where the law asks for damping, else ride; rates leak below `leak` [Hz].

    A positive `bias` makes the axle firm while the sum is somewhat below 0 as well: it is the share
    of the running size of the sum. Needs the instruments "struts".
    """

    __pydantic_config__ = STRICT

    high: Literal["handling", "soft_high"] = "soft_high"
    leak: float = 0.2
    bias: float = 0.0
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        if not self.leak > 0:
            raise ValueError(f"leak must be positive, got {self.leak}")

    def reset(self, context: PolicyContext) -> None:
        """Stand still."""
        self.context, self.body = context, BodyMotionEstimator(context, self.leak)
        self.mean_magnitude, self.decay = (
            np.zeros((context.n_vehicles, 2)),
            np.exp(-context.interval),
        )

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Firm or soft, axle by axle."""
        self.body.update(observations)
        v, a = self.body.at_strut_mounts(self.body.v), self.body.at_strut_mounts(self.body.a)
        work = self.law(v, a, self.context.signal("extension_rate", observations).astype(float))
        axles = work.reshape(-1, 2, 2).sum(axis=2)
        self.mean_magnitude = self.decay * self.mean_magnitude + (1.0 - self.decay) * np.abs(axles)
        return self.context.switch_axles(
            axles + self.bias * self.mean_magnitude > 0, "ride", self.high
        )

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """The number of each strut (N, 4) from v [m/s], a [m/s²] and e' [m/s], each (N, 4)."""
        raise NotImplementedError
