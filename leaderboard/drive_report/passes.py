"""Several passes over one road: their alignment, and the agreement of what they tell."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from leaderboard.drive_report.analysis import DriveResult
from leaderboard.metrics.agreement import (
    bland_altman,
    intraclass_correlation,
    iri_filtered_correlation,
    repeatability,
)
from leaderboard.metrics.alignment import align
from road_envs.config import ConfigError
from road_envs.data.measured_record import MeasuredRecord
from road_envs.data.record import Estimate
from road_envs.roads import Surface

MIN_SEGMENTS = 3
"""Least number of common segments for limits of agreement and for an ICC."""


def align_passes(
    passes: Sequence[tuple[MeasuredRecord, Estimate]],
) -> list[tuple[MeasuredRecord, bool]]:
    """Return the records with the chainage of the first pass, and whether each matches it.

    A pass that matches nowhere keeps its chainage; a note says so.
    """
    reference, first = passes[0]
    road = Surface(first.z, first.ds, start=reference.chainage, name="first pass")
    aligned = [(reference, True)]
    for measured, estimate in passes[1:]:
        v = float(np.median(measured.record.v))
        try:
            found = align(road, estimate, v, measured.chainage)
        except ConfigError as error:
            note = f"not compared with the first drive: {error}"
            aligned.append((measured._replace(notes=(*measured.notes, note)), False))
            continue
        note = (
            f"moved by {found.lag:+.2f} m onto the first drive (correlation of slopes "
            f"{found.correlation:.2f})"
        )
        moved = measured._replace(
            chainage=measured.chainage + found.lag, notes=(*measured.notes, note)
        )
        aligned.append((moved, True))
    return aligned


def compare(results: Sequence[DriveResult]) -> dict[str, Any] | None:
    """Return the agreement of aligned passes by their common segments; None if there are none."""
    rows = [{_key(row): row for row in result.segments} for result in results]
    common = [key for key in rows[0] if all(key in each for each in rows)]
    if len(results) < 2 or not common:
        return None
    x = np.array([[each[key]["iri_mean"] for each in rows] for key in common])
    others = [
        {
            "name": result.name,
            "speed_kmh": result.facts["speed_kmh"],
            "bias": bland_altman(x[:, k], x[:, 0]).bias,
            "lower": bland_altman(x[:, k], x[:, 0]).lower,
            "upper": bland_altman(x[:, k], x[:, 0]).upper,
            "rmse": float(np.sqrt(np.mean((x[:, k] - x[:, 0]) ** 2))),
            "correlation": profile_correlation(results[0], result),
        }
        for k, result in enumerate(results)
        if k
    ]
    return {
        "first": results[0].name,
        "names": [result.name for result in results],
        "segments": [
            {
                "begin_m": key[0],
                "end_m": key[1],
                "iri": [float(value) for value in line],
                "mean": float(line.mean()),
                "std": float(line.std(ddof=1)),
            }
            for key, line in zip(common, x, strict=True)
        ],
        "repeatability": repeatability(x),
        "relative": repeatability(x) / float(x.mean()),
        "icc": intraclass_correlation(x) if len(common) >= MIN_SEGMENTS else np.nan,
        "passes": others,
    }


def profile_correlation(first: DriveResult, other: DriveResult) -> float:
    """Return the IRI-filtered cross-correlation, R 56-style, over the common road."""
    ds = first.estimate.ds
    begin = max(first.chainage, other.chainage)
    end = min(r.chainage + r.estimate.s[-1] for r in (first, other))
    s = np.arange(begin, end, ds)
    if s.size * ds < 20.0:
        return np.nan
    paths = [
        [np.interp(s, r.chainage + r.estimate.s, z) for z in r.estimate.z] for r in (first, other)
    ]
    pairs = zip(*paths, strict=True)
    return float(np.mean([iri_filtered_correlation(y, a, ds) for y, a in pairs]))


def _key(row: dict[str, Any]) -> tuple[float, float]:
    return round(row["begin_m"], 2), round(row["end_m"], 2)
