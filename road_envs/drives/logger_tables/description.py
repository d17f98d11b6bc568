"""Description of a drive: what the columns of a table mean, and what the table does not say."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import yaml
from pydantic import TypeAdapter

from road_envs.core.atomic_io import write_text
from road_envs.core.config import ConfigError, Finite, Positive, Settings, build, read_yaml
from road_envs.core.config import validate_choice as validate
from road_envs.records import units
from road_envs.records.accelerometers import Accelerometer, Layout, column
from road_envs.records.record import SENSORS


class _Quantity(NamedTuple):
    """A quantity of a drive: its kind of unit (None: text) and other names of its column."""

    kind: str | None
    aliases: tuple[str, ...] = ()


QUANTITIES = {
    "t": _Quantity("time", ("time", "timestamp", "datetime", "date_time", "timestamps")),
    "v": _Quantity("speed", ("speed", "velocity", "vehicle_speed", "gps_speed")),
    "s": _Quantity("distance", ("distance", "odometer", "chainage", "station")),
    "lat": _Quantity("angle", ("latitude", "gps_lat", "gps_latitude")),
    "lon": _Quantity("angle", ("lng", "long", "longitude", "gps_lon", "gps_longitude")),
    "mode": _Quantity(None),
    "mode_front": _Quantity(None),
    "mode_rear": _Quantity(None),
}
"""Signals of a table beside its accelerations: time, speed, odometer, position, state of struts."""

PREFIX = column("")  # beginning of the name of every acceleration
DEVICE = "PHONE"  # name of the one accelerometer of a device at a place

PLACES = {
    "dashboard": Accelerometer(axle="front", ahead=-0.5, y=0.0),
    "floor": Accelerometer(axle="front", ahead=-1.3, y=0.0),
    "seat": Accelerometer(axle="front", ahead=-1.6, y=0.35),
    "trunk": Accelerometer(axle="rear", ahead=-0.3, y=0.0),
    "bumper": Accelerometer(axle="front", ahead=0.75, y=0.0),
}
"""Places of a device by name: a mount on the dashboard or the windscreen, the floor between the
front seats, the driver's seat on the left, the floor of the trunk, and the front bumper.

