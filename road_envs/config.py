"""Strict loading of YAML files into frozen dataclasses.

An unknown key, a missing key, a wrong type or an invalid value raises a ConfigError of one
sentence, which names the place, the value and what is allowed.

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
"""Value of `__pydantic_config__` in every configuration dataclass."""


class ConfigError(ValueError):
    """Invalid input. The message is one sentence that names the value and the valid choices."""


def folder() -> Path:
    """Return the folder of the shipped configurations, in a checkout or in an installed wheel."""
    here = Path(__file__).parent
    packaged = here / "configs"
    return packaged if packaged.is_dir() else here.parent / "configs"


def names(kind: str) -> list[str]:
    """Return the names of the shipped configurations of a kind, such as "vehicles" or "roads"."""
    return sorted(f.stem for f in (folder() / kind).glob("*.yaml"))


def validate_choice(what: str, given: object, known: Mapping[str, Any] | list[str]) -> str:
    """Return `given` if it is among `known`; otherwise raise a ConfigError with the choices.

    `what` is the name of the kind of thing in the message.
    """
    if isinstance(given, str) and given in known:
        return given
    close = difflib.get_close_matches(str(given), list(known), n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise ConfigError(f"unknown {what} {given!r}{hint}; known: {', '.join(sorted(known))}")


class _UniqueKeyLoader(yaml.SafeLoader):
    """YAML loader that rejects duplicate keys; plain YAML would silently keep the last one."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: dict[Any, int] = {}
        keys = [key for key, _ in node.value] if isinstance(node, yaml.MappingNode) else []
        for key in (key for key in keys if isinstance(key, yaml.ScalarNode)):
            name, line = (key.tag, key.value), key.start_mark.line + 1
            if name in seen:
                raise ConfigError(
                    f"the key {key.value!r} is duplicated, in lines {seen[name]} and {line}"
                )
            seen[name] = line
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file. Raises ConfigError if unreadable or not a mapping."""
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: expected a mapping of keys to values, got {_type_name(data)}")
    return data


def find(kind: str, name: str | Path) -> Path:
    """Return the file of a shipped configuration, or `name` itself if it is a YAML path."""
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        return path
    stem = validate_choice(kind.removesuffix("s"), str(name), names(kind))
    return folder() / kind / f"{stem}.yaml"


def load(cls: type[T], kind: str, name: str | Path) -> T:
    """Load a configuration by shipped name or by path. Raises ConfigError."""
    path = find(kind, name)
    return build(cls, read_yaml(path), str(path))


def build(cls: type[T], data: Mapping[str, Any], where: str) -> T:
    """Build a frozen dataclass from a mapping. Raises ConfigError prefixed by `where`."""
    try:
        # JSON mode converts lists to tuples but keeps "16e-6", which YAML reads as a string
        text = json.dumps(data, default=str)
    except (TypeError, ValueError) as error:  # a date as a key, or a mapping that contains itself
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
    """Return one sentence for the first error; the other errors are only counted."""
    # unknown keys first: a misspelt key also causes a "missing" error
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
            expected = first["msg"][0].lower() + first["msg"][1:]
            text = f"{expected}, got {first['input']!r} ({_type_name(first['input'])})"
    return f"{at}: {text}{more}"


def _dataclass_at(cls: Any, path: list[str]) -> type | None:
    """Return the dataclass at `path` inside `cls`, or None if the types do not determine it."""
    for name in path:
        if not dataclasses.is_dataclass(cls):
            return None
        hints = {f.name: f.type for f in dataclasses.fields(cls)}
        cls = hints.get(name)
        if get_origin(cls) is Annotated:
            cls = get_args(cls)[0]
    return cls if isinstance(cls, type) and dataclasses.is_dataclass(cls) else None


def _type_name(value: object) -> str:
    """Return the type of a YAML value in plain words."""
    return {
        "str": "text",
        "int": "a whole number",
        "float": "a number",
        "bool": "true/false",
        "list": "a list",
        "dict": "a mapping",
        "NoneType": "nothing",
    }.get(type(value).__name__, type(value).__name__)
