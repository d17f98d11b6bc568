"""Simulated drives over a task's roads under one condition, each record with its true profile."""

import dataclasses
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from estimators.api import CalibrationDrive
from leaderboard.evaluation.drive_set import DriveSet
from leaderboard.evaluation.tasks import Condition, ModeAndSpeed, Task
from leaderboard.kept_drives import drive_of_plant
from road_envs.core.config import ConfigError
from road_envs.core.extras import EXTRAS
from road_envs.drives.recording import simulate_record
from road_envs.kernels.filters import LOW_PASS_ORDER, preprocess_accelerations
from road_envs.records.record import LowPass, Profile, Record
from road_envs.roads import Road, Surface


@dataclass(frozen=True)
class RecordedDrive:
    """One drive over the `road` realised by `seed`; `index` counts the roads of the drive set."""

    index: int
    road: str
    seed: int
    record: Record
    truth: Profile
    notes: tuple[str, ...] = ()
    calibration: tuple[CalibrationDrive, ...] = ()


_CALIBRATION = 1  # stream of the noise of calibration drives; test drives have one number only
DriveSimulation = Callable[[Task, DriveSet, Condition], Iterator[RecordedDrive]]
"""Function that simulates drives: `simulate_drives`, or a faster substitute in tests."""


def simulate_drives(
    task: Task, drives: DriveSet, condition: Condition, chosen: Container[int] | None = None
) -> Iterator[RecordedDrive]:
    """Yield a drive of the task's vehicle for each road and seed.

    A seed realises the same road under every condition, and draws the vehicle that drives there;
    `calibration` holds other drives of it. Sensor noise has a separate random stream for each seed
    and condition. Of the test drives only the `chosen` indices are simulated, if given. Raises
    ConfigError, SimulationError.
    """
    for index, road, seed in task.drives_of(drives, condition):
        if chosen is not None and drives is task.test and index not in chosen:
            continue
        drive = simulate_drive(task, drives, condition, road, seed)
        calibration = calibration_drives(task, condition, seed) if drives is task.test else ()
        yield dataclasses.replace(drive, index=index, calibration=calibration)


def check_plants(task: Task) -> None:
    """Raise ConfigError if a test drive on a plant is not kept, and its program not installed."""
    if all(map(find_spec, EXTRAS["plants"])):
        return
    try:
        for condition in task.conditions:
            for _ in simulate_drives(task, task.test, condition) if condition.plant else ():
                pass
    except ConfigError as error:
        raise ConfigError(f"{task.name}: {error}") from None


def simulate_drive(
    task: Task, drives: DriveSet, condition: Condition, road: Road, seed: int
) -> RecordedDrive:
    """Return the drive over the `road` of a `seed`, without drives to calibrate with."""
    surface = road.realise(np.random.default_rng(seed))
    noise = np.random.SeedSequence(seed, spawn_key=(task.seed_stream(condition),))
    record, truth = _driven(task, drives, condition, condition, surface, (seed, seed, noise))
    return RecordedDrive(0, surface.name, seed, record, truth, surface.notes)


def calibration_drives(task: Task, condition: Condition, seed: int) -> tuple[CalibrationDrive, ...]:
    """Return the calibration drives of the vehicle that drives the test road of a `seed`."""
    made = []
    for k, run in enumerate(task.calibration, start=1):
        rng = np.random.default_rng(seed + run.seed_offset)
        surface = run.driven_road.realise(rng)
        noise = np.random.SeedSequence(seed, spawn_key=(_CALIBRATION, run.seed_offset))
        seeds = (seed, seed + run.seed_offset, noise)
        record, truth = _driven(task, task.test, condition, run, surface, seeds)
        profile = None if run.survey_std is None else levelled(truth, run.survey_std, rng)
        std = run.survey_std or CalibrationDrive.survey_std
        made.append(CalibrationDrive(record, profile, std, f"calibration drive {k}"))
    return tuple(made)


def _driven(
    task: Task,
    drives: DriveSet,
    condition: Condition,
    run: ModeAndSpeed,
    surface: Surface,
    seeds: tuple[int, int, np.random.SeedSequence],
) -> tuple[Record, Profile]:
    """Return record and truth of a `run` over a surface by the vehicle of a condition.

    `seeds` are those of the vehicle, of the surface and of the noise, which no other may draw: a
    road that varies is filtered white noise.
    """
    of_vehicle, of_surface, of_noise = seeds
    instruments = task.sensors if drives.noise else task.sensors.noiseless
    if condition.plant and drives is task.test:
        car, where = condition.car or task.car, (surface, run.speed_kmh, of_surface, instruments)
        return drive_of_plant(condition.plant, car, *where)
    record, truth = simulate_record(
        surface,
        speed_kmh=run.speed_kmh,
        mode=run.simulator_mode,
        seed=of_noise,
        vehicle=task.vehicle_of(condition),
        instruments=instruments,
        individual=np.random.SeedSequence(of_vehicle),
        step=drives.step,
        grade=condition.grade if drives is task.test else "S0",  # training is never perturbed
        position_noise=task.position_noise and drives is task.test,
    )
    return _low_passed(record, task.low_pass), truth


def levelled(truth: Profile, std: float, rng: np.random.Generator) -> Profile:
    """Return a road as a survey measures it: with independent errors of the deviation `std` [m]."""
    return Profile(truth.s, truth.z + std * rng.standard_normal(truth.z.shape))


def _low_passed(record: Record, f_c: float | None) -> Record:
    """Return a record whose accelerations were processed as the paper's, up to `f_c` [Hz].

    Lost samples are bridged for the filter, and lost again.
    """
    if f_c is None:
        return record
    lost, t = np.isnan(record.a), record.t
    pairs = zip(record.a, lost, strict=True)
    bridged = np.array([np.interp(t, t[~gap], x[~gap]) for x, gap in pairs])
    a = np.where(lost, np.nan, preprocess_accelerations(bridged, record.fs, f_c))
    return dataclasses.replace(record, a=a, low_pass=LowPass(f_c, LOW_PASS_ORDER))


def lock_arrays(drive: RecordedDrive) -> RecordedDrive:
    """Make the arrays of a drive read-only and return the drive."""
    # all entries share the arrays: an entry that writes into them fails instead of changing them
    given = [x for c in drive.calibration for x in (c.record, c.profile) if x is not None]
    for holder in (drive.record, drive.truth, *given):
        for value in vars(holder).values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
    return drive
