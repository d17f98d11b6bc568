"""Description of a drive: what the columns of a table mean, and what the table does not say."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import yaml

from road_envs._atomic_io import atomic_write
from road_envs.config import ConfigError, Finite, Positive, Settings, build, read_yaml
from road_envs.config import validate_choice as validate
from road_envs.data.logger_tables import units


class Quantity(NamedTuple):
    """A quantity of a drive: its kind of unit (None: text) and other names of its column."""

    kind: str | None
    aliases: tuple[str, ...] = ()


QUANTITIES = {
    "t": Quantity("time", ("time", "timestamp", "datetime", "date_time", "timestamps")),
    "a_rf": Quantity("acceleration"),
    "a_lr": Quantity("acceleration"),
    "a_rr": Quantity("acceleration"),
    "v": Quantity("speed", ("speed", "velocity", "vehicle_speed", "gps_speed")),
    "s": Quantity("distance", ("distance", "odometer", "chainage", "station")),
    "lat": Quantity("angle", ("latitude", "gps_lat", "gps_latitude")),
    "lon": Quantity("angle", ("lng", "long", "longitude", "gps_lon", "gps_longitude")),
    "mode": Quantity(None),
    "mode_front": Quantity(None),
    "mode_rear": Quantity(None),
}
"""Signals that a table can hold. Vertical accelerations of the body at right front, left rear,
right rear; speed, odometer, position (WGS 84), and state of the struts.
"""

ACCELERATIONS = ("a_rf", "a_lr", "a_rr")


@dataclass(frozen=True, kw_only=True)
class DriveDescription(Settings):
    """Meaning of the columns of a table, and values that hold for the whole drive."""

    columns: Annotated[dict[str, str], "", "header of each quantity"] = field(default_factory=dict)
    units: Annotated[dict[str, str], "", "unit of each quantity"] = field(default_factory=dict)
    invert: Annotated[tuple[str, ...], "", "accelerations whose axis points down"] = ()
    speed_kmh: Annotated[Positive | None, "km/h", "speed of the whole drive"] = None
    mode: Annotated[str | dict[str, str] | None, "", "state of the struts"] = None
    offset: Annotated[Finite | None, "m", "chainage of the front axle at the first sample"] = None
    vehicle: Annotated[str | None, "", "vehicle: shipped name or YAML path"] = None
    sensors: Annotated[str | None, "", "instruments: shipped name or YAML path"] = None

    def __post_init__(self):
        super().__post_init__()
        for name, given in (("columns", self.columns), ("units", self.units)):
            for quantity in given:
                validate(f"quantity in {name}", quantity, list(QUANTITIES))
        for quantity, unit in self.units.items():
            if kind := QUANTITIES[quantity].kind:
                units.factor(kind, unit)
            else:
                raise ConfigError(f"units: {quantity} has no unit")
        for name in self.invert:
            validate("acceleration in invert", name, list(ACCELERATIONS))

    def updated(self, **changes: Any) -> "DriveDescription":
        """Return the description with `changes`; None changes nothing, mappings are merged."""
        data = asdict(self)
        for key, value in changes.items():
            if value is None:
                continue
            data[key] = {**data[key], **value} if key in ("columns", "units") else value
        return DriveDescription(**data)


def read_description(path: Path) -> DriveDescription:
    """Read a description; vehicle and instruments beside it are found. Raises ConfigError."""
    data = read_yaml(path)
    for key in ("vehicle", "sensors"):
        if isinstance(name := data.get(key), str) and (path.parent / name).is_file():
            data[key] = str(path.parent / name)
    return build(DriveDescription, data, str(path))


def write_description(path: Path, description: DriveDescription) -> None:
    """Write a description as YAML, without what was left open."""
    data = {key: value for key, value in asdict(description).items() if value not in (None, {}, ())}
    text = yaml.safe_dump(_plain(data), sort_keys=False, allow_unicode=True)
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _plain(data: Mapping[str, Any]) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in data.items()}
