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
from typing import Any, NamedTuple

from leaderboard.drive_report.analysis import DriveResult
from leaderboard.drive_report.export import OBSTACLE_COLUMNS, segment_line
from road_envs.core.atomic_io import atomic_write

_APPLICATION, _VERSION, _WGS_84 = 0x47504B47, 10300, 4326

_SYSTEMS = (
    ("Undefined cartesian", -1, "NONE", -1, "undefined"),
    ("Undefined geographic", 0, "NONE", 0, "undefined"),
    ("WGS 84", _WGS_84, "EPSG", _WGS_84, 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",'
     '6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'),
)  # fmt: skip

_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
  description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
  identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL,
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER);
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL,
  m TINYINT NOT NULL, PRIMARY KEY (table_name, column_name));
"""


class _Layer(NamedTuple):
    """A layer: its `name`, kind of geometry, the `columns` of its rows, and for each row the points
    of its geometry and the values.
    """

    name: str
    kind: str
    columns: Sequence[str]
    rows: list[tuple[list[list[float]], list[Any]]]


def write_geopackage(results: Iterable[DriveResult], path: Path) -> list[Path]:
    """Write the drives with positions as layers of one file; nothing without any."""
    layers = [layer for result in results if result.has_position for layer in _layers(result)]
    if not layers:
        return []
    with atomic_write(path) as partial, closing(sqlite3.connect(partial)) as base:
        base.execute(f"PRAGMA application_id = {_APPLICATION}")
        base.execute(f"PRAGMA user_version = {_VERSION}")
        base.executescript(_TABLES)
        base.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, '')", _SYSTEMS)
        for layer in layers:
            _write_layer(base, layer)
        base.commit()
    return [path]


def _layers(result: DriveResult) -> list[_Layer]:
    columns = [key for key in result.segments[0] if key not in ("lat", "lon")]
    segments = [
        (segment_line(result, row), [row[key] for key in columns]) for row in result.segments
    ]
    told = [key for key in OBSTACLE_COLUMNS if key not in ("lat", "lon")]
    obstacles = [
        ([[row["lon"], row["lat"]]], [row[key] for key in told]) for row in result.obstacles
    ]
    points = [point for line, _ in segments for point in line]
    facts = {key: x for key, x in result.facts.items() if isinstance(x, int | float)}
    return [
        _Layer(f"{result.name}_segments", "LINESTRING", columns, segments),
        _Layer(f"{result.name}_obstacles", "POINT", told, obstacles),
        _Layer(f"{result.name}_track", "LINESTRING", list(facts), [(points, list(facts.values()))]),
    ]


def _write_layer(base: sqlite3.Connection, layer: _Layer) -> None:
    table = _quoted(layer.name)
    example = layer.rows[0][1] if layer.rows else ["" for _ in layer.columns]
    kinds = ["TEXT" if isinstance(x, str) else "DOUBLE" for x in example]
    named = ", ".join(f"{_quoted(c)} {kind}" for c, kind in zip(layer.columns, kinds, strict=True))
    base.execute(
        f"CREATE TABLE {table} (fid INTEGER PRIMARY KEY AUTOINCREMENT, geom {layer.kind}, {named})"
    )
    marks = ", ".join("?" * (len(layer.columns) + 1))
    columns = ", ".join(["geom", *map(_quoted, layer.columns)])
    rows = [
        [_geometry(points, layer.kind), *values]  # a NaN is stored as NULL
        for points, values in layer.rows
    ]
    base.executemany(f"INSERT INTO {table} ({columns}) VALUES ({marks})", rows)
    points = [point for line, _ in layer.rows for point in line]
    x, y = ([p[k] for p in points] for k in (0, 1))
    box = (min(x), min(y), max(x), max(y)) if points else (None,) * 4
    now = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")
    base.execute(
        "INSERT INTO gpkg_contents VALUES (?, 'features', ?, '', ?, ?, ?, ?, ?, ?)",
        (layer.name, layer.name, now, *box, _WGS_84),
    )
    base.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)",
        (layer.name, layer.kind, _WGS_84),
    )


def _geometry(points: list[list[float]], kind: str) -> bytes:
    """Return a point or a line of `points` (longitude, latitude) as the blob of a GeoPackage."""
    header = b"GP" + struct.pack("<BBi", 0, 1, _WGS_84)  # version 1, little-endian, no envelope
    flat = [x for point in points for x in point]
    coordinates = struct.pack(f"<{len(flat)}d", *flat)
    if kind == "POINT":
        return header + struct.pack("<BI", 1, 1) + coordinates
    return header + struct.pack("<BII", 1, 2, len(points)) + coordinates


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
