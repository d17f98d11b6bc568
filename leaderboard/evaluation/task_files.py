"""Files that a task names: surfaces, roads, vehicles, instruments."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from road_envs.roads.measured import SURFACE_SUFFIXES

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


_SUFFIXES = (".yaml", ".yml", *SURFACE_SUFFIXES)


def with_paths(value: Any, change: Callable[[str], str]) -> Any:
    """Return the YAML or JSON types of a task with every path of a file changed."""
    if isinstance(value, list):
        return [with_paths(item, change) for item in value]
    if isinstance(value, dict):
        texts = {"name", *DESCRIPTIVE_FIELDS}
        return {k: x if k in texts else with_paths(x, change) for k, x in value.items()}
    is_path = isinstance(value, str) and Path(value).suffix.lower() in _SUFFIXES
    return change(value) if is_path else value
