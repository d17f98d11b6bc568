"""A task as JSON types, and the files that it names: surfaces, roads, vehicles, instruments."""

import dataclasses
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from road_envs.roads import KINDS
from road_envs.roads.api import map_paths

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
    return hashlib.sha256(b"".join(file.read_bytes() for file in files_of(path))).hexdigest()


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
