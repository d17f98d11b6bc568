"""Racelogic VBOX files (`.vbo`): text in sections, of which `[data]` holds one row for each sample.

After https://en.racelogic.support/VBOX_Automotive/Knowledge_Base/VBO_File_Format and "VBO file
structure" of developers.racelogic.co.uk: `[column names]` names the columns; `time` is HHMMSS.SS of
UTC, `lat` and `long` are in minutes, north and west positive; `velocity` is in km/h, or in knots
where `[header]` says so. Accelerations of IMU channels are in g. The date is in the first line.
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from typing import Any

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.table import decode


def is_vbo(data: bytes) -> bool:
    return b"[column names]" in data[:20_000].lower() and b"[header]" in data[:20_000].lower()


def parse_vbo(data: bytes) -> Mapping[str, Any]:
    """Return the columns of a VBOX file by header, in our units. Raises ConfigError."""
    import pyarrow as pa

    text = decode(data)
    found = re.findall(r"(?ms)^\[([^\]\n]+)\]\s*$(.*?)(?=^\[|\Z)", text)
    sections = {name.lower(): body for name, body in found}
    names = sections.get("column names", "").split()
    rows = [line.split() for line in sections.get("data", "").splitlines() if line.strip()]
    if not names or not rows:
        raise ConfigError("a VBOX file without columns or data")
    wrong = next((k for k, row in enumerate(rows, 1) if len(row) != len(names)), None)
    if wrong is not None:
        raise ConfigError(
            f"row {wrong} of the data has {len(rows[wrong - 1])} values for {len(names)} columns"
        )
    try:
        values = np.array(rows, dtype=float)
    except ValueError as error:
        raise ConfigError(f"the data hold no number: {error}") from None
    knots = "velocity knots" in sections.get("header", "").lower()
    columns: dict[str, Any] = {}
    for name, x in zip(names, values.T, strict=True):
        header, x = _column(name.lower(), x, knots)
        if header in columns:
            raise ConfigError(f"the column {name} is duplicated")
        columns[header] = x
    if "t [s]" not in columns:
        raise ConfigError(f"a VBOX file without the column time; it has {', '.join(names)}")
    columns["t [s]"] = columns["t [s]"] + _date(text.partition("\n")[0])
    return {header: pa.chunked_array([x]) for header, x in columns.items()}


def _column(name: str, x: np.ndarray, knots: bool) -> tuple[str, np.ndarray]:
    """Return header and values of a column as this package reads them."""
    if name == "time":
        hours, minutes, seconds = x // 1e4, x // 100.0 % 100.0, x % 100.0
        return "t [s]", np.unwrap(3600.0 * hours + 60.0 * minutes + seconds, period=86400.0)
    if name in ("lat", "latitude"):
        return "lat", x / 60.0
    if name in ("long", "longitude"):
        return "lon", -x / 60.0  # west is positive in the file
    if name == "velocity":
        return f"v [{'kn' if knots else 'km/h'}]", x
    if re.fullmatch(r"([xyz]_?acc(el)?\w*|acc(el)?\w*_?[xyz])", name):
        return f"{name} [g]", x
    return name, x


def _date(line: str) -> float:
    """Return midnight of the day in the first line [s since 1970]; 0 without one."""
    if found := re.search(r"\d{1,2}/\d{1,2}/\d{4}", line):
        with suppress(ValueError):
            return datetime.strptime(f"{found[0]} +0000", "%d/%m/%Y %z").timestamp()
    return 0.0
