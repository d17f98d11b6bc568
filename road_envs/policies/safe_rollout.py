"""Rollouts on the drives of `RoadRecon/Safe4S4-v1`: one vehicle for each drive, all at once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from road_envs.envs.control_step import StepOutput
from road_envs.envs.individual_fleet import SAFETY_COLUMNS, IndividualFleet
from road_envs.envs.safe4s4 import Safe4S4Setup, SafeStart
from road_envs.policies.api import Policy, PolicyContext, validate_actions
from road_envs.policies.rollout import POLICY_SEED
from road_envs.sensing.data_logger import DataLogger

EXTREMES = ("load_transfer", "roll")
"""Columns of which a drive has the largest value; of the others it has the sum."""

VIOLATION_PRICE = 50.0
"""Price [m²/s⁴] of a violation in the score, per second of `cost` for each second of the drive.

It ranks policies that violate behind all that do not: a drive on two wheels for a tenth of its time
costs 5 m²/s⁴, four times what handling costs in comfort [assumed].
"""


@dataclass(frozen=True)
class SafeRollout:
    """Signals and costs of N drives of at most T intervals.

    `actions` (T, N); `intervals` (N,); `totals` by the names of SAFETY_COLUMNS (N,): sums, of
    EXTREMES the largest value; `failed` (N,): drives that ended in a rollover or diverged;
    `duration` (N,) [s].
    """

    actions: np.ndarray
    intervals: np.ndarray
    totals: Mapping[str, np.ndarray]
    failed: np.ndarray
    duration: np.ndarray

    @cached_property
    def comfort(self) -> np.ndarray:
        """Mean square of the weighted seat acceleration (N,) [m²/s⁴]."""
        return self.totals["comfort"] / self.duration

    @cached_property
    def violated(self) -> np.ndarray:
        """Whether the drives had a violation (N,)."""
        return (self.totals["cost"] > 0.0) | self.failed

    @cached_property
    def score(self) -> np.ndarray:
        """Minus comfort and the price of violations (N,) [m²/s⁴]; a failed drive violates at all
        times.
        """
        share = np.where(self.failed, 1.0, self.totals["cost"] / self.duration)
        return -self.comfort - VIOLATION_PRICE * share


class SafeDrives:
    """Drives of the benchmark, drawn once and driven by many policies.

    `seeds` and the fields `fixed` (one mapping for each seed) draw them. Raises ConfigError.
    """

    def __init__(self, setup: Safe4S4Setup, seeds: Sequence[int], fixed: Sequence[Mapping] = ()):
        self.setup, self.threads = setup, 1
        self.starts: list[tuple[SafeStart, DataLogger]] = []
        for k, seed in enumerate(seeds):
            own: dict[str, Any] = dict(fixed[k]) if fixed else {}
            self.starts.append(setup.prepare(seeding.np_random(seed)[0], own))

    @classmethod
    def mirrored(
        cls, setup: Safe4S4Setup, seeds: Sequence[int], fixed: Sequence[Mapping] = ()
    ) -> "SafeDrives":
        """Return drives, each followed by the same one with its manoeuvres to the other side."""
        sides: list[dict[str, Any]] = []
        for k, seed in enumerate(seeds):
            own: dict[str, Any] = dict(fixed[k]) if fixed else {}
            drawn = setup.describe(seeding.np_random(seed)[0], own)
            other = drawn.mirrored
            sides += [own, own | {"side": other.side, "gentle_side": other.gentle_side}]
        return cls(setup, np.repeat(seeds, 2).tolist(), sides)

    def __len__(self) -> int:
        return len(self.starts)

    def start(self, copies: int = 1, chosen: Sequence[int] | None = None) -> IndividualFleet:
        """Return a fleet at the start of the drives, each in `copies` vehicles in a row."""
        numbers = range(len(self)) if chosen is None else chosen
        fleet = self.setup.make_fleet(copies * len(numbers), self.threads)
        for i, number in enumerate(numbers):
            start, logger = self.starts[number]
            fleet.start(copies * i, start.drive, logger, start.description.speed_kmh)
            for k in range(1, copies):
                fleet.share(copies * i, copies * i + k)
        return fleet


class Totals:
    """Running totals of the drives of a fleet, each up to its own end."""

    def __init__(self, size: int):
        self.values = np.zeros((len(SAFETY_COLUMNS), size))
        self.running, self.failed = np.ones(size, dtype=bool), np.zeros(size, dtype=bool)
        self.intervals, self.extremes = (
            np.zeros(size, dtype=int),
            [SAFETY_COLUMNS.index(name) for name in EXTREMES],
        )

    def add(self, output: StepOutput) -> None:
        """Add one interval."""
        now = np.where(self.running, output.values.T, 0.0)
        largest = np.maximum(self.values[self.extremes], now[self.extremes])
        self.values += now
        self.values[self.extremes] = largest
        self.intervals += self.running
        self.failed |= self.running & output.failed
        self.running &= ~(output.failed | output.end_of_road)

    def rollout(self, actions: np.ndarray, interval: float) -> SafeRollout:
        """Return the totals of drives under `actions` (T, N)."""
        named = dict(zip(SAFETY_COLUMNS, self.values, strict=True))
        return SafeRollout(
            actions, self.intervals, named, self.failed, interval * np.maximum(self.intervals, 1)
        )


def drive_safely(policy: Policy, drives: SafeDrives) -> SafeRollout:
    """Run a policy on all drives to their ends.

    Raises PolicyError for invalid actions, and what the policy raises.
    """
    fleet, setup = drives.start(), drives.setup
    context = PolicyContext.from_setup(setup, len(drives), POLICY_SEED)
    policy.reset(context)
    first = [start.command_byte for start, _ in drives.starts]
    output, totals, actions = fleet.advance(np.array(first, np.uint8)), Totals(len(drives)), []
    while totals.running.any():
        chosen = validate_actions(policy.act(output.observation), context)
        output = fleet.advance(setup.command_bytes[chosen])
        totals.add(output)
        actions.append(chosen.copy())
    return totals.rollout(np.array(actions), setup.interval)
