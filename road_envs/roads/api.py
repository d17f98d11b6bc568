"""The road interface, and loading of roads by name, path or mapping."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from pydantic import PlainValidator

from road_envs.core.config import ConfigError, build, find, read_yaml, validate_choice
from road_envs.roads.formats.opencrg import SurfaceFileError
from road_envs.roads.measured import SURFACE_SUFFIXES, Measured
from road_envs.roads.surface import Surface

KINDS: dict[str, type] = {}
"""Road classes by the `kind` of their configuration. `road_envs.roads` fills it in: composite roads
load other roads, so that their module imports this one."""


@runtime_checkable
class Road(Protocol):
    """Frozen description of a road from station 0 to `length` [m]."""

    @property
    def length(self) -> float: ...

    def realise(self, rng: np.random.Generator) -> Surface:
        """Draw one surface, which is determined by the road and the state of `rng`."""


def load_road(source: str | Path | Mapping[str, Any] | Road) -> Road:
    """Load a road from a shipped name ("iso_d"), a YAML path, a surface file or a mapping.

    A mapping has the key `kind` and the settings of that kind, or `name`, a shipped road, and
    optionally `length`. Paths in a YAML file are relative to it. A road is returned as it is.
    Raises ConfigError.
    """
    if isinstance(source, Mapping):
        return _from_mapping(source)
    if isinstance(source, Road):
        return source
    if not isinstance(source, str | Path):
        raise ConfigError(f"a road must be given as a name, a path or a mapping, got {source!r}")
    if Path(source).suffix.lower() in SURFACE_SUFFIXES:
        return Measured(path=str(source))
    path = find("roads", source)
    data = map_paths(read_yaml(path), lambda file: str(path.parent / file))
    try:
        return _from_mapping(data)
    except ConfigError as error:
        raise type(error)(f"{path}: {error}") from None


def realise_road(
    road: str | Path | Mapping[str, Any] | Road,
    seed: int | np.random.SeedSequence,
    length: float | None = None,
) -> Surface:
    """The surface drawn from `seed`, of another `length` [m] if given. Raises ConfigError."""
    described = load_road(road) if length is None else with_length(load_road(road), length)
    surface = described.realise(np.random.default_rng(seed))
    if isinstance(described, Measured):
        _check_slopes(surface)
    return surface


def _check_slopes(surface: Surface) -> None:
    """Raise SurfaceFileError if the slopes of a surface are those of no road."""
    z, ds = surface.z, surface.ds
    stride = max(1, round(0.1 / ds))
    slope = float(np.sqrt(np.mean((np.diff(z[:, ::stride], axis=1) / (stride * ds)) ** 2)))
    if slope > 1.0:  # that of Belgian paving is 0.1
        raise SurfaceFileError(
            f"{surface.name}: its slopes have an RMS of {slope:.3g} m/m, as of heights in "
            "millimetres that are read as metres: give metres, or name the unit in the header of "
            "a text file: left [mm]"
        )


def with_length(road: Road, length: float) -> Road:
    """Return the road with another length [m]; a road made of one other passes it on.

    Raises ConfigError if the length follows from other settings.
    """
    if isinstance(length, bool) or not isinstance(length, int | float):
        raise ConfigError(f"length must be a number, got {length!r}")
    settings: Any = road
    if hasattr(road, "with_length"):  # its length is that of an inner road plus or times a constant
        return settings.with_length(length)
    if "length" not in {f.name for f in dataclasses.fields(settings)}:
        kind = next((k for k, cls in KINDS.items() if cls is type(road)), type(road).__name__)
        raise ConfigError(f"the length of a {kind} road follows from its other settings")
    try:
        return dataclasses.replace(settings, length=float(length))
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(str(error)) from None


def _from_mapping(data: Mapping[str, Any]) -> Road:
    settings = dict(data)
    if "name" in settings and "kind" not in settings:
        if extra := settings.keys() - {"name", "length"}:
            raise ConfigError(f"road: unknown {sorted(extra)} next to name; known: length")
        road = load_road(settings["name"])
        return with_length(road, settings["length"]) if "length" in settings else road
    if "kind" not in settings:
        raise ConfigError(f"road: missing kind; known: {', '.join(KINDS)}")
    kind = validate_choice("kind of road", settings.pop("kind"), KINDS)
    return build(KINDS[kind], settings, kind)


def map_paths(value: Any, change: Callable[[str], str], texts: Collection[str] = ()) -> Any:
    """Return YAML or JSON types with every path of a file changed, but not under keys in `texts`.

    A `name` may be a path where it names a road: alone, or beside a `length`.
    """
    if isinstance(value, list):
        return [map_paths(item, change, texts) for item in value]
    if isinstance(value, dict):
        kept = texts if value.keys() <= {"name", "length"} else {"name", *texts}
        return {k: x if k in kept else map_paths(x, change, texts) for k, x in value.items()}
    suffixes = (".yaml", ".yml", *SURFACE_SUFFIXES)
    is_path = isinstance(value, str) and Path(value).suffix.lower() in suffixes
    return change(value) if is_path else value


AnyRoad = Annotated[Road, PlainValidator(load_road), "", "a road: shipped name, path or mapping"]
