"""Random switching, the baseline that every policy should exceed."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from road_envs.core.config import Positive, Settings
from road_envs.policies.api import PolicyContext


@dataclass(kw_only=True)
class RandomSwitching(Settings):
    """Policy that draws each action with equal probability and holds it for `hold`."""

    hold: Annotated[Positive, "s", "duration of an action"] = 0.1
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Seed the random generator."""
        self.context, self.rng = context, np.random.default_rng(context.seed)
        self.n_intervals = 0

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,), new ones after every `hold` seconds."""
        context = self.context
        if self.n_intervals % max(1, round(self.hold / context.interval)) == 0:
            self.actions = self.rng.integers(len(context.actions), size=context.n_vehicles)
        self.n_intervals += 1
        return self.actions
