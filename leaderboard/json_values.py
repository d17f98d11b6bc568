"""Settings as JSON types that `config.build` parses."""

import dataclasses
from collections.abc import Callable
from typing import Any

from road_envs.roads import KINDS


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
