"""Options that say how a drive in a file is to be read, and its record."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from leaderboard.commands import check_output_path, parse_mode
from road_envs.config import ConfigError
from road_envs.data.logger_tables.description import (
    DriveDescription,
    read_description,
    write_description,
)
from road_envs.data.measured_record import MeasuredRecord, read_measured_record
from road_envs.data.recording import is_record, read_record
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle

DEFAULT_VEHICLE, DEFAULT_SENSORS = "land_rover_defender_110", "paper"
PANEL = "Measured drives"


def _option(text: str, **settings: Any) -> Any:
    return typer.Option(help=text, rich_help_panel=PANEL, **settings)


RecordFile = Annotated[
    Path,
    typer.Argument(
        help="A record from `simulate`, or a measured drive as a table (.csv, .parquet, .mf4)."
    ),
]
Mode = Annotated[
    str | None, _option("4S4 mode of the drive: ride, handling, ..., or front=..,rear=..")
]
Speed = Annotated[float | None, _option("Speed of the drive in km/h.", min=0.1)]
Columns = Annotated[
    str | None, _option("Names of columns: a_rf=acc_front,v=speed,... (t, a_rf, a_lr, a_rr, v, s).")
]
Units = Annotated[str | None, _option("Units of columns: a_rf=g,t=ms,v=km/h,...")]
Invert = Annotated[str | None, _option("Accelerations whose axis points down: a_rf,a_rr,...")]
Offset = Annotated[
    float | None, _option("Chainage in metres of the front axle at the first sample.")
]
Description = Annotated[Path | None, _option("Read these choices from a description (.yaml).")]
SaveDescription = Annotated[Path | None, _option("Write the choices as a description (.yaml).")]
Vehicle = Annotated[str | None, typer.Option(help="Vehicle: shipped name or YAML path.")]
Sensors = Annotated[str | None, typer.Option(help="Instruments: shipped name or YAML path.")]


class DriveFile(NamedTuple):
    """A drive that was read, with its described vehicle and instruments."""

    measured: MeasuredRecord
    vehicle: str
    car: VehicleParameters
    sensors: str
    is_table: bool


def read_drive(
    path: Path,
    *,
    vehicle: str | None = None,
    sensors: str | None = None,
    columns: str | None = None,
    units: str | None = None,
    invert: str | None = None,
    description: Path | None = None,
    save_description: Path | None = None,
    **whole_drive: Any,
) -> DriveFile:
    """Read a record of this package, or a measured drive as the options tell. Raises ConfigError.

    `whole_drive` are the `mode`, `speed_kmh` and `offset` of a measured drive. Options go before
    what the description says.
    """
    if whole_drive.get("mode") is not None:
        whole_drive["mode"] = parse_mode(whole_drive["mode"])
    given = {
        "columns": _pairs("columns", columns),
        "units": _pairs("units", units),
        "invert": None if invert is None else tuple(x.strip() for x in invert.split(",")),
        **whole_drive,
    }
    told = read_description(description) if description else DriveDescription()
    told = told.updated(vehicle=vehicle, sensors=sensors, **given)
    name = told.vehicle or DEFAULT_VEHICLE
    car, instruments = load_vehicle(name), told.sensors or DEFAULT_SENSORS
    if save_description:
        check_output_path(save_description, ".yaml", ".yml")
    if is_record(path):
        needless = [key.replace("_", "-") for key, value in given.items() if value is not None]
        if needless or description or save_description:
            options = ", ".join(f"--{x}" for x in needless) or "the description"
            raise ConfigError(f"{path} contains all that belongs to the drive: leave out {options}")
        return DriveFile(MeasuredRecord(read_record(path)[0]), name, car, instruments, False)
    measured = read_measured_record(path, car.wheelbase, description=told)
    if save_description:
        write_description(save_description, told)
    return DriveFile(measured, name, car, instruments, True)


def _pairs(option: str, text: str | None) -> Mapping[str, str] | None:
    """Return the mapping of "key=value,key=value". Raises ConfigError."""
    if text is None:
        return None
    pairs = [part.partition("=") for part in text.split(",")]
    if wrong := [f"{key}{equals}{value}" for key, equals, value in pairs if not (key and value)]:
        raise ConfigError(f"--{option} must be key=value,key=value, got {wrong[0]!r}")
    return {key.strip(): value.strip() for key, _, value in pairs}
