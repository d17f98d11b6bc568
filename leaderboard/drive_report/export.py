"""Files of a report for other programs: CSV, Parquet, GeoJSON, HPMS, and the road itself."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.drive_report.analysis import DriveResult
from road_envs.core.artifacts import nan_to_none
from road_envs.core.atomic_io import atomic_write, write_text
from road_envs.core.config import ConfigError
from road_envs.core.extras import import_pandas
from road_envs.core.reading import parsing, read_parquet
from road_envs.roads import Surface

_VERTEX_SPACING = 2.0  # distance [m] of the vertices of a segment's line
OBSTACLE_COLUMNS = (
    "kind", "station_m", "station_std_m", "height_mm", "height_low_mm", "height_high_mm",
    "length_m", "wheel_path", "confidence", "lat", "lon",
)  # fmt: skip


def write_files(
    result: DriveResult, folder: Path, route: tuple[str, float] | None = None
) -> list[Path]:
    """Write tables, GeoJSON and, for a `route` with the mile at chainage 0, HPMS; return files."""
    written = [*_write_tables(result, folder), *_write_geojson(result, folder)]
    return written if route is None else [*written, _write_hpms(result, folder, *route)]


def _write_tables(result: DriveResult, folder: Path) -> list[Path]:
    """Write segments, obstacles and heights; return the files."""
    pd, estimate = import_pandas(), result.estimate
    std = np.full_like(estimate.z, np.nan) if estimate.z_std is None else estimate.z_std
    paths = ("mean",) if result.is_mean_path else ("left", "right")
    heights = {"station_m": result.chainage + estimate.s}
    heights |= {f"{path}_m": z for path, z in zip(paths, estimate.z, strict=False)}
    heights |= {f"{path}_std_m": x for path, x in zip(paths, std, strict=False)}
    tables = {
        "segments": pd.DataFrame(result.segments),
        "obstacles": pd.DataFrame(result.obstacles, columns=OBSTACLE_COLUMNS),
        "heights": pd.DataFrame(heights),
    }
    written = []
    for name, table in tables.items():
        for suffix in (".csv", ".parquet") if name != "heights" else (".parquet",):
            path = folder / f"{result.name}_{name}{suffix}"
            with atomic_write(path) as partial:
                if suffix == ".csv":
                    table.to_csv(partial, index=False, float_format="%.10g")
                else:
                    table.to_parquet(partial, index=False)
            written.append(path)
    return written


def _write_geojson(result: DriveResult, folder: Path) -> list[Path]:
    """Write segments as lines and obstacles as points (RFC 7946); nothing without positions."""
    if result.measured.position is None:
        return []
    features = [
        {"type": "Feature", "geometry": {"type": kind, "coordinates": place}, "properties": values}
        for kind, place, values in placed_rows(result)
    ]
    path = folder / f"{result.name}.geojson"
    collection = {"type": "FeatureCollection", "name": result.name, "features": features}
    write_text(path, json.dumps(nan_to_none(collection), allow_nan=False))
    return [path]


def _write_hpms(result: DriveResult, folder: Path, route: str, mile: float) -> Path:
    """Write the segments with the columns of sections of the Highway Performance Monitoring System.

    Names and units are those of the HPMS Field Manual (FHWA 2016, chapter 3): points along the
    `route` in miles, IRI in inches per mile.
    """
    lines = ["Route_ID,Begin_Point,End_Point,Section_Length,Data_Item,Value_Numeric,Value_Text"]
    for row in result.segments:
        begin, end = (mile + row[key] / 1609.344 for key in ("begin_m", "end_m"))
        place, flags = f"{begin:.4f},{end:.4f},{end - begin:.4f}", row["flags"].replace('"', "'")
        lines.append(f'{route},{place},IRI,{row["iri_in_per_mi"]:.0f},"{flags}"')
    path = folder / f"{result.name}_hpms.csv"
    write_text(path, "\n".join(lines) + "\n")
    return path


def parse_route(route: str) -> tuple[str, float]:
    """Return name and mile at chainage 0 of "ROUTE" or "ROUTE,BEGIN". Raises ConfigError."""
    name, comma, begin = route.partition(",")
    try:
        mile = float(begin) if comma else 0.0
    except ValueError:
        mile = np.nan
    if not name.strip() or not np.isfinite(mile) or '"' in name or "\n" in name:
        needed = "a route, or a route and the mile where the drive begins, as in I-80,12.5"
        raise ConfigError(f"--route must be {needed}, got {route!r}")
    return name.strip(), mile


def read_heights(path: Path) -> Surface:
    """Return the road in the table NAME_heights.parquet of a report.

    Both wheel paths are the mean path where the sensors told no left and right. Raises ConfigError.
    """
    with parsing(path, ConfigError, "no table of heights"):
        table = read_parquet(path)
        columns = {name: np.array(table[name]) for name in table.column_names}
        mean = columns.get("mean_m")
        if "station_m" not in columns or (mean is None and "left_m" not in columns):
            raise ConfigError(
                "not the NAME_heights.parquet of a report, which has station_m and left_m, right_m "
                f"or mean_m; it has {', '.join(columns)}"
            )
        s = columns["station_m"]
        z = np.array([mean, mean] if mean is not None else [columns["left_m"], columns["right_m"]])
        notes = ("both wheel paths are the mean path of a drive",) if mean is not None else ()
        return Surface(z, float(s[1] - s[0]), float(s[0]), name=path.stem, notes=notes)


def placed_rows(result: DriveResult) -> Iterator[tuple[str, list[Any], dict[str, Any]]]:
    """Yield the rows of a drive with positions: kind of geometry, coordinates (longitude, latitude)
    of a point or of a line with vertices every _VERTEX_SPACING, and the other values.
    """
    for row in result.segments:
        ends = row["begin_m"] - result.chainage, row["end_m"] - result.chainage
        count = max(2, round((ends[1] - ends[0]) / _VERTEX_SPACING) + 1)
        points = [result.position(float(x)) for x in np.linspace(*ends, count)]
        line = [[round(float(lon or 0.0), 7), round(float(lat or 0.0), 7)] for lat, lon in points]
        yield "LineString", line, _without_place(row) | {"feature": "segment"}
    for row in result.obstacles:
        yield "Point", [row["lon"], row["lat"]], _without_place(row) | {"feature": "obstacle"}


def _without_place(row: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in row.items() if key not in ("lat", "lon")}
