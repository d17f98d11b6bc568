"""Interface of switching policies, which map observations to actions.

A policy is a dataclass of settings; `reset` initialises its state for an episode. It receives a
PolicyContext and observations, but no `info` and nothing drawn with the road.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.envs import options
from road_envs.envs.options import EnvSetup
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle.parameters import VehicleParameters


class PolicyError(ValueError):
    """Invalid output of a policy, described in one sentence."""


@dataclass(frozen=True)
class PolicyContext:
    """Description of the task given to a policy before it controls `n_vehicles` vehicles.

    `actions`: front and rear state of each action. `observation_slices`: slice of each named part
    of an observation. `interval`: control interval [s]. `car` and `instruments`: nominal values.
    `seed`: for random policies; it is unrelated to the seeds of the roads.
    """

    n_vehicles: int
    actions: tuple[tuple[str, str], ...]
    observation_slices: Mapping[str, slice]
    interval: float
    car: VehicleParameters
    instruments: Instruments
    seed: int

    @classmethod
    def from_setup(cls, setup: EnvSetup, n_vehicles: int, seed: int) -> "PolicyContext":
        """Return the context of `n_vehicles` environments with this `setup`."""
        actions = tuple((a["front"], a["rear"]) for a in setup.actions)
        slices, car, instruments = setup.observation_slices, setup.car, setup.instruments
        return cls(n_vehicles, actions, slices, setup.interval, car, instruments, seed)

    def action_index(self, front: str, rear: str) -> int:
        """Return the action that commands these states. Raises ConfigError if there is none."""
        if self.car.is_passive:
            raise ConfigError(
                f"the car {self.car.name} has passive struts: no policy can switch them"
            )
        if (front, rear) not in self.actions:
            raise ConfigError(
                f"no action commands {front} in front and {rear} at the rear: choose the control "
                "'axle' (ride and handling of each axle) or 'states' (all pairs of states)"
            )
        return self.actions.index((front, rear))

    def switch_axles(self, firm: np.ndarray, low: str, high: str) -> np.ndarray:
        """Return actions (N,) that put axles into `high` where `firm` (N, 2), else into `low`."""
        states = (low, high)
        table = np.array([[self.action_index(front, rear) for rear in states] for front in states])
        return table[firm[:, 0].astype(int), firm[:, 1].astype(int)]

    def signal(self, name: str, observations: np.ndarray) -> np.ndarray:
        """Return a named part (N, ...) of `observations` (N, d). Raises ConfigError without it."""
        if name not in self.observation_slices:
            raise ConfigError(
                f"{name!r} is not observed; the environment's option observe adds 'planar' and "
                f"'struts'"
            )
        return observations[:, self.observation_slices[name]]

    def accelerations(self, observations: np.ndarray) -> np.ndarray:
        """Return the samples (N, S, k) [m/s²] of the accelerometers in the last interval."""
        names = self.instruments.accelerometers
        return np.stack([self.signal(name, observations) for name in names], axis=1)


class Policy(Protocol):
    """Protocol of a policy, which chooses actions of `RoadRecon-v0` from observations alone."""

    def reset(self, context: PolicyContext) -> None:
        """Start an episode of all vehicles of the `context`."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,) for the next control interval, from observations (N, d)."""


def validate_actions(actions: object, context: PolicyContext) -> np.ndarray:
    """Return `actions` as (N,) indices of the action space. Raises PolicyError."""
    try:
        return options.validate_actions(actions, context.n_vehicles, len(context.actions))
    except ConfigError as error:
        raise PolicyError(str(error)) from None
