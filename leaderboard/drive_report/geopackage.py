"""GeoPackage of a report: segments, obstacles and the track as layers in one file.

After the OGC GeoPackage Encoding Standard 1.3 (OGC 12-128r17): a file of SQLite with the tables
`gpkg_spatial_ref_sys`, `gpkg_contents` and `gpkg_geometry_columns`; a geometry is a header (GP,
version, flags, reference system) before well-known binary. Coordinates are longitude and latitude
in WGS 84.
"""

import sqlite3
import struct
from collections.abc import Iterable, Sequence
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from leaderboard.drive_report.analysis import DriveResult
from leaderboard.drive_report.export import OBSTACLE_COLUMNS, placed_rows
from road_envs.core.atomic_io import atomic_write

_WGS_84 = 4326  # its number among the reference systems
_TABLES = Path(__file__).with_suffix(".sql")


_Rows = list[tuple[list[list[float]], dict[str, Any]]]  # points of the geometry, and values


def write_geopackage(results: Iterable[DriveResult], path: Path) -> list[Path]:
    """Write the drives with positions as layers of one file; nothing without any."""
    placed = [result for result in results if result.measured.position is not None]
    layers = [layer for result in placed for layer in _layers(result)]
    if not layers:
        return []
    with atomic_write(path) as partial, closing(sqlite3.connect(partial)) as base:
        base.executescript(_TABLES.read_text(encoding="utf-8"))
        for layer in layers:
            _write_layer(base, *layer)
        base.commit()
    return [path]


def _layers(result: DriveResult) -> list[tuple[str, str, Sequence[str], _Rows]]:
    """Return name, kind of geometry, columns and rows of each layer of a drive."""
    rows = list(placed_rows(result))
    segments = [(line, values) for kind, line, values in rows if kind == "LineString"]
    obstacles = [([point], values) for kind, point, values in rows if kind == "Point"]
    points = [point for line, _ in segments for point in line]
    facts = {key: x for key, x in result.facts.items() if isinstance(x, int | float)}
    return [
        (f"{result.name}_segments", "LINESTRING", list(segments[0][1])[:-1], segments),
        (f"{result.name}_obstacles", "POINT", OBSTACLE_COLUMNS[:-2], obstacles),
        (f"{result.name}_track", "LINESTRING", list(facts), [(points, facts)]),
    ]


def _write_layer(
    base: sqlite3.Connection, name: str, kind: str, columns: Sequence[str], rows: _Rows
) -> None:
    table, example = _quoted(name), rows[0][1] if rows else dict.fromkeys(columns, "")
    types = {each: "TEXT" if isinstance(example[each], str) else "DOUBLE" for each in columns}
    typed = ", ".join(f"{_quoted(each)} {text}" for each, text in types.items())
    base.execute(
        f"CREATE TABLE {table} (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom {kind}, {typed})"
    )
    marks = ", ".join("?" * (len(columns) + 1))
    named = ", ".join(["geom", *map(_quoted, columns)])
    # a NaN is stored as NULL
    stored = [[_geometry(line, kind), *(values[each] for each in columns)] for line, values in rows]
    base.executemany(f"INSERT INTO {table} ({named}) VALUES ({marks})", stored)
    points = [point for line, _ in rows for point in line]
    x, y = ([p[k] for p in points] for k in (0, 1))
    box = (min(x), min(y), max(x), max(y)) if points else (None,) * 4
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")
    base.execute(
        "INSERT INTO gpkg_contents VALUES (?, 'features', ?, '', ?, ?, ?, ?, ?, ?)",
        (name, name, now, *box, _WGS_84),
    )
    columns_of_geometry = "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)"
    base.execute(columns_of_geometry, (name, kind, _WGS_84))


def _geometry(points: list[list[float]], kind: str) -> bytes:
    """Return a point or a line of `points` (longitude, latitude) as the blob of a GeoPackage."""
    header = b"GP" + struct.pack("<BBi", 0, 1, _WGS_84)  # version 1, little-endian, no envelope
    flat = [x for point in points for x in point]
    known = struct.pack("<BI", 1, 1) if kind == "POINT" else struct.pack("<BII", 1, 2, len(points))
    return header + known + struct.pack(f"<{len(flat)}d", *flat)


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
