"""A task as JSON types, and the files that it names: surfaces, roads, vehicles, instruments."""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from road_envs.core.reading import regular
from road_envs.roads import KINDS
from road_envs.roads.api import map_paths
from road_envs.roads.measured import Measured

DESCRIPTIVE_FIELDS = frozenset(
    {"title", "board", "source", "sources", "note", "claimed_level_error", "families"}
)
"""Fields that only describe a task: editing them does not invalidate results."""


def files_of(path: str) -> list[Path]:
    """Return a file and the one beside it that holds the numbers of an ERD surface."""
    binary = Path(path).with_suffix(".bin")
    return [Path(path), *([binary] if path.lower().endswith(".erd") and binary.exists() else [])]


def digest_of(path: str) -> str:
    """Return the SHA-256 of a file with that beside it."""
    content = b"".join(regular(file).read_bytes() for file in files_of(path))
    return hashlib.sha256(content).hexdigest()


def with_paths(value: Any, change: Callable[[str], str]) -> Any:
    """Return the YAML or JSON types of a task with every path of a file changed."""
    return map_paths(value, change, DESCRIPTIVE_FIELDS)


def _fields(value: Any) -> dict[str, Any]:
    return {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}


def to_json_types(value: Any, fields: Callable[[Any], dict[str, Any]] = _fields) -> Any:
    """Return `value` as JSON types that `config.build` parses; roads have a key `kind`.

    `fields` returns the fields of a dataclass that are kept.
    """
    if dataclasses.is_dataclass(value):
        kept = {name: to_json_types(item, fields) for name, item in fields(value).items()}
        kind = next((kind for kind, cls in KINDS.items() if type(value) is cls), None)
        return kept if kind is None else {"kind": kind, **kept}
    if isinstance(value, tuple | list):
        return [to_json_types(item, fields) for item in value]
    if isinstance(value, dict):
        return {str(key): to_json_types(item, fields) for key, item in value.items()}
    return value


def settings_digest(value: Any) -> str:
    """Return the SHA-256 of dataclasses, or lists of them, but for what only describes a task."""
    text = json.dumps(to_json_types(value, _digested_fields), sort_keys=True, default=repr)
    return hashlib.sha256(text.encode()).hexdigest()


def _digested_fields(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass that its digest covers; a surface file by its content.

    So are vehicle and instruments, without the folder of their file. A mapping becomes pairs, whose
    order counts: that of accelerometers is that of a record's rows. Fields at their defaults are
    left out, so that a new option leaves the digests of all tasks as they are; code that changes a
    default changes the version of the evaluation code.
    """
    kept: dict[str, Any] = {
        f.name: list(x.items()) if isinstance(x, dict) else x
        for f in dataclasses.fields(value)
        if f.name not in DESCRIPTIVE_FIELDS and not _is_default(f, x := getattr(value, f.name))
    }
    named = [name for name in ("car", "instruments") if isinstance(kept.get(name), str)]
    kept |= {name: Path(kept[name]).name for name in named}
    if isinstance(value, Measured):
        kept["path"] = digest_of(value.path)
    return kept


def _is_default(f: dataclasses.Field[Any], value: Any) -> bool:
    made = f.default_factory() if f.default_factory is not dataclasses.MISSING else f.default
    return made is not dataclasses.MISSING and type(made) is type(value) and bool(made == value)
