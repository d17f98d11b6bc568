"""Roll threshold: handling while the body rolls relative to its axles, and for a time after."""

from dataclasses import dataclass, field

import numpy as np

from road_envs.config import STRICT
from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import roll_from_extensions


@dataclass(kw_only=True)
class RollAngle:
    """Policy with handling while the roll exceeds `threshold` [rad], and for `hold` [s] after.

    Needs the observation group "struts".
    """

    __pydantic_config__ = STRICT

    threshold: float = 0.03
    hold: float = 0.5
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        if not (self.threshold > 0 and self.hold >= 0):
            raise ValueError(
                f"threshold must be positive and hold must not be negative, got {self.threshold} "
                f"and {self.hold}"
            )

    def reset(self, context: PolicyContext) -> None:
        """Start without roll."""
        self.context, self.time_below = context, np.full(context.n_vehicles, np.inf)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,) of ride or handling on both axles."""
        exceeded = np.abs(roll_from_extensions(self.context, observations)) > self.threshold
        self.time_below = np.where(exceeded, 0.0, self.time_below + self.context.interval)
        firm = np.repeat((self.time_below <= self.hold)[:, None], 2, axis=1)
        return self.context.switch_axles(firm, "ride", "handling")
