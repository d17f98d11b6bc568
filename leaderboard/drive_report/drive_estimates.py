"""Estimates of drives that were read from files: the estimator, doubts, and true distance."""

from pathlib import Path
from typing import Any

import estimators
from estimators.api import Estimator
from estimators.common.odometer import to_true_distance
from estimators.lookup import FILE_SUFFIXES
from estimators.wiener.bending_search import with_bending
from estimators.wiener.drive_check import check_notes
from leaderboard.drive_report.mean_path import tells_paths_apart
from road_envs.core.config import ConfigError
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.drives.reading import DriveFile
from road_envs.records.record import Estimate, Profile
from road_envs.roads import load_road, realise_road
from road_envs.roads.measured import Measured


def with_doubts(drive: DriveFile) -> DriveFile:
    """Return a drive with a note if its record fits another description better."""
    if not drive.is_table:
        return drive
    record, known = drive.measured.record, drive.knows_distance
    return drive.with_notes(*check_notes(record, drive.car, drive.sensors, speed_known=known))


def make_drive_estimator(name: str, drive: DriveFile, settings: dict[str, Any]) -> Estimator:
    """Return an estimator by name, class or file for a drive.

    One that takes instruments has the drive's. Sensors that tell no roll do not tell a road from a
    vehicle either: fitted to them, a saloon over class C got a frame that it does not have, and an
    IRI that was 20 to 40 % too low where the described one gave 10 % (seed 408 of
    `studies/phone_reports.py`). They do not adapt it, unless `settings` say so.
    """
    if Path(name).suffix not in FILE_SUFFIXES and ":" not in name:
        known = getattr(estimators.find(name), "__dataclass_fields__", {})
        fitting: dict[str, Any] = {"instruments": drive.sensors}
        if not tells_paths_apart(drive.measured.record.sensors):
            fitting["adapt"] = False
        settings = {key: x for key, x in fitting.items() if key in known} | settings
    return estimators.make_estimator(name, **settings)


def estimate_drive(estimator: Estimator, drive: DriveFile) -> tuple[DriveFile, Estimate]:
    """Return the estimate of a drive and the drive, both in true distance if that is known.

    Where the sensors tell no roll, the bending of the body is looked for in their spectrum.
    """
    record = drive.measured.record
    if not tells_paths_apart(record.sensors):
        car = with_bending(record, drive.car, drive.sensors)
        if car is not drive.car and (mode := car.variation.bending):
            note = f"the body bends at {mode.f:.0f} Hz, by a peak in the record, and was adapted"
            drive = drive._replace(car=car).with_notes(note)
    record, found = to_true_distance(record, estimators.estimate(estimator, record, drive.car))
    return drive._replace(measured=drive.measured._replace(record=record)), found


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
