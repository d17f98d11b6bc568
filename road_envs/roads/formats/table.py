"""Reader of tables of distance and height: plain text and Parquet.

A table has the columns distance, left, right [m], or distance and one height for both wheel paths.
Columns of a text file are separated by white space, comma, semicolon or tab; with the latter two
the decimal mark may be a comma. Lines that begin with "#" and one line of column names are skipped;
a name may have a unit, as in "left [mm]" and "left_mm".
"""

import re
from typing import NamedTuple

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.core.extras import import_pyarrow
from road_envs.core.reading import MAX_COMPRESSION
from road_envs.records import units
from road_envs.roads.formats.opencrg import MAX_LENGTH, SurfaceFileError, checked_heights, require

COLUMNS = "the columns must be distance, left, right, or distance, height, got"


class WheelPaths(NamedTuple):
    """Heights `z` (2, N) [m] of both wheel paths, their spacing, and the first station [m]."""

    z: np.ndarray
    ds: float
    notes: tuple[str, ...] = ()
    start: float = 0.0


def parse_text(data: bytes) -> WheelPaths:
    """Return both wheel paths from the bytes of a text file. Raises SurfaceFileError."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SurfaceFileError("not a text file") from None
    lines = [s for line in text.splitlines() if (s := line.strip()) and not s.startswith("#")]
    mark = next((mark for mark in ";\t," if lines and mark in lines[0]), None)
    names: list[str] = []
    try:
        float(_cells(lines[0], mark)[0] if lines else "0")
    except ValueError:
        names = [cell.lower() for cell in _cells(lines.pop(0), mark)]
    require(lines, "the table is empty")
    if mark in (";", "\t") and any(re.search(r"\d,\d", line) for line in lines[:100]):
        lines = [line.replace(",", ".") for line in lines]
    table = parse_number_rows([re.sub("[,;\t]", " ", line) for line in lines])
    require(table.shape[1] in (2, 3), f"{COLUMNS} {table.shape[1]} columns")
    order = [1, -1]
    if len(names) == table.shape[1]:
        found = [(name, units.split_header(name, "distance")[1] or "m") for name in names]
        factors = [metres(unit, f"the column {name}") for name, unit in found]
        if factors[1] != factors[-1]:
            raise SurfaceFileError(f"the heights {names[1]} and {names[2]} have different units")
        table = table * factors
        if len(names) == 3 and "right" in names[1] and "left" in names[2]:
            order = [2, 1]
    return _resample_evenly(table[:, 0], checked_heights(table[:, order].T))


def _cells(line: str, mark: str | None) -> list[str]:
    """Return the cells of a line; those of white space are split outside of brackets."""
    return [cell.strip() for cell in re.split(mark or r"\s+(?![\[(])", line)]


def metres(unit: str, what: str) -> float:
    """Return the metres in a unit, that of `what`. Raises SurfaceFileError."""
    try:
        return units.factor("distance", unit)
    except ConfigError as error:
        raise SurfaceFileError(f"{what}: {error}") from None


def parse_parquet(data: bytes) -> WheelPaths:
    """Return both wheel paths from the bytes of a Parquet file. Raises SurfaceFileError."""
    pa, pq = import_pyarrow()
    try:
        file = pq.ParquetFile(
            pa.BufferReader(data),
            page_checksum_verification=True,
            thrift_string_size_limit=len(data),
            thrift_container_size_limit=len(data),
        )
        names = _columns(file.schema_arrow.names)
        rows = file.metadata.num_rows
        if not 0 < 8 * len(names) * rows <= MAX_COMPRESSION * len(data):
            raise SurfaceFileError(f"damaged: {rows} rows in {len(data)} bytes")
        table = file.read(columns=names, use_threads=False)
        columns = [table[name].to_numpy().astype(float) for name in names]
    except SurfaceFileError:
        raise
    except (pa.ArrowException, OSError, ValueError, TypeError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise SurfaceFileError(f"damaged, or no Parquet file: {reason}") from None
    return _resample_evenly(columns[0], checked_heights(np.array([columns[1], columns[-1]])))


def parse_number_rows(lines: list[str], comments: str | None = "#") -> np.ndarray:
    """Return the numbers (M, K) of `lines` with K numbers each. Raises SurfaceFileError."""
    try:
        return np.loadtxt(lines, ndmin=2, comments=comments)
    except ValueError as error:
        raise SurfaceFileError(f"not a table of numbers: {error}") from None


def _resample_evenly(s: np.ndarray, z: np.ndarray) -> WheelPaths:
    """Wheel paths `z` (2, N) at `s` (N,) [m]; uneven ones are resampled to the median spacing."""
    if not (np.abs(s) < MAX_LENGTH).all():
        raise SurfaceFileError(
            f"distances must be below {MAX_LENGTH:g} m, got {s[~(np.abs(s) < MAX_LENGTH)][0]:g} m"
        )
    steps = np.diff(s)
    if not (steps > 0.0).all():
        raise SurfaceFileError(
            f"the distance does not increase at row {np.argmin(steps > 0.0) + 2}; sort the rows"
        )
    require(s.size >= 2, "at least 4 stations are required, got 1")
    ds = float(np.median(steps))
    if (np.abs(steps - ds) < 1e-3 * ds).all():  # uniform
        return WheelPaths(z, float((s[-1] - s[0]) / steps.size), start=float(s[0]))
    size = float(s[-1] - s[0]) / ds + 1.0
    if size > 4.0 * s.size:
        raise SurfaceFileError(
            f"the stations are too uneven to be interpolated: {s.size} stations would become "
            f"{size:.0f}"
        )
    grid = s[0] + ds * np.arange(int(size + 1e-9))
    even = np.array([np.interp(grid, s, path) for path in z])
    return WheelPaths(even, ds, (f"resampled to {ds:.4g} m",), float(s[0]))


def _columns(names: list[str]) -> list[str]:

    for layout in (("distance", "left", "right"), ("distance", "height")):
        matches = [[name for name in names if name.strip().lower() == key] for key in layout]
        if all(len(same) == 1 for same in matches):
            return [name for (name,) in matches]
    raise SurfaceFileError(f"{COLUMNS} {', '.join(names) or 'none'}")