The distances are assumed: those of a saloon or hatchback of 2.5 to 2.9 m of wheelbase, to some
0.2 m. At 70 km/h, 0.2 m change the phase of a wave of 3 m by a tenth of a radian at the sensor."""

DEFAULT_SENSORS, DEVICE_SENSORS = "paper", "phone"  # of the paper's drives, and of one device
DEFAULT_PLACE = "dashboard"  # place of one device if none is given, which a note says
SEAT_NOTE = "a seat swings by itself at 3 to 5 Hz, which no model here has: put it on the floor"


def _parse_place(at: str) -> Accelerometer:
    """Return the place of a word of PLACES, or of "AHEAD" or "AHEAD,LEFT" [m]. Raises ConfigError.

    AHEAD counts from the front axle and is negative behind it, LEFT from the centre line.
    """
    if at in PLACES:
        return PLACES[at]
    try:
        ahead, *rest = (float(part) for part in at.split(","))
        (left,) = rest or (0.0,)
        return Accelerometer(axle="front", ahead=ahead, y=left)
    except (ValueError, ConfigError):
        raise ConfigError(
            f"the place {at[:40]!r} is none of {', '.join(PLACES)}, nor metres ahead of the front "
            "axle and to the left, as in -0.5,0.2 (half a metre behind it)"
        ) from None


@dataclass(frozen=True, kw_only=True)
class DriveDescription(Settings):
    """Meaning of the columns of a table, and values that hold for the whole drive.

    The accelerations are `a_NAME` for each of the `accelerometers`, or of the instruments `sensors`
    if none are described: by default a_rf, a_lr and a_rr on the body.
    """

    columns: Annotated[dict[str, str], "", "header of each quantity"] = field(default_factory=dict)
    units: Annotated[dict[str, str], "", "unit of each quantity"] = field(default_factory=dict)
    invert: Annotated[tuple[str, ...], "", "accelerations whose axis points down"] = ()
    speed_kmh: Annotated[Positive | None, "km/h", "speed of the whole drive"] = None
    mode: Annotated[str | dict[str, str] | None, "", "state of the struts"] = None
    offset: Annotated[Finite | None, "m", "chainage of the front axle at the first sample"] = None
    vehicle: Annotated[str | None, "", "vehicle: shipped name or YAML path"] = None
    sensors: Annotated[str | None, "", "instruments: shipped name or YAML path"] = None
    accelerometers: Annotated[
        Layout | None, "", "places of the accelerometers by name, if not those of the instruments"
    ] = None
    low_pass: Annotated[
        Positive | None, "Hz", "of the accelerations: Butterworth, order 4, forwards and backwards"
    ] = None

    at: Annotated[
        str | None, "", "place of one device: dashboard, floor, seat, trunk, bumper, or metres"
    ] = None
    iri_factor: Annotated[
        Positive | None, "", "true IRI over that of a report, by a stretch of known IRI"
    ] = None
    iri_factor_std: Annotated[Positive | None, "", "relative standard deviation of it"] = None

    def __post_init__(self):
        super().__post_init__()
        if self.at is not None and self.accelerometers is not None:
            raise ConfigError("give the place of one device (at) or accelerometers, not both")
        if self.layout is not None or self.sensors is None:
            self.quantities(self.layout or SENSORS)
        for quantity, unit in self.units.items():
            if not quantity.startswith(PREFIX):
                validate("quantity in units", quantity, list(QUANTITIES))
            kind = "acceleration" if quantity.startswith(PREFIX) else QUANTITIES[quantity].kind
            if kind is None:
                raise ConfigError(f"units: {quantity} has no unit")
            units.factor(kind, unit)

    @property
    def layout(self) -> dict[str, Accelerometer] | None:
        """The accelerometers that are described: several, or the one device at a place."""
        if self.at is None and column(DEVICE) not in {**self.columns, **self.units}:
            return self.accelerometers
        return self.accelerometers or {DEVICE: _parse_place(self.at or DEFAULT_PLACE)}

    @property
    def instruments(self) -> str:
        """The `sensors`; by default those of one device, or of the paper's drives."""
        one_device = self.layout is not None and self.accelerometers is None
        return self.sensors or (DEVICE_SENSORS if one_device else DEFAULT_SENSORS)

    def quantities(self, accelerometers: Iterable[str]) -> dict[str, _Quantity]:
        """Return the signals of a table with the accelerations of these `accelerometers`.

        Raises ConfigError if the description names another one.
        """
        accelerations = {column(name): _Quantity("acceleration") for name in accelerometers}
        known = accelerations | QUANTITIES
        for name, given in (("columns", self.columns), ("units", self.units)):
            for quantity in given:
                validate(f"quantity in {name}", quantity, list(known))
        for name in self.invert:
            validate("acceleration in invert", name, accelerations)
        return known

    def updated(self, **changes: Any) -> "DriveDescription":
        """Return the description with `changes`; None changes nothing, mappings are merged.

        The factor of another car, or of another place, is not kept.
        """
        given = {key: value for key, value in changes.items() if value is not None}
        before = {key: getattr(self, key) for key in ("vehicle", "at", "sensors")}
        if any(x is not None and given.get(key, x) != x for key, x in before.items()):
            given = {"iri_factor": None, "iri_factor_std": None, **given}
        for key in given.keys() & {"columns", "units"}:
            given[key] = {**getattr(self, key), **given[key]}
        return replace(self, **given)


def read_description(path: Path) -> DriveDescription:
    """Read a description; vehicle and instruments beside it are found. Raises ConfigError."""
    data = read_yaml(path)
    for key in ("vehicle", "sensors"):
        if isinstance(name := data.get(key), str) and (path.parent / name).is_file():
            data[key] = str(path.parent / name)
    return build(DriveDescription, data, str(path))


def write_description(path: Path, description: DriveDescription) -> None:
    """Write a description as YAML, without what was left open."""
    adapter = TypeAdapter(DriveDescription)
    data = adapter.dump_python(description, mode="json", exclude_defaults=True)
    write_text(path, yaml.safe_dump(data, sort_keys=False, allow_unicode=True))
