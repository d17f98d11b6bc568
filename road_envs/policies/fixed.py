"""Policies with constant states: any pair, the paper's two test runs, and two mixed pairs."""

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


@dataclass(kw_only=True)
class FixedRide(FixedPair):
    """Policy with all struts soft and low damping."""


@dataclass(kw_only=True)
class FixedHandling(FixedPair):
    """Policy with all struts stiff and high damping."""

    front: Mode = "handling"
    rear: Mode = "handling"


@dataclass(kw_only=True)
class FixedRideHandling(FixedPair):
    """Policy with ride in front and handling at the rear.

    With different states in front and at the rear the roll motion responds to all frequencies.
    """

    rear: Mode = "handling"


@dataclass(kw_only=True)
class FixedHandlingRide(FixedPair):
    """Policy with handling in front and ride at the rear."""

    front: Mode = "handling"
