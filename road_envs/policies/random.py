"""A state drawn anew at every control interval: the floor for anything that claims to choose."""

import numpy as np


class RandomSwitching:
    """Each action with equal chance."""

    def reset(self, actions: int, seed: int) -> None:
        """Seed the draws."""
        self.actions, self.rng = actions, np.random.default_rng(seed)

    def act(self, observation: np.ndarray) -> int:
        """One draw."""
        return int(self.rng.integers(self.actions))
