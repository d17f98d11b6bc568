"""Drives from files: records of this package, tables of loggers, and recordings of phones.

    drive = read_drive(Path("drive.zip"), vehicle="bmw_320i")
    drive.measured.record, drive.measured.notes

A file can hold several drives (`read_drives`), and several files can be passes over one road, of
which each has its own description (`read_passes`).
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.description import (
    DEFAULT_PLACE,
    DriveDescription,
    read_description,
)
from road_envs.drives.measured_record import MeasuredRecord, recording_to_record, to_measured_record
from road_envs.drives.recording import is_record, read_record
from road_envs.drives.recordings.formats import drives_in, read_source, read_track
from road_envs.drives.recordings.recording import Recording, drives_of
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.suspension import check_modes

DEFAULT_VEHICLE = "land_rover_defender_110"  # vehicle of the paper's drives


class DriveFile(NamedTuple):
    """A drive that was read, with its described vehicle and instruments.

    `name` is that of its file without suffix, numbered where the file holds several drives, and
    `label` what messages call it; `description` is what was given and found; `is_table` is False
    for a record of this package.
    """

    name: str
    label: str
    measured: MeasuredRecord
    vehicle: str
    car: VehicleParameters
    sensors: str
    is_table: bool
    description: DriveDescription

    @property
    def knows_distance(self) -> bool:
        """Whether the speed is confirmed by an odometer, by positions, or by the description."""
        return self.measured.has_distance or self.description.speed_kmh is not None

    def with_notes(self, *notes: str) -> "DriveFile":
        noted = self.measured._replace(notes=(*self.measured.notes, *notes))
        return self._replace(measured=noted)


def read_drive(
    path: Path, description: Path | DriveDescription | None = None, **options: Any
) -> DriveFile:
    """Read the one drive in a file; see `read_drives`. Raises ConfigError if it holds several."""
    found = read_drives(path, description, **options)
    if len(found) > 1:
        names = ", ".join(drive.name for drive in found)
        raise ConfigError(
            f"{path} holds {len(found)} drives ({names}), which its pauses part: `report` reads "
            "them all; for this, cut the file"
        )
    return found[0]


def read_drives(
    path: Path,
    description: Path | DriveDescription | None = None,
    *,
    track: Path | None = None,
    **changes: Any,
) -> list[DriveFile]:
    """Read the drives in a file or folder: a record, a table, or a recording of a phone.

    `changes` are fields of a DriveDescription, such as `vehicle` and `at`, which take precedence
    over the `description`; `track` has speed or positions of a recording without. Raises
    ConfigError.
    """
    described = read_description(description) if isinstance(description, Path) else description
    chosen = (described or DriveDescription()).updated(**changes)
    if path.exists() and not path.is_dir() and is_record(path):
        given = [key for key, x in {**changes, "track": track}.items() if x is not None]
        return [_read_record(path, chosen, given, described is not None)]
    source = read_source(path, chosen)
    if not isinstance(source, Recording):
        if track is not None:
            raise ConfigError(
                f"--track is for recordings of three axes, and {path} has named accelerations: "
                "give it the columns of speed or position"
            )
        return [_read_table(path, source, chosen)]
    if chosen.vehicle is None:
        raise ConfigError(
            f"{path}: say which vehicle was driven: --vehicle with a shipped name (road-recon "
            "lists them with an unknown one) or a file of your own"
        )
    if not source.is_table and track is None and (chosen.columns or chosen.units):
        raise ConfigError(
            f"{path} names its columns and units itself: leave out --columns and --units"
        )
    try:
        if track is not None:
            source = source.with_track(read_track(track, chosen), track.name)
        car = load_vehicle(chosen.vehicle)
        parts = drives_of(source)
        label = path.name if len(parts) == 1 else None
        return [_of_recording(part, label or part.name, chosen, car) for part in parts]
    except ConfigError as error:
        raise ConfigError(str(error) if str(path) in str(error) else f"{path}: {error}") from None


def _of_recording(
    part: Recording, label: str, chosen: DriveDescription, car: VehicleParameters
) -> DriveFile:
    place = f"the device is taken to lie on the {DEFAULT_PLACE} (--at says where it lay)"
    notes = () if chosen.at else (place,)
    chosen = chosen.updated(at=chosen.at or DEFAULT_PLACE)
    chosen = replace(chosen, sensors=chosen.instruments)
    measured, own = recording_to_record(part, chosen, car), (str(chosen.vehicle), car)
    drive = DriveFile(part.name, label, measured, *own, chosen.instruments, True, chosen)
    return drive.with_notes(*notes)


def _read_table(path: Path, table: Any, chosen: DriveDescription) -> DriveFile:
    name = chosen.vehicle or DEFAULT_VEHICLE
    car = load_vehicle(name)
    try:
        measured = to_measured_record(table, car.wheelbase, chosen, car)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    drive = DriveFile(path.stem, path.name, measured, name, car, chosen.instruments, True, chosen)
    note = _assumed_vehicle("does not say which vehicle was driven")
    return drive if chosen.vehicle else drive.with_notes(note)


def _read_record(
    path: Path, chosen: DriveDescription, given: list[str], is_described: bool
) -> DriveFile:
    """Read a record of this package, which takes a vehicle and instruments only.

    Without a vehicle it is the one that the record says was simulated, if that is shipped: a record
    may come from anybody, so no file is opened that it names.
    """
    needless = [key for key in given if key not in ("vehicle", "sensors")]
    if needless or is_described:
        left = ", ".join(f"--{x.replace('_', '-')}" for x in needless) or "the description"
        raise ConfigError(f"{path} contains all that belongs to the drive: leave out {left}")
    record, provenance = read_record(path)
    simulated, notes = provenance.get("vehicle"), tuple[str, ...]()
    if chosen.vehicle is not None:
        name = chosen.vehicle
    elif simulated in config.names("vehicles"):
        name = str(simulated)
    else:
        said = "does not say which vehicle was simulated"
        if isinstance(simulated, str):
            said = f"is of the vehicle {Path(simulated).name!r}, which is no shipped one"
        name, notes = DEFAULT_VEHICLE, (_assumed_vehicle(said),)
    car = load_vehicle(name)
    if chosen.sensors is not None:
        layout = load_instruments(chosen.sensors).layout
        if tuple(layout) != record.channels:
            raise ConfigError(
                f"{path} has the accelerometers {', '.join(record.channels)}, and the instruments "
                f"{chosen.sensors} have {', '.join(layout)}: give those of the drive, or leave out "
                "--sensors"
            )
        record = replace(record, sensors=layout)
    check_modes(record, car)
    measured = MeasuredRecord(record, notes)
    return DriveFile(path.stem, path.name, measured, name, car, chosen.instruments, False, chosen)


def _assumed_vehicle(said: str) -> str:
    """Return the note of a record whose vehicle is unknown, with what the record has `said`."""
    return f"the record {said}: {DEFAULT_VEHICLE} is assumed (--vehicle says which)"


def read_passes(
    paths: Sequence[Path], description: Path | DriveDescription | None = None, **options: Any
) -> list[DriveFile]:
    """Read the drives in several files, or in folders of them; see `read_drives` and its errors.

    Without a description for all, each is read by the one beside it with its own name and the
    suffix .yaml, if there is one; a note says so. Names that are equal are numbered.
    """
    drives: list[DriveFile] = []
    paths = [file for path in paths for file in drives_in(path)]
    for path in paths:
        own = path.with_suffix(".yaml") if path.name else path  # "/" has no name
        alone = len(paths) == 1 or description is not None or not own.exists()
        if alone or path == own or (path.is_file() and is_record(path)):
            drives += read_drives(path, description, **options)
            continue
        found = read_drives(path, own, **options)
        drives += [drive.with_notes(f"read by the description {own.name}") for drive in found]
    names = [drive.name for drive in drives]
    return [
        drive if names.count(drive.name) == 1
        else drive._replace(name=f"{drive.name}_{names[: k + 1].count(drive.name)}")
        for k, drive in enumerate(drives)
    ]  # fmt: skip


def same_instruments(drives: Sequence[DriveFile]) -> str:
    """Return the instruments of passes that are joined. Raises ConfigError if they differ."""
    if len(sensors := {drive.sensors for drive in drives}) > 1:
        raise ConfigError(
            f"passes of one road need the same instruments, got {', '.join(sorted(sensors))}: give "
            "one for all (--sensors)"
        )
    return sensors.pop()
