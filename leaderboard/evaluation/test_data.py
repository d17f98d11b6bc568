"""Simulated drives over a task's roads under one condition, each record with its true profile."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from leaderboard.evaluation.tasks import Condition, DriveSet, Task
from road_envs.data.record import Profile, Record
from road_envs.data.recording import simulate_record


@dataclass(frozen=True)
class RecordedDrive:
    """One drive over the `road` realised by `seed`; `index` counts the roads of the drive set."""

    index: int
    road: str
    seed: int
    record: Record
    truth: Profile
    notes: tuple[str, ...] = ()


DriveSimulation = Callable[[Task, DriveSet, Condition], Iterator[RecordedDrive]]
"""Function that simulates drives: `simulate_drives`, or a faster substitute in tests."""


def simulate_drives(task: Task, drives: DriveSet, condition: Condition) -> Iterator[RecordedDrive]:
    """Yield a drive of the task's vehicle for each road and seed.

    A seed realises the same road under every condition. Sensor noise has a separate random stream
    for each seed and condition. Raises ConfigError, SimulationError.
    """
    car, instruments = task.vehicle, task.sensors
    if not drives.noise:
        instruments = dataclasses.replace(instruments, noise_density=0.0, speed_error=0.0)
    for index, road, seed in task.drives_of(drives, condition):
        surface = road.realise(np.random.default_rng(seed))
        record, truth = simulate_record(
            surface,
            vehicle=car,
            speed_kmh=condition.speed_kmh,
            mode=condition.simulator_mode,
            instruments=instruments,
            seed=np.random.SeedSequence([seed, task.seed_stream(condition)]),
            step=drives.step,
            grade=task.grade(drives, condition),
        )
        yield RecordedDrive(index, surface.name, seed, record, truth, surface.notes)


def lock_arrays(drive: RecordedDrive) -> RecordedDrive:
    """Make the arrays of a drive read-only and return the drive."""
    # all entries share the arrays: an entry that writes into them fails instead of changing them
    for holder in (drive.record, drive.truth):
        for value in vars(holder).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
    return drive
