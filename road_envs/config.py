"""YAML onto frozen dataclasses, strictly: an unknown key, a missing key, a wrong type or an
impossible value is one sentence that says where and what would fit.

Configurations are looked up by name in the packaged folder, or read from a path:
`load(VehicleParameters, "vehicles", "land_rover_defender_110")`, `load(..., "my_car.yaml")`.
"""

import dataclasses
import difflib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_args, get_origin

import yaml
from pydantic import TypeAdapter, ValidationError

T = TypeVar("T")

STRICT = {"extra": "forbid", "arbitrary_types_allowed": True}
"""Goes into every configuration dataclass as `__pydantic_config__`."""


class ConfigError(ValueError):
    """Bad input, said in one sentence that names the culprit and the valid choices."""


def folder() -> Path:
    """The folder with the shipped configurations, in a checkout as in an installed wheel."""
    here = Path(__file__).parent
    packaged = here / "configs"
    return packaged if packaged.is_dir() else here.parent / "configs"


def names(kind: str) -> list[str]:
    """Names of the shipped configurations of one kind: vehicles, roads, sensors or tasks."""
    return sorted(f.stem for f in (folder() / kind).glob("*.yaml"))


def validate_choice(what: str, given: object, known: Mapping[str, Any] | list[str]) -> str:
    """`given` if it is among `known`; else a ConfigError that names the choices."""
    if isinstance(given, str) and given in known:
        return given
    close = difflib.get_close_matches(str(given), list(known), n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise ConfigError(f"unknown {what} {given!r}{hint}; known: {', '.join(sorted(known))}")


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses a key that stands twice in one mapping, of which YAML would keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: dict[Any, int] = {}
        keys = [key for key, _ in node.value] if isinstance(node, yaml.MappingNode) else []
        for key in (key for key in keys if isinstance(key, yaml.ScalarNode)):
            name, line = (key.tag, key.value), key.start_mark.line + 1
            if name in seen:
                raise ConfigError(
                    f"the key {key.value!r} stands twice, line {seen[name]} and {line}"
                )
            seen[name] = line
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file. Raises ConfigError if it is unreadable or not a mapping."""
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: a mapping of keys to values is wanted, got {_type_name(data)}")
    return data


def find(kind: str, name: str | Path) -> Path:
    """The file of a shipped configuration by name, or the path itself if it names a YAML file."""
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        return path
    return (
        folder() / kind / f"{validate_choice(kind.removesuffix('s'), str(name), names(kind))}.yaml"
    )


def load(cls: type[T], kind: str, name: str | Path) -> T:
    """A configuration by shipped name or by path. Raises ConfigError."""
    path = find(kind, name)
    return build(cls, read_yaml(path), str(path))


def build(cls: type[T], data: Mapping[str, Any], where: str) -> T:
    """A frozen dataclass from a mapping. Raises ConfigError with `where` in front."""
    try:
        # JSON mode: lists may become tuples, while "16e-6" stays the string that YAML made of it
        text = json.dumps(data, default=str)
    except (TypeError, ValueError) as error:  # a date as a key, a mapping inside itself
        raise ConfigError(f"{where}: {error}") from None
    try:
        return _adapter(cast(Any, cls)).validate_json(text, strict=True)
    except ValidationError as error:
        raise ConfigError(_format_error(error, where, cls)) from None
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


@cache
def _adapter(cls: Any) -> TypeAdapter:
    return TypeAdapter(cls)


def _format_error(error: ValidationError, where: str, cls: type) -> str:
    unknown_first = sorted(error.errors(), key=lambda e: e["type"] != "unexpected_keyword_argument")
    first = unknown_first[0]
    path = [str(p) for p in first["loc"]]
    at = f"{where}: {'.'.join(path)}" if path else where
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    match first["type"]:
        case "unexpected_keyword_argument":
            owner = _dataclass_at(cls, path[:-1])
            known = sorted(f.name for f in dataclasses.fields(owner) if f.init) if owner else []
            close = difflib.get_close_matches(path[-1], known, n=1)
            hint = f", did you mean {close[0]!r}" if close else ""
            text = f"unknown key{hint}; known: {', '.join(known)}"
        case "missing":
            text = "missing"
        case "value_error":
            text = str(first["ctx"]["error"])
        case _:
            wanted = first["msg"][0].lower() + first["msg"][1:]
            text = f"{wanted}, got {first['input']!r} ({_type_name(first['input'])})"
    return f"{at}: {text}{more}"


def _dataclass_at(cls: Any, path: list[str]) -> type | None:
    """The dataclass that stands at `path` inside `cls`, if it can be told from the types."""
    for name in path:
        if not dataclasses.is_dataclass(cls):
            return None
        hints = {f.name: f.type for f in dataclasses.fields(cls)}
        cls = hints.get(name)
        if get_origin(cls) is Annotated:
            cls = get_args(cls)[0]
    return cls if isinstance(cls, type) and dataclasses.is_dataclass(cls) else None


def _type_name(value: object) -> str:
    return {
        "str": "text",
        "int": "a whole number",
        "float": "a number",
        "bool": "true/false",
        "list": "a list",
        "dict": "a mapping",
        "NoneType": "nothing",
    }.get(type(value).__name__, type(value).__name__)
