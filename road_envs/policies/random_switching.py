"""Random switching, the baseline that every policy should exceed."""

from dataclasses import dataclass, field

import numpy as np

from road_envs.config import STRICT
from road_envs.policies.api import PolicyContext


@dataclass(kw_only=True)
class RandomSwitching:
    """Policy that draws each action with equal probability and holds it for `hold` [s]."""

    __pydantic_config__ = STRICT

    hold: float = 0.1
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        if not self.hold > 0:
            raise ValueError(f"hold must be positive, got {self.hold}")

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
