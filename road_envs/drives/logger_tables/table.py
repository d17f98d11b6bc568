"""Tables of data loggers: CSV dialects, Parquet and MDF4 files as columns by header.

In text, columns are separated by semicolon, tab, bar, comma or spaces; except with commas, a
decimal comma is recognised. Lines before the header, which has as many cells as the rows below it,
are skipped, and a row of units below it is joined to it. A table that is read is a mapping of
stripped headers to columns.
"""

import io
import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from road_envs.core.config import ConfigError, shown
from road_envs.core.extras import import_pyarrow
from road_envs.core.reading import parsing, read_parquet
from road_envs.drives.logger_tables.mdf import read_mdf
from road_envs.records import units

SNIFFED_CHARACTERS = 10_000  # number of characters that are searched for a decimal comma
SNIFFED_LINES = 60  # number of lines among which the header is looked for

DELIMITERS = (";", "\t", "|", ",", " ")  # separators of columns, in the order of trial
MAX_BYTES = 2**29  # largest text that is read: three hours of ten columns at 500 Hz
MAX_COLUMNS, MAX_HEADER = 4096, 200  # most columns of a table, and most characters of a header

LARGEST = 1e12  # greater numbers [SI] are none of a drive; their squares and sums would overflow
SPREADSHEETS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")  # first bytes of them, and of archives
UNNAMED_INDEX = "__index_level_0__"  # of pandas, in Parquet; the index of a drive is its time

Table = Mapping[str, Any]  # columns of a table by header, as pyarrow arrays


def read_table(path: Path) -> Table:
    """Read the columns of a table by header. Raises ConfigError."""
    suffix = path.suffix.lower()
    with parsing(path, ConfigError, "no readable table"):
        if suffix == ".parquet":
            table = read_parquet(path)
            table.validate(full=True)  # texts that are no UTF-8 are found when they are asked for
        elif suffix in (".mf4", ".mdf"):
            table = read_mdf(path)
        else:
            table = parse_text(read_text(path))
        if not table.num_rows:
            raise ConfigError("no readable table: it has no rows")
        return by_header(table)


def read_text(path: Path) -> bytes:
    """Return the bytes of a file of text, at most MAX_BYTES. Raises ConfigError."""
    if (size := path.stat().st_size) > MAX_BYTES:
        raise ConfigError(
            f"{size / 2**20:.0f} MiB; at most {MAX_BYTES / 2**20:.0f} MiB of text are read: write "
            "it as Parquet, or cut it into shorter drives"
        )
    return path.read_bytes()


def by_header(table: Any) -> Table:
    """Return the columns of a table of pyarrow by header. Raises ConfigError."""
    names = [" ".join(name.split()) for name in table.column_names]
    if UNNAMED_INDEX in names and not {"t", "time"} & {name.lower() for name in names}:
        names[names.index(UNNAMED_INDEX)] = "t"
    _check_headers(names)
    return dict(zip(names, table.columns, strict=True))


def _check_headers(names: Sequence[str]) -> None:
    if len(names) > MAX_COLUMNS:
        raise ConfigError(f"{len(names)} columns; at most {MAX_COLUMNS} are read")
    if (longest := max(map(len, names), default=0)) > MAX_HEADER:
        raise ConfigError(f"a header of {longest} characters; at most {MAX_HEADER} are read")
    count = Counter(name.lower() for name in names)
    if duplicates := [name for name in names if count[name.lower()] > 1]:
        raise ConfigError(f"the column {duplicates[0]} is duplicated")


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
            raise ValueError(f"row {wrong[0] + 1}: {shown(cells.iloc[wrong[0]])} is not a number")
    return np.where(np.isfinite(x), x, np.nan)


def to_si(x: np.ndarray, factor: float) -> np.ndarray:
    """Return `factor` times the numbers `x` (N,). Raises ValueError if one cannot be measured."""
    if (large := np.flatnonzero(np.abs(x) > LARGEST / factor)).size:
        raise ValueError(f"row {large[0] + 1}: {x[large[0]]:.6g} is too large: check its unit")
    return factor * x


def parse_text(data: bytes) -> Any:
    """Return a table of text as one of pyarrow. Raises ConfigError, ValueError."""
    import_pyarrow()  # says what is missing
    from pyarrow import csv

    text = decode(data).replace("\r\n", "\n").replace("\r", "\n")
    head, delimiter, rest = _find_header(text)
    names = [cell.strip().strip('"') for cell in head.split(delimiter)]
    _check_headers(names)
    first, _, below = rest.partition("\n")
    cells = [cell.strip(' "[]()') for cell in first.split(delimiter)]
    given = {units.normalise(cell) for cell in cells if cell}
    known = {unit for factors in units.FACTORS.values() for unit in factors}
    if len(cells) == len(names) and given and given <= known:
        pairs = zip(names, cells, strict=True)
        names, rest = [f"{name} [{unit}]" if unit else name for name, unit in pairs], below
    if not rest.strip():
        raise ValueError("it has no rows")
    comma = delimiter != "," and re.search(r"\d,\d", rest[:SNIFFED_CHARACTERS]) is not None
    return csv.read_csv(
        io.BytesIO(rest.encode()),
        read_options=csv.ReadOptions(column_names=names),
        parse_options=csv.ParseOptions(delimiter=delimiter),
        convert_options=csv.ConvertOptions(
            decimal_point="," if comma else ".", strings_can_be_null=True
        ),
    )


def _find_header(text: str) -> tuple[str, str, str]:
    """Return the line of headers, the separator of columns, and the text below.

    The separator is the first that the last sniffed lines have equally often, as has the header.
    """
    start = 0
    while text.startswith("#", start):
        start = text.find("\n", start) + 1 or len(text)
    lines = itertools.islice(re.compile(r"(?m)^.*$").finditer(text, start), SNIFFED_LINES)
    shown = [(line.start(), line[0]) for line in lines if line[0].strip()]
    if not shown:
        return "", ",", ""
    complete = [line for _, line in shown][: -1 if len(shown) > 2 else None]
    last = complete[-(len(complete) + 1) // 2 :]
    at, head = shown[0]
    for delimiter in DELIMITERS:
        counts = {_cells(line, delimiter) for line in last}
        if len(counts) == 1 and min(counts) > 1:
            at, head = next(x for x in shown if _cells(x[1], delimiter) in counts)
            break
    else:
        delimiter = next((m for m in DELIMITERS if m in head), ",")
    rest = text[at + len(head) + 1 :]
    if delimiter == " ":
        head, rest = (re.sub(r" +", " ", re.sub(r"(?m)^ +| +$", "", x)) for x in (head, rest))
    return head, delimiter, rest


def _cells(line: str, mark: str) -> int:
    """Return the number of cells of a line; separators in quotes are none."""
    line = re.sub(r'"[^"]*"', "", line)
    return len(line.split()) if mark == " " else line.count(mark) + 1


def decode(data: bytes) -> str:
    """Return the text of a file in UTF-8, UTF-16 with its mark, or else Windows-1252.

    Raises ConfigError for a spreadsheet or an archive, ValueError if it is no text.
    """
    if data[:4] in SPREADSHEETS:
        raise ConfigError("a spreadsheet or an archive: save its sheet as CSV")
    has_mark = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    for code in ["utf-16"] if has_mark else ["utf-8-sig", "cp1252"]:
        with suppress(UnicodeDecodeError):
            text = data.decode(code)
            if "\0" not in text:
                return text
    raise ValueError(
        "it has zero bytes or others of no text in UTF-8, UTF-16 with its mark, or Windows-1252"
    )
