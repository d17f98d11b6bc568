"""States drawn anew now and then: the floor for anything that claims to choose."""

from dataclasses import dataclass, field

import numpy as np

from road_envs.config import STRICT
from road_envs.policies.api import Cabin


@dataclass(kw_only=True)
class RandomSwitching:
    """Each action with equal chance, held for `hold` [s]."""

    __pydantic_config__ = STRICT

    hold: float = 0.1
    cabin: Cabin = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        if not self.hold > 0:
            raise ValueError(f"hold must be positive, got {self.hold}")

    def reset(self, cabin: Cabin) -> None:
        """Seed the draws."""
        self.cabin, self.rng, self.done = cabin, np.random.default_rng(cabin.seed), 0

    def act(self, observations: np.ndarray) -> np.ndarray:
        """The last draw, or a new one."""
        if self.done % max(1, round(self.hold / self.cabin.interval)) == 0:
            self.actions = self.rng.integers(len(self.cabin.actions), size=self.cabin.number)
        self.done += 1
        return self.actions
