"""Policy with constant states; `configs/policies` has the paper's two test runs and mixed pairs."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from road_envs.core.config import Settings
from road_envs.policies.api import PolicyContext

Mode = Literal["ride", "handling", "soft_high", "stiff_low"]


@dataclass(kw_only=True)
class FixedPair(Settings):
    """Policy with one state of the front struts and one of the rear struts."""

    front: Mode = "ride"
    rear: Mode = "ride"
    actions: np.ndarray = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Look up the action of the constant states."""
        self.actions = np.full(context.n_vehicles, context.action_index(self.front, self.rear))

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return the same actions at every call."""
        return self.actions
