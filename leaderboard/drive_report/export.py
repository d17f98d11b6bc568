"""Files of a report for other programs: CSV, Parquet and GeoJSON."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.drive_report.analysis import DriveResult
from road_envs.core.artifacts import nan_to_none
from road_envs.core.atomic_io import atomic_write, write_text
from road_envs.core.extras import optional_import

VERTEX_SPACING = 2.0
"""Distance [m] of the vertices of a segment's line."""


def write_tables(result: DriveResult, folder: Path, stem: str) -> list[Path]:
    """Write segments, obstacles and heights; return the files."""
    with optional_import("a table as CSV or Parquet"):
        import pandas as pd

    columns = [
        "kind", "station_m", "station_std_m", "height_mm", "height_low_mm", "height_high_mm",
        "length_m", "wheel_path", "confidence", "lat", "lon",
    ]  # fmt: skip
    estimate = result.estimate
    std = np.full_like(estimate.z, np.nan) if estimate.z_std is None else estimate.z_std
    columns_z = {"station_m": result.chainage + estimate.s}
    if result.is_mean_path:
        columns_z |= {"mean_m": estimate.z[0], "mean_std_m": std[0]}
    else:
        columns_z |= {"left_m": estimate.z[0], "right_m": estimate.z[1]}
        columns_z |= {"left_std_m": std[0], "right_std_m": std[1]}
    heights = pd.DataFrame(columns_z)
    tables = {
        "segments": pd.DataFrame(result.segments),
        "obstacles": pd.DataFrame(result.obstacles, columns=columns),
        "heights": heights,
    }
    written = []
    for name, table in tables.items():
        for suffix in (".csv", ".parquet") if name != "heights" else (".parquet",):
            path = folder / f"{stem}_{name}{suffix}"
            with atomic_write(path) as partial:
                if suffix == ".csv":
                    table.to_csv(partial, index=False, float_format="%.10g")
                else:
                    table.to_parquet(partial, index=False)
            written.append(path)
    return written


def write_geojson(result: DriveResult, folder: Path, stem: str) -> list[Path]:
    """Write segments as lines and obstacles as points (RFC 7946); nothing without positions."""
    if not result.has_position:
        return []
    features = [
        _feature("LineString", _line(result, row), {**row, "feature": "segment"})
        for row in result.segments
    ]
    for row in result.obstacles:
        features.append(_feature("Point", [row["lon"], row["lat"]], {**row, "feature": "obstacle"}))
    path = folder / f"{stem}.geojson"
    collection = {"type": "FeatureCollection", "name": stem, "features": features}
    write_text(path, json.dumps(nan_to_none(collection), allow_nan=False))
    return [path]


def _line(result: DriveResult, row: dict[str, Any]) -> list[list[float]]:
    begin, end = row["begin_m"] - result.chainage, row["end_m"] - result.chainage
    stations = np.linspace(begin, end, max(2, round((end - begin) / VERTEX_SPACING) + 1))
    points = [result.position(float(x)) for x in stations]
    return [[round(float(lon or 0.0), 7), round(float(lat or 0.0), 7)] for lat, lon in points]


def _feature(kind: str, coordinates: list[Any], row: dict[str, Any]) -> dict[str, Any]:
    properties = {key: value for key, value in row.items() if key not in ("lat", "lon")}
    return {
        "type": "Feature",
        "geometry": {"type": kind, "coordinates": coordinates},
        "properties": properties,
    }
