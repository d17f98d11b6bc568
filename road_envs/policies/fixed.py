"""Policies with constant states: the two of the paper's test runs, and the two mixed pairs."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from road_envs.core.config import Settings
from road_envs.policies.api import PolicyContext


@dataclass(kw_only=True)
class FixedRide(Settings):
    """Policy with all struts soft and low damping."""

    states: ClassVar[tuple[str, str]] = ("ride", "ride")

    actions: np.ndarray = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Look up the action of the constant states."""
        self.actions = np.full(context.n_vehicles, context.action_index(*self.states))

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return the same actions at every call."""
        return self.actions


@dataclass(kw_only=True)
class FixedHandling(FixedRide):
    """Policy with all struts stiff and high damping."""

    states = ("handling", "handling")


@dataclass(kw_only=True)
class FixedRideHandling(FixedRide):
    """Policy with ride in front and handling at the rear.

    With different states in front and at the rear the roll motion responds to all frequencies.
    """

    states = ("ride", "handling")


@dataclass(kw_only=True)
class FixedHandlingRide(FixedRide):
    """Policy with handling in front and ride at the rear."""

    states = ("handling", "ride")
