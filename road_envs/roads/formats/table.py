"""Tables of distance and height as wheel paths: plain text, and Parquet.

A table has the columns distance, left, right [m], or distance and one height for both paths. In
a text file they stand apart by white space, comma, semicolon or tab; lines that begin with "#"
and one line of names are skipped. In a Parquet file the columns go by their names.
"""

import re

import numpy as np

from road_envs._extras import optional_import
from road_envs.roads.formats.opencrg import MAX_LENGTH, SurfaceFileError, checked_heights

EVEN_TOLERANCE = 1e-3
"""Spacings that differ from their median by less than this share of it count as even."""

MAX_COMPRESSION = 100
"""A Parquet file that claims more bytes of numbers than this many times its own is refused."""

WheelPaths = tuple[np.ndarray, float, tuple[str, ...]]
"""Heights (2, N) [m] of the left and right wheel path, their spacing [m], and notes."""


def parse_text(data: bytes) -> WheelPaths:
    """Both wheel paths from the bytes of a text file."""
    try:
        text = re.sub("[,;\t]", " ", data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise SurfaceFileError("not a text file") from None
    lines = [s for line in text.splitlines() if (s := line.strip()) and not s.startswith("#")]
    names = lines.pop(0).lower().split() if lines and not _is_number(lines[0].split()[0]) else []
    if not lines:
        raise SurfaceFileError("the table is empty")
    table = parse_number_rows(lines)
    if table.shape[1] not in (2, 3):
        raise SurfaceFileError(
            f"wanted the columns distance, left, right, or distance, height, "
            f"got {table.shape[1]} columns"
        )
    order = [1, -1]
    if len(names) == 3 and "right" in names[1] and "left" in names[2]:
        order = [2, 1]
    return resample_evenly(table[:, 0], checked_heights(table[:, order].T))


def parse_parquet(data: bytes) -> WheelPaths:
    """Both wheel paths from the bytes of a Parquet file."""
    with optional_import("a table as CSV or Parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq

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
        raise SurfaceFileError(f"no readable Parquet file: {reason}") from None
    return resample_evenly(columns[0], checked_heights(np.array([columns[1], columns[-1]])))


def parse_number_rows(lines: list[str], comments: str | None = "#") -> np.ndarray:
    """The numbers (M, K) on `lines` that have equally many each, up to a mark of `comments`."""
    try:
        return np.loadtxt(lines, ndmin=2, comments=comments)
    except ValueError as error:
        raise SurfaceFileError(f"not a table of numbers: {error}") from None


def resample_evenly(s: np.ndarray, z: np.ndarray) -> WheelPaths:
    """Wheel paths `z` (2, N) at the stations `s` (N,) [m] on an even grid."""
    if not (np.abs(s) < MAX_LENGTH).all():
        raise SurfaceFileError(f"a distance of {s[~(np.abs(s) < MAX_LENGTH)][0]:g} m")
    steps = np.diff(s)
    if not (steps > 0.0).all():
        raise SurfaceFileError(f"distance does not increase at row {np.argmin(steps > 0.0) + 2}")
    if s.size < 2:
        raise SurfaceFileError("at least 4 stations are wanted, got 1")
    ds = float(np.median(steps))
    if (np.abs(steps - ds) < EVEN_TOLERANCE * ds).all():
        return z, float((s[-1] - s[0]) / steps.size), ()
    size = float(s[-1] - s[0]) / ds + 1.0
    if size > 4.0 * s.size:
        raise SurfaceFileError("the stations are too uneven to be interpolated")
    grid = s[0] + ds * np.arange(int(size + 1e-9))
    return np.array([np.interp(grid, s, path) for path in z]), ds, (f"resampled to {ds:.4g} m",)


def _columns(names: list[str]) -> list[str]:
    """The columns to read among `names`: distance, left, right, or distance, height."""
    for wanted in (("distance", "left", "right"), ("distance", "height")):
        found = [[name for name in names if name.strip().lower() == want] for want in wanted]
        if all(len(same) == 1 for same in found):
            return [name for (name,) in found]
    raise SurfaceFileError(
        "wanted the columns distance, left, right, or distance, height, "
        f"got {', '.join(names) or 'none'}"
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
