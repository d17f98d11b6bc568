"""Options of commands that read drives from files, and reading these drives."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

import estimators
from estimators.api import Estimator
from estimators.common.odometer import to_true_distance
from estimators.lookup import FILE_SUFFIXES
from estimators.wiener.drive_check import check_notes
from leaderboard.commands import check_output_path, parse_mode, parse_pairs
from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.description import (
    DriveDescription,
    read_description,
    write_description,
)
from road_envs.drives.measured_record import MeasuredRecord, read_measured_record
from road_envs.drives.recording import is_record, read_record
from road_envs.records.record import Estimate, Profile, Record
from road_envs.roads import load_road, realise_road
from road_envs.roads.measured import Measured
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.suspension import check_modes

DEFAULT_VEHICLE, DEFAULT_SENSORS = "land_rover_defender_110", "paper"


def _option(text: str, **settings: Any) -> Any:
    return typer.Option(help=text, **settings)


RecordFile = Annotated[
    Path,
    typer.Argument(
        help="A record from `simulate`, or a measured drive as a table (.csv, .parquet, .mf4)."
    ),
]


RecordFiles = Annotated[
    list[Path],
    typer.Argument(
        help="Records from `simulate`, or measured drives as tables (.csv, .parquet, .mf4), of one "
        "road."
    ),
]


@dataclass(frozen=True, kw_only=True)
class DriveOptions:
    """Options of a command that describe a drive; None is left to its description or file."""

    vehicle: Annotated[str | None, typer.Option(help="Vehicle: shipped name or YAML path.")] = None
    sensors: Annotated[str | None, typer.Option(help="Instruments: shipped name or YAML path.")] = (
        None
    )
    mode: Annotated[
        str | None, _option("Mode of the struts: ride, handling, ..., or front=..,rear=..; passive")
    ] = None
    speed_kmh: Annotated[float | None, _option("Speed of the drive in km/h.", min=0.1)] = None
    columns: Annotated[
        str | None,
        _option("Names of columns: a_rf=acc_front,v=speed,... (t, a_rf, a_lr, a_rr, v, s)."),
    ] = None
    units: Annotated[str | None, _option("Units of columns: a_rf=g,t=ms,v=km/h,...")] = None
    invert: Annotated[str | None, _option("Accelerations whose axis points down: a_rf,...")] = None
    offset: Annotated[
        float | None, _option("Chainage in metres of the front axle at the first sample.")
    ] = None
    description: Annotated[
        Path | None, _option("Read these choices from a description (.yaml).")
    ] = None
    save_description: Annotated[
        Path | None, _option("Write the choices as a description (.yaml).")
    ] = None


def with_drive_options(command: Callable[..., None]) -> Callable[..., None]:
    """Return a `command` with the options of DriveOptions in place of its parameter `options`."""
    signature = inspect.signature(command)
    shared = [
        inspect.Parameter(
            each.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=each.type
        )
        for each in fields(DriveOptions)
    ]

    def run(**given: Any) -> None:
        options = DriveOptions(**{each.name: given.pop(each.name) for each in shared})
        command(**given, options=options)

    parameters: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        parameters += shared if name == "options" else [parameter]
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return run


class DriveFile(NamedTuple):
    """A drive that was read, with its described vehicle and instruments."""

    measured: MeasuredRecord
    vehicle: str
    car: VehicleParameters
    sensors: str
    is_table: bool


def read_drive(path: Path, options: DriveOptions) -> DriveFile:
    """Read a record of this package, or a measured drive. Raises ConfigError.

    Options take precedence over the description.
    """
    invert, save_description = options.invert, options.save_description
    named = {"columns": options.columns, "units": options.units}
    given: dict[str, Any] = {
        **{name: None if text is None else parse_pairs(name, text) for name, text in named.items()},
        "invert": None if invert is None else tuple(x.strip() for x in invert.split(",")),
        "mode": parse_mode(options.mode),
        "speed_kmh": options.speed_kmh,
        "offset": options.offset,
    }
    chosen = options.description
    described = read_description(chosen) if chosen else DriveDescription()
    described = described.updated(vehicle=options.vehicle, sensors=options.sensors, **given)
    name = described.vehicle or DEFAULT_VEHICLE
    car, instruments = load_vehicle(name), described.sensors or DEFAULT_SENSORS
    if save_description:
        check_output_path(save_description, ".yaml", ".yml")
    if is_record(path):
        needless = [key.replace("_", "-") for key, value in given.items() if value is not None]
        if needless or chosen or save_description:
            left = ", ".join(f"--{x}" for x in needless) or "the description"
            raise ConfigError(f"{path} contains all that belongs to the drive: leave out {left}")
        record = with_layout(read_record(path)[0], options.sensors, path)
        check_modes(record, car)
        return DriveFile(MeasuredRecord(record), name, car, instruments, False)
    measured = read_measured_record(path, car.wheelbase, description=described, car=car)
    has_distance = measured.has_distance or described.speed_kmh is not None
    doubts = check_notes(measured.record, car, instruments, speed_known=has_distance)
    measured = measured._replace(notes=(*measured.notes, *doubts))
    if save_description:
        write_description(save_description, described)
    return DriveFile(measured, name, car, instruments, True)


def with_layout(record: Record, sensors: str | None, path: Path) -> Record:
    """Return a record with the accelerometers of the instruments `sensors`, if they are given.

    Raises ConfigError if they have other names.
    """
    if sensors is None:
        return record
    layout = load_instruments(sensors).layout
    if tuple(layout) != record.channels:
        raise ConfigError(
            f"{path} has the accelerometers {', '.join(record.channels)}, and the instruments "
            f"{sensors} have {', '.join(layout)}: give those of the drive, or leave out --sensors"
        )
    return replace(record, sensors=layout)


def read_passes(paths: Sequence[Path], options: DriveOptions) -> list[DriveFile]:
    """Read several passes over one road. Raises ConfigError.

    Without a description for all, each table is read by that beside it with its own name and the
    suffix .yaml, if there is one; a note says so.
    """
    drives = []
    for path in paths:
        beside = path.with_suffix(".yaml")
        if len(paths) == 1 or options.description or is_record(path) or not beside.exists():
            drives.append(read_drive(path, options))
        else:
            drive = read_drive(path, replace(options, description=beside))
            notes = (*drive.measured.notes, f"read by the description {beside.name}")
            drives.append(drive._replace(measured=drive.measured._replace(notes=notes)))
        options = replace(options, save_description=None)  # once
    if len(sensors := {drive.sensors for drive in drives}) > 1:
        raise ConfigError(
            f"passes of one road need the same instruments, got {', '.join(sorted(sensors))}: give "
            "one for all (--sensors)"
        )
    return drives


def make_drive_estimator(name: str, drive: DriveFile, settings: dict[str, Any]) -> Estimator:
    """Return an estimator by name, class or file; one that takes instruments has the drive's."""
    if Path(name).suffix not in FILE_SUFFIXES and ":" not in name and "instruments" not in settings:
        if "instruments" in getattr(estimators.find(name), "__dataclass_fields__", {}):
            settings = {**settings, "instruments": drive.sensors}
    return estimators.make_estimator(name, **settings)


def estimate_drive(estimator: Estimator, drive: DriveFile) -> tuple[DriveFile, Estimate]:
    """Return the estimate of a drive and the drive, both in true distance if that is known."""
    record = drive.measured.record
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
