"""The page of a report: one HTML file without references to others, which prints on A4."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leaderboard.drive_report import pictures
from leaderboard.drive_report.analysis import DriveResult
from leaderboard.drive_report.conditions import Conditions
from leaderboard.drive_report.notes import ONE_ROAD
from leaderboard.drive_report.obstacles import FALSE_ALARMS
from leaderboard.report.rendering import render
from road_envs import __version__
from road_envs.core.atomic_io import write_text
from road_envs.records.record import scored_band

_TABLE_ROWS = 200  # largest number of segments that the page lists; the files have all


def write_page(
    results: Sequence[DriveResult],
    conditions: Conditions,
    settings: dict[str, Any],
    agreement: dict[str, Any] | None,
    path: Path,
) -> None:
    """Write the page of one or more drives; `agreement` is that of several passes."""
    drives = [_drive(result, conditions, f"drive-{k}") for k, result in enumerate(results)]
    text = render(
        "drive/page.html", drives=drives, conditions=conditions,
        colours=pictures.condition_colours(conditions), settings=settings, agreement=agreement,
        false_alarms=FALSE_ALARMS, version=__version__,
    )  # fmt: skip
    write_text(path, text)


def _drive(result: DriveResult, conditions: Conditions, anchor: str) -> dict[str, Any]:
    paths = ("hri", "iri_mean") if result.is_mean_path else ("iri_left", "iri_right", "iri_mean")
    lengths = dict.fromkeys(conditions.categories, 0.0)
    for row in result.segments:
        lengths[row["condition"]] += row["end_m"] - row["begin_m"]
    total = sum(lengths.values())
    return vars(result) | {
        "anchor": anchor,
        "paths": paths,
        "sensors": _sensors(result),
        "doubts": [note for note in result.notes if not note.startswith(ONE_ROAD)],
        "segments": result.segments[:_TABLE_ROWS],
        "hidden": max(0, len(result.segments) - _TABLE_ROWS),
        "possible": sum(row["kind"].startswith("possible") for row in result.obstacles),
        "shares": {name: length / total for name, length in lengths.items()},
        "band": scored_band(result.v),
        "has_interval": math.isfinite(result.facts["iri_mean_high"]),
        "level": {name: k for k, name in enumerate(conditions.categories)},
        **pictures.draw(result, conditions, anchor),
    }


def _sensors(result: DriveResult) -> str:
    layout, at = result.measured.record.sensors, result.measured.place
    count = len(result.measured.record.channels)
    if at and count == 1:
        return f"one device ({at})"
    mounted = sorted({sensor.mounted for sensor in layout.values()}) if layout else ["body"]
    return f"{count} accelerometer{'s' if count > 1 else ''} on the {' and '.join(mounted)}"
