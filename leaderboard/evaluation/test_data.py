"""The judge's drives: a task's roads under one condition, with the truth beside the record."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from leaderboard.evaluation.tasks import Condition, DriveSet, Task
from road_envs.data.record import Profile, Record
from road_envs.data.recording import simulate_record


@dataclass(frozen=True)
class RecordedDrive:
    """One drive over the `road` realised by `seed`."""

    road: str
    seed: int
    record: Record
    truth: Profile
    notes: tuple[str, ...] = ()


DriveSimulation = Callable[[Task, DriveSet, Condition], Iterator[RecordedDrive]]
"""What makes drives; `simulate_drives` is the one that counts, tests bring a faster one."""


def simulate_drives(task: Task, drives: DriveSet, condition: Condition) -> Iterator[RecordedDrive]:
    """Drive the task's car. Raises ConfigError, SimulationError.

    A road seed realises its road, the same one under every condition; the noise of the
    instruments has a stream of its own for each seed and condition.
    """
    car, instruments = task.vehicle, task.sensors
    if not drives.noise:
        instruments = dataclasses.replace(instruments, noise_density=0.0, speed_error=0.0)
    for road, seed in drives.roads_and_seeds:
        surface = road.realise(np.random.default_rng(seed))
        record, truth = simulate_record(
            car,
            surface,
            speed_kmh=condition.speed_kmh,
            mode=condition.simulator_mode,
            instruments=instruments,
            seed=np.random.SeedSequence([seed, task.seed_stream(condition)]),
            step=drives.step,
            grade=task.grade(drives, condition),
        )
        yield RecordedDrive(surface.name, seed, record, truth, surface.notes)


def lock_arrays(drive: RecordedDrive) -> RecordedDrive:
    """Lock the arrays of a drive, which all entries share: one that writes into them fails."""
    for holder in (drive.record, drive.truth):
        for value in vars(holder).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
    return drive
