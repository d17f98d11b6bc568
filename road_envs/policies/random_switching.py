"""States drawn anew now and then: the floor for anything that claims to choose."""

from dataclasses import dataclass, field

import numpy as np

from road_envs.config import STRICT
from road_envs.policies.api import PolicyContext


@dataclass(kw_only=True)
class RandomSwitching:
    """Each action with equal chance, held for `hold` [s]."""

    __pydantic_config__ = STRICT

    hold: float = 0.1
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        if not self.hold > 0:
            raise ValueError(f"hold must be positive, got {self.hold}")

    def reset(self, context: PolicyContext) -> None:
        """Seed the draws."""
        self.context, self.rng, self.done = context, np.random.default_rng(context.seed), 0

    def act(self, observations: np.ndarray) -> np.ndarray:
        """The last draw, or a new one."""
        if self.done % max(1, round(self.hold / self.context.interval)) == 0:
            self.actions = self.rng.integers(
                len(self.context.actions), size=self.context.n_vehicles
            )
        self.done += 1
        return self.actions
