"""What a switching policy is given and gives back."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np


class Policy(Protocol):
    """Chooses an action of `RoadRecon-v0` from its observation; never sees the road."""

    def reset(self, actions: int, seed: int) -> None:
        """Begin an episode in an environment that has `actions` actions."""
        ...

    def act(self, observation: np.ndarray) -> int:
        """The action for the next control interval."""
        ...


@runtime_checkable
class Learner(Protocol):
    """A policy that learns before it drives."""

    def learn(
        self,
        options: dict[str, Any],
        steps: int,
        seed: int,
        progress: Callable[[float], None],
    ) -> None:
        """Learn for `steps` control intervals of `RoadRecon-v0` made with `options`.

        `progress` is called with the share done, 0 to 1.
        """
        ...
