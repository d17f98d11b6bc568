"""What two-state dampers have in common: an axle is firm while its dampers do the wanted work.

Of every strut a law makes a number from the body's velocity v and acceleration a above it and from
its rate of extension e' (all up positive, extension positive); an axle is firm while the sum of its
two numbers is positive. v comes from the accelerometers, e' from the struts' own instruments.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from road_envs.config import STRICT
from road_envs.policies.api import Cabin
from road_envs.policies.body_motion import Body


@dataclass(kw_only=True)
class TwoState:
    """`high` where the law asks for damping, else ride; rates leak below `leak` [Hz].

    A positive `bias` makes the axle firm while the sum is somewhat below 0 as well: it is the share
    of the running size of the sum. Needs the instruments "struts".
    """

    __pydantic_config__ = STRICT

    high: Literal["handling", "soft_high"] = "soft_high"
    leak: float = 0.2
    bias: float = 0.0
    cabin: Cabin = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        if not self.leak > 0:
            raise ValueError(f"leak must be positive, got {self.leak}")

    def reset(self, cabin: Cabin) -> None:
        """Stand still."""
        self.cabin, self.body = cabin, Body(cabin, self.leak)
        self.size, self.decay = np.zeros((cabin.number, 2)), np.exp(-cabin.interval)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Firm or soft, axle by axle."""
        self.body.feel(observations)
        v, a = self.body.at_struts(self.body.v), self.body.at_struts(self.body.a)
        work = self.law(v, a, self.cabin.part("extension_rate", observations).astype(float))
        axles = work.reshape(-1, 2, 2).sum(axis=2)
        self.size = self.decay * self.size + (1.0 - self.decay) * np.abs(axles)
        return self.cabin.switch(axles + self.bias * self.size > 0, "ride", self.high)

    def law(self, v: np.ndarray, a: np.ndarray, e_dot: np.ndarray) -> np.ndarray:
        """The number of each strut (N, 4) from v [m/s], a [m/s²] and e' [m/s], each (N, 4)."""
        raise NotImplementedError
