"""Handling while the body leans over its axles by more than a threshold, and a while longer."""

from dataclasses import dataclass, field

import numpy as np

from road_envs.config import STRICT
from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import roll_from_extensions


@dataclass(kw_only=True)
class RollAngle:
    """Handling once roll exceeds `threshold` [rad], until it has stayed below for `hold` [s].

    Needs the instruments "struts".
    """

    __pydantic_config__ = STRICT

    threshold: float = 0.03
    hold: float = 0.5
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        if not (self.threshold > 0 and self.hold >= 0):
            raise ValueError("threshold must be positive and hold must not be negative")

    def reset(self, context: PolicyContext) -> None:
        """Stand upright."""
        self.context, self.calm = context, np.full(context.n_vehicles, np.inf)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Ride or handling."""
        leaning = np.abs(roll_from_extensions(self.context, observations)) > self.threshold
        self.calm = np.where(leaning, 0.0, self.calm + self.context.interval)
        firm = np.repeat((self.calm <= self.hold)[:, None], 2, axis=1)
        return self.context.switch_axles(firm, "ride", "handling")
