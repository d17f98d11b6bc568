"""Rollouts of a policy: one vehicle for each drive, all at once, without access to the truth."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from road_envs.envs.instrumented_fleet import InstrumentedFleet
from road_envs.envs.options import EnvSetup
from road_envs.envs.safe4s4 import Safe4S4Setup
from road_envs.policies.api import Policy, PolicyContext, validate_actions

POLICY_SEED = 0  # seed of random policies
EXTREMES = ("load_transfer", "roll")  # columns of which a drive has the largest value, not the sum
KEPT_FLEETS = 2  # fleets that `Drives` keeps to start them again

VIOLATION_PRICE = 50.0
"""Price [m²/s⁴] of a violation in the score, per second of `cost` for each second of the drive.

A drive on two wheels for a tenth of its time costs 5 m²/s⁴, four times what handling costs in
comfort [assumed]; a policy that violates for an instant may still be before one that never does.
"""


@dataclass(frozen=True)
class Rollout:
    """N drives of at most T control intervals under a policy."""

    actions: np.ndarray  # (T, N); those after the end of a drive mean nothing
    rewards: np.ndarray  # (T, N), likewise
    observations: np.ndarray  # (T + 1, N, d), the first one of the interval that reset drives
    intervals: np.ndarray  # (N,): number of them until the end
    totals: Mapping[str, np.ndarray]  # (N,) by the fleet's columns: sums, of EXTREMES the largest
    reasons: tuple[str, ...]  # (N,): why a drive failed, else empty
    interval: float  # [s]

    @property
    def returns(self) -> np.ndarray:
        """Sum of the rewards (N,)."""
        return self.totals["reward"]

    @property
    def failed(self) -> np.ndarray:
        """Drives (N,) that ended in a rollover or diverged."""
        return np.array([reason != "" for reason in self.reasons])

    @property
    def duration(self) -> np.ndarray:
        """Time [s] that the policy has driven (N,)."""
        return self.interval * np.maximum(self.intervals, 1)

    @cached_property
    def comfort(self) -> np.ndarray:
        """Mean square of the weighted seat acceleration (N,) [m²/s⁴], of `Safe4S4-v1`."""
        return self.totals["comfort"] / self.duration

    @cached_property
    def violated(self) -> np.ndarray:
        """Whether the drives of `Safe4S4-v1` had a violation (N,)."""
        return (self.totals["cost"] > 0.0) | self.failed

    @cached_property
    def score(self) -> np.ndarray:
        """Minus comfort and the price of violations (N,) [m²/s⁴], of `Safe4S4-v1`."""
        # a failed drive violates at all times
        share = np.where(self.failed, 1.0, self.totals["cost"] / self.duration)
        return -self.comfort - VIOLATION_PRICE * share


class Drives:
    """Drives of an environment, drawn once and driven by many policies: one by each of `seeds`,
    with its own options of a reset in `options`, by default none. Raises ConfigError.
    """

    def __init__(self, setup: EnvSetup, seeds: Sequence[int], options: Sequence[Any] = ()):
        self.setup, self.threads = setup, 1
        own: Sequence[Any] = options or [setup.options] * len(seeds)
        self.starts = [
            setup.prepare(seeding.np_random(seed)[0], o) for seed, o in zip(seeds, own, strict=True)
        ]
        self._fleets: dict[Any, tuple[InstrumentedFleet, list[np.ndarray]]] = {}

    @classmethod
    def mirrored(
        cls, setup: Safe4S4Setup, seeds: Sequence[int], options: Sequence[Mapping[str, Any]] = ()
    ) -> "Drives":
        """Return drives, each followed by the same one with its manoeuvres to the other side."""
        sides: list[dict[str, Any]] = []
        for k, seed in enumerate(seeds):
            own: dict[str, Any] = dict(options[k]) if options else {}
            other = setup.draw(seeding.np_random(seed)[0], own)[0].mirrored
            sides += [own, own | {"side": other.side, "gentle_side": other.gentle_side}]
        return cls(setup, np.repeat(seeds, 2).tolist(), sides)

    def __len__(self) -> int:
        return len(self.starts)

    def alone(self) -> "Drives":
        """Return the same drives with fleets of their own, of one thread: for one of several."""
        other = copy.copy(self)
        other.threads, other._fleets = 1, {}
        return other

    def start(self, copies: int = 1, chosen: Sequence[int] | None = None) -> InstrumentedFleet:
        """Return a fleet at the start of the drives, each in `copies` vehicles in a row. It has
        driven the interval of a reset. The same call returns the same fleet, started again.
        """
        numbers = tuple(range(len(self)) if chosen is None else chosen)
        if (copies, numbers) not in self._fleets:
            if len(self._fleets) >= KEPT_FLEETS:
                self._fleets.pop(next(iter(self._fleets)))
            size = len(numbers)
            fleet = self.setup.make_fleet(copies * size, distinct=size, threads=self.threads)
            for i, number in enumerate(numbers):
                start = self.starts[number]
                fleet.start(copies * i, start.drive, start.logger, start.speed_kmh)
                fleet.share(copies * i, range(copies * i + 1, copies * (i + 1)))
            self._fleets[copies, numbers] = fleet, fleet.copy_state()
        fleet, state = self._fleets[copies, numbers]
        fleet.restore_state(state)
        return fleet

    def first_bytes(self, copies: int = 1) -> np.ndarray:
        """Return the commands (copies N,) of the interval that a reset drives."""
        return np.repeat([start.command_byte for start in self.starts], copies).astype(np.uint8)


def roll_out(
    policy: Policy,
    options: dict[str, Any],
    seeds: Sequence[int],
    *,
    store_observations: bool = True,
) -> Rollout:
    """Run `drive_all` on the roads of `seeds`, in `RoadRecon-v0` with `options`."""
    drives = Drives(EnvSetup({**options, "truth": False}), seeds)
    return drive_all(policy, drives, store_observations=store_observations)


def drive_all(policy: Policy, drives: Drives, *, store_observations: bool = False) -> Rollout:
    """Run a policy on all drives to their ends; without `store_observations` only the first ones
    are stored. Raises PolicyError for invalid actions, and what the policy raises.
    """
    setup, fleet = drives.setup, drives.start()
    size, columns = fleet.n_vehicles, fleet.columns
    context = PolicyContext.from_setup(setup, size, POLICY_SEED)
    policy.reset(context)
    output, totals = fleet.advance(drives.first_bytes()), np.zeros((len(columns), size))
    extremes = [columns.index(name) for name in EXTREMES if name in columns]
    running, intervals = np.ones(size, dtype=bool), np.zeros(size, dtype=int)
    reasons, actions, rewards, observations = [""] * size, [], [], [output.observation]
    while running.any():
        chosen = validate_actions(policy.act(output.observation), context)
        output = fleet.advance(setup.command_bytes[chosen])
        now = np.where(running, output.values.T, 0.0)
        largest = np.maximum(totals[extremes], now[extremes])
        totals += now
        totals[extremes] = largest
        intervals += running
        for i in np.flatnonzero(running & output.failed).tolist():
            _, reasons[i] = setup.failure(output, i, drives.starts[i].drive.surface.name)
        running &= ~(output.failed | output.end_of_road)
        actions.append(chosen.copy())
        rewards.append(setup.rewards(output.values))
        if store_observations:
            observations.append(output.observation)
    arrays = np.array(actions), np.array(rewards), np.array(observations)
    named = dict(zip(columns, totals, strict=True))
    return Rollout(*arrays, intervals, named, tuple(reasons), setup.interval)


@dataclass
class _Recorded:
    """Policy that repeats `actions` (T, N), and the last ones from then on."""

    actions: np.ndarray

    def reset(self, context: PolicyContext) -> None:
        self.at = -1

    def act(self, observations: np.ndarray) -> np.ndarray:
        self.at = min(self.at + 1, len(self.actions) - 1)
        return self.actions[self.at]


def replay(drives: Drives, actions: np.ndarray) -> Rollout:
    """Drive all N drives under `actions` (T, N)."""
    return drive_all(_Recorded(actions), drives)
