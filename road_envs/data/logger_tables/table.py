"""Tables of data loggers: CSV dialects, Parquet and MDF4 files as columns by header.

In text, columns are separated by semicolon, tab or comma; with the first two a decimal comma is
recognised. Leading lines that begin with "#" are skipped, and a row of units below the header is
joined to it. A table that is read is a mapping of stripped headers to columns.
"""

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from road_envs._extras import optional_import
from road_envs.config import ConfigError
from road_envs.data.logger_tables.units import is_unit

SNIFFED_CHARACTERS = 10_000
"""Number of characters that are searched for a decimal comma."""

TABLE_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".parquet", ".mf4", ".mdf")

Table = Mapping[str, Any]
"""Columns of a table by header, as pyarrow arrays."""


def read_table(path: Path) -> Table:
    """Read the columns of a table by header. Raises ConfigError."""
    with optional_import("a table as CSV or Parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq

    suffix = path.suffix.lower()
    try:
        if suffix == ".parquet":
            table = pq.read_table(path)
        elif suffix in (".mf4", ".mdf"):
            table = pa.Table.from_pandas(_read_mdf(path), preserve_index=False)
        else:
            table = _read_text(path.read_bytes())
    except (OSError, UnicodeDecodeError, pa.ArrowException) as error:
        reason = str(getattr(error, "strerror", None) or error).splitlines()[0]
        raise ConfigError(f"{path}: no readable table: {reason}") from None
    names = [name.strip() for name in table.column_names]
    lower = [name.lower() for name in names]
    if duplicates := [name for name, low in zip(names, lower, strict=True) if lower.count(low) > 1]:
        raise ConfigError(f"{path}: the column {duplicates[0]} is duplicated")
    return dict(zip(names, table.columns, strict=True))


def numeric_values(column: Any) -> np.ndarray:
    """Return a column as numbers (N,), NaN for empty cells. Raises ValueError naming the row."""
    import pandas as pd
    import pyarrow as pa

    kind = column.type
    if pa.types.is_boolean(kind) or pa.types.is_temporal(kind):
        raise ValueError(f"it holds {kind} values, not numbers")
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
        x = np.array(column.cast(pa.float64(), safe=False).to_numpy(), dtype=float)
    else:
        cells = column.to_pandas()
        x = pd.to_numeric(cells, errors="coerce").to_numpy(dtype=float)
        wrong = np.flatnonzero(np.isnan(x) & cells.notna().to_numpy())
        if wrong.size:
            raise ValueError(f"row {wrong[0] + 1}: {cells.iloc[wrong[0]]!r} is not a number")
    return np.where(np.isfinite(x), x, np.nan)


def _read_text(data: bytes) -> Any:
    with optional_import("a table as CSV or Parquet"):
        from pyarrow import csv

    text = _decode(data).replace("\r\n", "\n")
    while text.startswith("#"):
        text = text.partition("\n")[2]
    head, _, rest = text.partition("\n")
    delimiter = next((mark for mark in ";\t," if mark in head), ",")
    names = [cell.strip().strip('"') for cell in head.split(delimiter)]
    units, _, below = rest.partition("\n")
    cells = [cell.strip(' "[]()') for cell in units.split(delimiter)]
    if len(cells) == len(names) and any(cells) and all(is_unit(cell) for cell in cells if cell):
        pairs = zip(names, cells, strict=True)
        names, rest = [f"{name} [{unit}]" if unit else name for name, unit in pairs], below
    comma = delimiter != "," and re.search(r"\d,\d", rest[:SNIFFED_CHARACTERS]) is not None
    return csv.read_csv(
        io.BytesIO(rest.encode()),
        read_options=csv.ReadOptions(column_names=names),
        parse_options=csv.ParseOptions(delimiter=delimiter),
        convert_options=csv.ConvertOptions(
            decimal_point="," if comma else ".", strings_can_be_null=True
        ),
    )


def _decode(data: bytes) -> str:
    """Return the text of a file in UTF-8, UTF-16 with its mark, or else Windows-1252."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252")


def _read_mdf(path: Path) -> Any:
    """Return the channels of an MDF file as a data frame with the column `t` [s].

    Channels of other rates have empty cells at times at which they were not sampled.
    """
    with optional_import("a measurement file (MDF)"):
        from asammdf import MDF
        from asammdf.blocks.utils import MdfException

    import pandas as pd

    channels: dict[str, Any] = {}
    try:
        with MDF(path) as file:
            for signal in file.iter_channels():
                samples = np.asarray(signal.samples)
                if samples.ndim > 1 or samples.dtype.names:
                    continue
                if samples.dtype.kind == "S":
                    samples = np.char.decode(samples, "utf-8", "replace")
                name = f"{signal.name} [{signal.unit}]" if signal.unit else signal.name
                channels.setdefault(name, pd.Series(samples, signal.timestamps))
    except MdfException as error:
        raise ConfigError(f"{path}: no readable MDF file: {error}") from None
    frame = pd.DataFrame(channels)
    if "t" not in map(str.lower, frame.columns):
        frame.insert(0, "t", frame.index.to_numpy(dtype=float))
    return frame
