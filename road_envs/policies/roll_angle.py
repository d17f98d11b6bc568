"""Roll threshold: handling while the body rolls relative to its axles, and for a time after."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from road_envs.core.config import NonNegative, Positive, Settings
from road_envs.policies.api import PolicyContext
from road_envs.policies.body_motion import roll_from_extensions


@dataclass(kw_only=True)
class RollAngle(Settings):
    """Policy with handling while the roll exceeds `threshold`, and for `hold` after.

    Needs the observation group "struts".
    """

    threshold: Annotated[Positive, "rad", "roll beyond which handling is chosen"] = 0.03
    hold: Annotated[NonNegative, "s", "time for which handling is kept"] = 0.5
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Start without roll."""
        self.context, self.time_below = context, np.full(context.n_vehicles, np.inf)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,) of ride or handling on both axles."""
        exceeded = np.abs(roll_from_extensions(self.context, observations)) > self.threshold
        self.time_below = np.where(exceeded, 0.0, self.time_below + self.context.interval)
        firm = np.repeat((self.time_below <= self.hold)[:, None], 2, axis=1)
        return self.context.switch_axles(firm, "ride", "handling")
