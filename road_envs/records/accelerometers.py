"""Accelerometers of a vehicle by name: where they are mounted. A record carries its layout.

A layout maps names to accelerometers, in the order of the rows of a record's accelerations. Their
axes are vertical, positive upwards.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, TypeAdapter

from road_envs.core.config import NonNegative, Settings, build

MAX_ACCELEROMETERS = 32  # most accelerometers of one vehicle
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True, kw_only=True)
class Accelerometer(Settings):
    """One accelerometer, on the body or on an axle.

    On the body `ahead` counts from an `axle`, or from the centre of mass without one. An axle is a
    rigid beam that heaves and rolls but does not pitch, so that only `y` matters there. `range` and
    `noise_density` replace those of the instruments.
    """

    mounted: Literal["body", "front axle", "rear axle"] = "body"
    axle: Annotated[
        Literal["front", "rear"] | None, "", "axle from which `ahead` counts; else centre of mass"
    ] = None
    ahead: Annotated[
        float, Field(ge=-10, le=10, allow_inf_nan=False), "m", "ahead of it; negative behind it"
    ] = 0.0
    y: Annotated[float, Field(ge=-2, le=2, allow_inf_nan=False), "m", "left of the centre line"]
    range: Annotated[Annotated[float, Field(gt=0)] | None, "m/s²", "clipping level, either way"] = (
        None
    )
    noise_density: Annotated[NonNegative | None, "(m/s²)/sqrt(Hz)", "one-sided"] = None

    def __post_init__(self):
        super().__post_init__()
        if self.mounted != "body" and (self.axle is not None or self.ahead != 0.0):
            raise ValueError(
                f"an accelerometer on the {self.mounted} has no 'axle' and no 'ahead': an axle "
                "does not pitch"
            )


def _check_layout(layout: Mapping[str, Accelerometer]) -> Mapping[str, Accelerometer]:
    if not 1 <= len(layout) <= MAX_ACCELEROMETERS:
        raise ValueError(f"give 1 to {MAX_ACCELEROMETERS} accelerometers, got {len(layout)}")
    for name in layout:
        if not NAME.fullmatch(name):
            raise ValueError(
                f"the name of an accelerometer must be a letter, then letters, digits or "
                f"underscores, got {name!r}"
            )
    if len({name.lower() for name in layout}) < len(layout):
        raise ValueError(f"names must differ in more than case, got {', '.join(layout)}")
    return layout


Layout = Annotated[dict[str, Accelerometer], AfterValidator(_check_layout)]


@dataclass(frozen=True, kw_only=True)
class _File(Settings):
    sensors: Layout


def to_plain(layout: Mapping[str, Accelerometer] | None) -> dict[str, Any] | None:
    """Return a layout as plain values for JSON or YAML, without fields at their defaults."""
    if layout is None:
        return None
    return TypeAdapter(Layout).dump_python(dict(layout), exclude_defaults=True)


def from_plain(plain: Mapping[str, Any] | None, where: str) -> dict[str, Accelerometer] | None:
    """Return the layout of `to_plain`. Raises ConfigError prefixed by `where`."""
    return None if plain is None else build(_File, {"sensors": plain}, where).sensors


def column(name: str) -> str:
    """Return the name of an accelerometer's column in a table."""
    return f"a_{name.lower()}"
