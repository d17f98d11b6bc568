"""Roads: frozen descriptions that can be realised as a `Surface`.

To add one: write a file beside this one with a frozen dataclass that has `length` and
`realise(rng)`, put it into KINDS, add a YAML to `configs/roads` and run `pytest`.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from road_envs.config import ConfigError, build, find, one_of, read_yaml
from road_envs.roads.belgian import Belgian
from road_envs.roads.composite import Altered, Fixed, Flat, Road
from road_envs.roads.formats.write import write, write_csv
from road_envs.roads.iso8608 import Iso8608
from road_envs.roads.layout import Joined, Offset, Repeated, RunIn, Scaled, Summed
from road_envs.roads.measured import SUFFIXES, Measured
from road_envs.roads.obstacles import Defects, Potholes
from road_envs.roads.sine_sweep import Sweep
from road_envs.roads.surface import Surface
from road_envs.roads.trapezoids import Bumps

__all__ = ["KINDS", "Road", "Surface", "load_road", "with_length", "write", "write_csv"]

KINDS: dict[str, type] = {
    "altered": Altered,
    "belgian": Belgian,
    "bumps": Bumps,
    "defects": Defects,
    "fixed": Fixed,
    "flat": Flat,
    "iso8608": Iso8608,
    "joined": Joined,
    "measured": Measured,
    "offset": Offset,
    "potholes": Potholes,
    "repeated": Repeated,
    "run_in": RunIn,
    "scaled": Scaled,
    "summed": Summed,
    "sweep": Sweep,
}


def load_road(source: str | Path | Mapping[str, Any]) -> Road:
    """A road from a shipped name ("iso_d"), a YAML path, a surface file or a mapping.

    A mapping has `kind` and the settings of that kind, or `name` of a shipped road and perhaps
    another `length`. Raises ConfigError.
    """
    if isinstance(source, Mapping):
        return _from_mapping(source, "")
    if not isinstance(source, str | Path):
        raise ConfigError(f"a road is a name, a path or a mapping, got {source!r}")
    if Path(source).suffix.lower() in SUFFIXES:
        return Measured(path=str(source))
    path = find("roads", source)
    return _from_mapping(_beside(read_yaml(path), path.parent), str(path))


def with_length(road: Road, length: float) -> Road:
    """The same road with another length [m]; reaches into a road that is made of one other."""
    if isinstance(length, bool) or not isinstance(length, int | float):
        raise ConfigError(f"length must be a number, got {length!r}")
    if isinstance(road, Scaled):
        return dataclasses.replace(road, road=with_length(road.road, length / road.length_factor))
    if isinstance(road, Fixed | Altered | RunIn | Offset):
        added = road.length - road.road.length
        return dataclasses.replace(road, road=with_length(road.road, length - added))
    settings: Any = road
    if "length" not in {f.name for f in dataclasses.fields(settings)}:
        raise ConfigError(f"the length of a {_kind(road)} road follows from its other settings")
    try:
        return dataclasses.replace(settings, length=float(length))
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(str(error)) from None


def _from_mapping(data: Mapping[str, Any], where: str) -> Road:
    settings = dict(data)
    if "name" in settings and "kind" not in settings:
        return _shipped(settings, where)
    if "kind" not in settings:
        raise ConfigError(f"{where or 'road'}: missing kind; known: {', '.join(KINDS)}")
    kind = one_of("kind of road", settings.pop("kind"), KINDS)
    return build(KINDS[kind], settings, where or kind)


def _beside(data: Any, folder: Path) -> Any:
    """Settings in which the paths of surface files are relative to `folder` no longer."""
    if isinstance(data, list):
        return [_beside(value, folder) for value in data]
    if not isinstance(data, dict):
        return data
    inner = {key: _beside(value, folder) for key, value in data.items()}
    if data.get("kind") == "measured" and isinstance(data.get("path"), str):
        inner["path"] = str(folder / data["path"])
    return inner


def _shipped(settings: dict[str, Any], where: str) -> Road:
    if extra := settings.keys() - {"name", "length"}:
        raise ConfigError(f"{where or 'road'}: unknown {sorted(extra)} beside name; known: length")
    road = load_road(settings["name"])
    return with_length(road, settings["length"]) if "length" in settings else road


def _kind(road: Road) -> str:
    return next((kind for kind, cls in KINDS.items() if type(road) is cls), type(road).__name__)
