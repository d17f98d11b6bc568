"""Records of tables, read from their files in one step."""

from collections.abc import Mapping
from pathlib import Path

from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.description import DriveDescription
from road_envs.drives.logger_tables.table import read_table
from road_envs.drives.measured_record import MeasuredRecord, to_measured_record
from road_envs.vehicle.parameters import VehicleParameters


def read_measured_record(
    path: Path,
    wheelbase: float,
    *,
    speed_kmh: float | None = None,
    mode: str | Mapping[str, str] | None = None,
    description: DriveDescription | None = None,
    car: VehicleParameters | None = None,
) -> MeasuredRecord:
    """Read the record of a measured drive of a vehicle of this `wheelbase` [m]."""
    chosen = (description or DriveDescription()).updated(speed_kmh=speed_kmh, mode=mode)
    table = read_table(path)
    try:
        return to_measured_record(table, wheelbase, chosen, car)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
