"""Writers of surface files: text tables, Parquet, OpenCRG and ERD. All writes are atomic.

In an OpenCRG file each wheel path is laterally level over half a track width, so that a tyre of
any width is on it: four long sections are at v = -3, -1, 1 and 3 quarters of the track.
"""

import json
import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np

from road_envs.core.atomic_io import atomic_write, write_text
from road_envs.core.config import ConfigError
from road_envs.core.extras import import_pyarrow
from road_envs.records.roughness import TRACK
from road_envs.roads.formats.opencrg import RECORD, WIDTHS
from road_envs.roads.surface import Surface


def write(surface: Surface, path: str | Path) -> None:
    """Write a surface in the format given by the suffix of `path`. Raises ConfigError."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise ConfigError(f"{path}: the file name must end in {' or '.join(WRITERS)}")
    WRITERS[suffix](surface, path)


def write_csv(surface: Surface, path: str | Path) -> None:
    """Write distance, left and right height [m] as CSV with a resolution of 1 nm."""
    table = zip(surface.s, *surface.z, strict=True)
    rows = [f"{s:.9f},{left:.9f},{right:.9f}" for s, left, right in table]
    remarks = [f"# {line}" for line in _remarks(surface)]
    write_text(path, "\n".join([*remarks, "distance,left,right", *rows, ""]))


def _write_parquet(surface: Surface, path: str | Path) -> None:
    """Write distance, left and right height [m] as Parquet; name and notes go into the metadata."""
    pa, pq = import_pyarrow()
    columns = dict(zip(("distance", "left", "right"), (surface.s, *surface.z), strict=True))
    about = json.dumps({"name": surface.name, "notes": surface.notes})
    table = pa.table(columns).replace_schema_metadata({"roadrecon surface": about})
    with atomic_write(path) as partial:
        pq.write_table(table, partial, write_page_checksum=True)


def write_crg(surface: Surface, path: str | Path, data_format: str = "KDBI") -> None:
    """Write an OpenCRG file; KDBI is exact, KRBI has 7 digits. Raises ConfigError."""
    if data_format not in WIDTHS:
        raise ConfigError(f"unknown data format {data_format!r}; known: {', '.join(WIDTHS)}")
    left, right = surface.z
    grid = np.array([right, right, left, left]).T
    header = "\n".join([*_crg_header(surface, data_format), "$" * 72, ""])
    payload = (_binary if data_format.startswith("K") else _text)(grid, data_format)
    with atomic_write(path) as partial:
        partial.write_bytes(header.encode("ascii", "replace") + payload)


def _write_erd(surface: Surface, path: str | Path) -> None:
    """Write left and right elevation [mm] as an ERD text file with a resolution of 1 nm."""
    name, *notes = (x.encode("ascii", "replace").decode("ascii") for x in _remarks(surface))
    lines = [
        "ERDFILEV2.00",
        f"2, {surface.z.shape[1]}, -1, 1, 5, {surface.ds!r}, -1,",
        f"TITLE   {name[:80]}",
        "SHORTNAMLElev.  RElev.",
        "UNITSNAMmm      mm",
        f"LONGNAME{'Left elevation':32}Right elevation",
        "XLABEL  Distance",
        "XUNITS  m",
        *(f"HISTORY {note[:80]}" for note in notes),
        "END",
        *(f"{left:.6f} {right:.6f}" for left, right in 1e3 * surface.z.T),
        "",
    ]
    write_text(path, "\n".join(lines))


WRITERS: dict[str, Callable[[Surface, str | Path], None]] = {
    ".csv": write_csv,
    ".parquet": _write_parquet,
    ".crg": write_crg,
    ".erd": _write_erd,
}


def _remarks(surface: Surface) -> list[str]:
    return [" ".join(line.split()) for line in (surface.name, *surface.notes)]


def _crg_header(surface: Surface, data_format: str) -> list[str]:
    quarter = 0.25 * TRACK
    remarks = [part for line in _remarks(surface) for part in textwrap.wrap(line, 70)]
    return [
        "$CT",
        *(f"  {part}" for part in remarks),
        "$",
        "$ROAD_CRG",
        f"REFERENCE_LINE_START_U   = {surface.start!r}",
        f"REFERENCE_LINE_END_U     = {surface.end!r}",
        f"REFERENCE_LINE_INCREMENT = {surface.ds!r}",
        f"LONG_SECTION_V_RIGHT     = {-3.0 * quarter!r}",
        f"LONG_SECTION_V_LEFT      = {3.0 * quarter!r}",
        f"LONG_SECTION_V_INCREMENT = {2.0 * quarter!r}",
        "$",
        "$KD_DEFINITION",
        f"#:{data_format}",
        f"U:reference line u,m,{surface.start:.6f},{surface.ds:.6f}",
        *(f"D:long section {k},m" for k in (1, 2, 3, 4)),
        "$",
    ]


def _binary(grid: np.ndarray, data_format: str) -> bytes:
    """Return the grid as big-endian floats, padded with NaN to whole records."""
    values = grid.astype(f">f{WIDTHS[data_format]}")
    missing = -values.nbytes % RECORD // WIDTHS[data_format]
    return values.tobytes() + np.full(missing, np.nan, values.dtype).tobytes()


def _text(grid: np.ndarray, data_format: str) -> bytes:
    """Return one record per row, with as many decimals as the width of a number allows."""
    width = WIDTHS[data_format]
    decimals = min(15, width - 3 - len(f"{np.abs(grid).max():.0f}"))
    record = "".join([f"{{:{width}.{decimals}f}}"] * grid.shape[1])
    return "".join(record.format(*row) + "\n" for row in grid.tolist()).encode("ascii")
