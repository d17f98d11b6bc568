"""One setting for the whole drive: what the paper's test runs did."""

import numpy as np


class FixedRide:
    """All struts soft with low damping."""

    def reset(self, actions: int, seed: int) -> None:
        """Nothing to prepare."""

    def act(self, observation: np.ndarray) -> int:
        """Ride, always: the first action."""
        return 0


class FixedHandling:
    """All struts stiff with high damping."""

    def reset(self, actions: int, seed: int) -> None:
        """Note which action is handling: the last one."""
        self.action = actions - 1

    def act(self, observation: np.ndarray) -> int:
        """Handling, always."""
        return self.action
