"""Tables as JSON: one object a line (https://jsonlines.org), or one array of objects.

Nested objects are columns with a dot, as in `acceleration.x`; what a line lacks is empty.
"""

import json
from collections.abc import Mapping
from typing import Any

from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.table import decode

MAX_DEPTH = 4  # most levels of objects inside objects


def is_json(data: bytes) -> bool:
    """Whether a file begins as a JSON object, or an array of them."""
    begin = data[:200].lstrip(b"\xef\xbb\xbf \t\r\n")
    return begin[:1] == b"{" or (begin[:1] == b"[" and begin[1:].lstrip()[:1] == b"{")


def parse_json(data: bytes) -> Mapping[str, Any]:
    """Return the columns of a JSON table by name. Raises ConfigError."""
    import pandas as pd
    import pyarrow as pa

    text = decode(data).strip()
    try:
        if text.startswith("["):
            rows = json.loads(text)
        else:
            rows = [json.loads(line) for line in text.splitlines() if line.strip()]
    except (ValueError, RecursionError) as error:
        said = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise ConfigError(f"no readable JSON lines, one object each: {said}") from None
    if wrong := next((k for k, row in enumerate(rows, 1) if not isinstance(row, dict)), None):
        raise ConfigError(f"line {wrong} is no JSON object")
    try:
        frame = pd.DataFrame([_flat(row) for row in rows])
        return {name: pa.chunked_array([pa.array(frame[name])]) for name in frame}
    except (pa.ArrowException, ValueError, TypeError, OverflowError) as error:
        raise ConfigError(f"a column of the JSON lines holds mixed values: {error}") from None


def _flat(row: Mapping[str, Any], prefix: str = "", depth: int = 0) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in row.items():
        if isinstance(value, dict) and depth < MAX_DEPTH:
            found |= _flat(value, f"{prefix}{key}.", depth + 1)
        elif not isinstance(value, list | dict):
            found[f"{prefix}{key}"] = value
    return found
