"""Estimates of drives that were read from files: the estimator, doubts, and true distance."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import estimators
from estimators.api import Estimator, copy_with
from estimators.common.odometer import to_true_distance
from estimators.lookup import FILE_SUFFIXES
from estimators.wiener.drive_check import check_notes, side_notes
from estimators.wiener.structure_search import with_bending, with_twist
from leaderboard.drive_report.mean_path import means_of_pairs, tells_paths_apart, tells_vehicle
from leaderboard.drive_report.notes import LARGE_RESIDUAL, is_far_off, is_unsure, residual_of
from leaderboard.drive_report.sections import Sections
from road_envs.core.config import ConfigError
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.drives.reading import DriveFile
from road_envs.records.record import Estimate, Profile
from road_envs.roads import load_road, realise_road
from road_envs.roads.measured import Measured
from road_envs.sensing.instruments import instruments_of
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.side_values import side_values

_UNEXPLAINED = 1.02
"""Residual in times of the sensors' noise above which side motion is tried that a file leaves out:
individuals that have some (S4 of the paper's vehicle) have 1.04 to 2.4 without it and 1.0 to 1.2
with it, those that have none (S1, S2) 1.0 to 1.25 and 1.2 to 2.9.
"""

_SIDE_NOTE = (
    "tyres that hold the vehicle sideways, of which its file says nothing, explain the record "
    "better (residual {:.2f} instead of {:.2f} times the sensors' noise), and the vehicle was "
    "adapted: give its file a `side`"
)
_SIDE_DOUBT = "are not told apart as well"  # in a note that side motion answers
_PAIRS_NOTE = (
    "The model with sensors on both sides does not reproduce the accelerations (residual {:.1f} "
    "times the sensors' noise): only the means of sensors on the left and the right were used"
)


def with_doubts(drive: DriveFile) -> DriveFile:
    """Return a drive with notes if its record fits another description better.

    What holds the vehicle sideways shows only behind the twist and the bending of its body.
    """
    record, car, sensors = drive.measured.record, drive.car, drive.sensors
    body = with_bending(record, with_twist(record, car, sensors), sensors)
    notes = side_notes(record, body, sensors)
    if not notes and body is not car:  # peaks of the road may have been taken for the body's
        notes = side_notes(record, car, sensors)
    if drive.is_table:  # a record of `simulate` knows its speed, mode and channels
        notes += check_notes(record, car, sensors, speed_known=drive.knows_distance)
    return drive.with_notes(*notes)


def make_drive_estimator(
    name: str, drive: DriveFile, settings: dict[str, Any], fast: bool = False
) -> Estimator:
    """Return an estimator by name, class or file for a drive; a `fast` one fits no vehicle to it.

    One that takes instruments has the drive's. One or two sensors, and those that tell no roll, do
    not tell a road from a vehicle, and do not adapt it unless `settings` say so: fitted to them, a
    saloon got a frame that it does not have, and an IRI that was 20 to 40 % too low.
    """
    if Path(name).suffix not in FILE_SUFFIXES and ":" not in name:
        known = getattr(estimators.find(name), "__dataclass_fields__", {})
        fitting: dict[str, Any] = {"instruments": drive.sensors}
        if fast or not tells_vehicle(drive.measured.record.sensors):
            fitting["adapt"] = False
        settings = {key: x for key, x in fitting.items() if key in known} | settings
    return estimators.make_estimator(name, **settings)


def estimate_drive(
    estimator: Estimator, drive: DriveFile, sections: Sections | None = None
) -> tuple[DriveFile, Estimate]:
    """Return the estimate of a drive, by `sections` if they are given, and the drive, both in true
    distance if that is known.

    Bending and twist of the body are looked for in the spectrum of the sensors. Where the model
    with sensors on both sides leaves something unexplained, side motion is tried of which the
    vehicle's file says nothing. Where it is far from reproducing the record nevertheless, or could
    not be fitted to it, the drive that is returned has the means of pairs: the mean path.
    """
    record = drive.measured.record
    if not tells_paths_apart(record.sensors):
        return _estimated(estimator, _with_bending(drive), sections)
    car = with_twist(record, drive.car, drive.sensors)
    ways = [drive]
    if car is not drive.car and (mode := car.variation.frame):
        note = f"the frame twists at {mode.f:.0f} Hz, by a peak in the record, and was adapted"
        twisted = _with_bending(drive._replace(car=car).with_notes(note))
        # a description that says of a frame leaves it to an estimator that fits the vehicle
        is_described = "variation.frame.f" in drive.car.tolerances
        is_fitted = is_described and tells_vehicle(record.sensors)
        ways = [drive, twisted] if is_fitted else [twisted, drive]
    found = []
    for way in ways:
        found.append((way, _estimated(estimator, way, sections)))
        if residual_of(found[-1][1][1]) < LARGE_RESIDUAL:
            break
    likeliest = min(found, key=lambda pair: residual_of(pair[1][1]))
    best = _held_sideways(estimator, *likeliest, sections)
    instruments = instruments_of(record, drive.sensors)
    is_rough = residual_of(best[1]) >= LARGE_RESIDUAL and not getattr(estimator, "adapt", True)
    is_wrong = is_far_off(best[1], record, instruments.noise_rms(record.fs))
    if not (is_rough or is_wrong or is_unsure(best[1])):
        return best
    centred = means_of_pairs(record, instruments.accelerometers)
    if centred is None:
        return best
    note = _PAIRS_NOTE.format(residual_of(best[1]))
    means = drive._replace(measured=drive.measured._replace(record=centred)).with_notes(note)
    alone = copy_with(estimator, adapt=False) if hasattr(estimator, "adapt") else estimator
    return _estimated(alone, _with_bending(means), sections)


def _held_sideways(
    estimator: Estimator,
    drive: DriveFile,
    found: tuple[DriveFile, Estimate],
    sections: Sections | None,
) -> tuple[DriveFile, Estimate]:
    """Return what is `found` of a drive if its vehicle is held sideways, if that explains more."""
    car, before = drive.car, residual_of(found[1])
    is_fitted = getattr(estimator, "adapt", False) and tells_vehicle(drive.measured.record.sensors)
    if not (is_fitted and car.tolerances) or car.side is not None or before <= _UNEXPLAINED:
        return found
    spread = load_vehicle("suv").tolerances.items()  # for a file without side motion
    known = car.tolerances | {key: x for key, x in spread if key.startswith("side.")}
    held = drive._replace(car=replace(car, side=side_values(car), tolerances=known))
    held, estimate = _estimated(estimator, held, sections)
    if residual_of(estimate) >= before:
        return found
    notes = [note for note in held.measured.notes if _SIDE_DOUBT not in note]
    notes.append(_SIDE_NOTE.format(residual_of(estimate), before))
    return held._replace(measured=held.measured._replace(notes=tuple(notes))), estimate


def _with_bending(drive: DriveFile) -> DriveFile:
    """Return a drive whose body bends as the spectrum of its sensors shows."""
    car = with_bending(drive.measured.record, drive.car, drive.sensors)
    if car is drive.car or not (mode := car.variation.bending):
        return drive
    note = f"the body bends at {mode.f:.0f} Hz, by a peak in the record, and was adapted"
    return drive._replace(car=car).with_notes(note)


def _estimated(
    estimator: Estimator, drive: DriveFile, sections: Sections | None
) -> tuple[DriveFile, Estimate]:
    record = drive.measured.record
    one = sections.estimator(estimator) if sections else estimator
    given = estimators.estimate(one, record, drive.car)
    if given.draws is not None and not tells_paths_apart(record.sensors):  # half of the memory
        given = replace(given, draws=given.draws.mean(axis=1, keepdims=True))
    moved, found = to_true_distance(record, given)
    if found.draws is not None:
        samples = np.broadcast_to(found.draws, (len(found.draws), *found.z.shape))
        found = replace(found, draws=samples)
    return drive._replace(measured=drive.measured._replace(record=moved)), found


def read_profiles(names: list[str], drives: list[MeasuredRecord]) -> list[Profile | None]:
    """Return the known road of each drive, over the stations of its record; one name is that of all
    drives, and without names there is none. Raises ConfigError if there are too few or too many.
    """
    if not names:
        return [None] * len(drives)
    if len(names) not in (1, len(drives)):
        raise ConfigError(f"give one --profile, or one for each of {len(drives)} drives")
    profiles: list[Profile | None] = []
    for name, drive in zip(names * (len(drives) // len(names)), drives, strict=True):
        surface, road = realise_road(name, 0), load_road(name)
        first = road.first_station if isinstance(road, Measured) else 0.0
        profiles.append(Profile(surface.s + first - drive.chainage, surface.z))
    return profiles
