"""One setting for the whole drive: what the paper's test runs did, and the two mixed pairs."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from road_envs.config import STRICT
from road_envs.policies.api import PolicyContext


@dataclass(kw_only=True)
class FixedRide:
    """All struts soft with low damping."""

    __pydantic_config__ = STRICT
    states: ClassVar[tuple[str, str]] = ("ride", "ride")

    actions: np.ndarray = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        """Note the action."""
        self.actions = np.full(context.n_vehicles, context.action_index(*self.states))

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Always the same."""
        return self.actions


@dataclass(kw_only=True)
class FixedHandling(FixedRide):
    """All struts stiff with high damping."""

    states = ("handling", "handling")


@dataclass(kw_only=True)
class FixedRideHandling(FixedRide):
    """Ride in front, handling at the rear: different states make roll see all of the road."""

    states = ("ride", "handling")


@dataclass(kw_only=True)
class FixedHandlingRide(FixedRide):
    """Handling in front, ride at the rear."""

    states = ("handling", "ride")
