"""Policies without observations: constant states (the paper's test runs, mixed pairs), random."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from road_envs.core.config import Positive, Settings
from road_envs.policies.api import PolicyContext

Mode = Literal["ride", "handling", "soft_high", "stiff_low"]


@dataclass(kw_only=True)
class FixedPair(Settings):
    """Policy with one state of the front struts and one of the rear struts."""

    front: Mode = "ride"
    rear: Mode = "ride"
    actions: np.ndarray = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        self.actions = np.full(context.n_vehicles, context.action_index(self.front, self.rear))

    def act(self, observations: np.ndarray) -> np.ndarray:
        return self.actions


@dataclass(kw_only=True)
class RandomSwitching(Settings):
    """Policy that draws each action with equal probability and holds it for `hold`."""

    hold: Annotated[Positive, "s", "duration of an action"] = 0.1
    context: PolicyContext = field(init=False, repr=False, compare=False)

    def reset(self, context: PolicyContext) -> None:
        self.context, self.rng = context, np.random.default_rng(context.seed)
        self.n_intervals = 0

    def act(self, observations: np.ndarray) -> np.ndarray:
        context = self.context
        if self.n_intervals % max(1, round(self.hold / context.interval)) == 0:
            self.actions = self.rng.integers(len(context.actions), size=context.n_vehicles)
        self.n_intervals += 1
        return self.actions
