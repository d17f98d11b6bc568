"""Data for the scripts of the pages, as plain JSON: scores by group, and the charts of a task.

Heights are integers of 0.1 mm, encoded as differences; densities are logarithms. A task of seven
conditions and eight entries takes about a megabyte.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leaderboard.evaluation.boards import BoardDefinition
from leaderboard.evaluation.results import Result, Trace
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics.bootstrap import MIN_ROADS, Strata, count_roads, performance_profile
from leaderboard.metrics.bound import third_octave_bound
from leaderboard.metrics.heights import band_pass, scored_band
from leaderboard.metrics.obstacles import Obstacle, match_obstacles, true_obstacles
from leaderboard.metrics.registry import SCORES
from leaderboard.metrics.roughness import THIRD_OCTAVES
from leaderboard.report.board_definitions import COLUMNS, TEXT_COLUMNS, Column
from leaderboard.report.tables import (
    ALL_RUNS,
    BOUND_ROW,
    SPECTRUM_SCORES,
    BoardView,
    Row,
    Section,
)
from road_envs.analysis.roughness import CLASSES, N_0, displacement_psd, smooth_psd

HEIGHT_UNIT = 1e-4
"""Unit [m] of encoded heights."""

RAW_SPACING, IN_BAND_SPACING = 0.05, 0.1
"""Least spacing [m] at which raw and band-passed heights are drawn."""

DRAWN_HEIGHT_LIMIT = 3.0
"""Drawn heights are clipped to +- this [m]."""

CLASS_FREQUENCIES = (0.05, 10.0)
THRESHOLDS = 41
REPLICATES = 300
"""Bootstrap replicates of a performance profile: enough for a drawn line."""


def table_data(view: BoardView, section: Section, columns: Sequence[Column]) -> dict[str, Any]:
    """Return the rows of a task, with their numbers over all runs and over each group."""
    keys = [
        *(column.key for column in columns),
        view.definition.ranks_by,
        "rank_causal",
        "low",
        "high",
    ]
    numeric = dict.fromkeys(key for key in keys if key not in TEXT_COLUMNS)
    return {
        "ranks_by": view.definition.ranks_by,
        "scale": view.definition.scale,
        "flat": 1.0 if view.definition.ranks_by == "nrmse" else None,
        "groups": {kind: list(names) for kind, names in section.groups.items()},
        "columns": {key: _column_format(key) for key in dict.fromkeys(keys)},
        "rows": [_row_data(row, list(numeric)) for row in section.rows],
    }


def _row_data(row: Row, keys: Sequence[str]) -> dict[str, Any]:
    groups = {ALL_RUNS: row.values, **row.groups}
    return {
        "name": row.name,
        "state": row.state,
        "causal": bool(row.causal),
        "message": row.message,
        # rows with few scores have empty cells instead of dashes
        "sparse": row.state == "claim" or row.name == BOUND_ROW,
        "cells": {key: row.cells[key] for key in TEXT_COLUMNS if row.cells.get(key)},
        "groups": {
            name: {key: rounded(x) for key in keys if (x := values.get(key)) is not None}
            for name, values in groups.items()
        },
    }


def _column_format(key: str) -> dict[str, Any]:
    """Return how a script formats a column, equal to `Metric.format_value`."""
    if key in TEXT_COLUMNS or key not in COLUMNS:
        return {"better": "low", "format": None}
    column = COLUMNS[key]
    form = {"factor": column.factor, "digits": column.digits, "blank": column.blank}
    return {"better": column.better, "format": {**form, "sign": column.better == "zero"}}


def chart_data(
    task: Task, definition: BoardDefinition, results: Mapping[str, Result], rows: Mapping[str, Row]
) -> dict[str, Any]:
    """Return everything drawn of a task, for the given results by name in their order."""
    scores = {
        name: _profile_scores(result, definition.ranks_by) for name, result in results.items()
    }
    thresholds = np.linspace(0.0, definition.scale, THRESHOLDS)
    return {
        "entries": list(results),
        "ranks_by": SCORES[definition.ranks_by].label,
        "scale": definition.scale,
        "conditions": {
            condition.label: _condition_data(
                task, k, {name: r.traces[k] for name, r in results.items() if len(r.traces) > k}
            )
            for k, condition in enumerate(task.conditions)
        },
        "thirds": [rounded(n) for n in THIRD_OCTAVES],
        "spectrum": {name: _spectrum_data(rows[name]) for name in results},
        "thresholds": [rounded(x) for x in thresholds],
        "performance": {
            name: _profile_data(values, thresholds, task.test.strata)
            for name, values in scores.items()
            if count_roads(values) >= MIN_ROADS
        },
        "class_n": CLASS_FREQUENCIES,
        "classes": [
            {"letter": letter, "low": _class_line(0.5 * mean), "high": _class_line(2.0 * mean)}
            for letter, mean in CLASSES.items()
        ],
    }


def _condition_data(task: Task, place: int, traces: Mapping[str, Trace]) -> dict[str, Any]:
    """Return the truth and every estimate of one condition."""
    condition = task.conditions[place]
    band = scored_band(condition.speed_kmh / 3.6)
    if not traces:
        return {"caption": "", "band": band, "bound": None, "entries": {}, "bumps": [[], []]}
    first = next(iter(traces.values()))
    n, density = _log_density(first.z_true, first.ds)
    # the band-pass cuts both ends of a profile
    trim = (first.s.size - band_pass(first.z_true, first.ds, band).shape[1]) // 2
    steps = {"raw": _stride(RAW_SPACING, first.ds), "inside": _stride(IN_BAND_SPACING, first.ds)}
    first_station = {"raw": 0.0, "inside": trim * first.ds}
    truth = {
        "raw": _raw_heights(first.z_true, first.ds),
        "inside": _in_band_heights(first.z_true, first.ds, band),
    }
    return {
        "caption": f"{first.road}, seed {first.road_seed}: the first test road, "
        f"first {first.s[-1] + first.ds:.0f} m; of a trained entry, the training with the median "
        "error",
        "band": band,
        "bound": [rounded(x) for x in third_octave_bound(task, condition)],
        **{
            kind: {"ds": steps[kind] * first.ds, "first": first_station[kind], "truth": truth[kind]}
            for kind in truth
        },
        "bumps": [_obstacle_marks(path) for path in true_obstacles(first.z_true, first.ds)],
        "density_n": [rounded(x) for x in n],
        "density": density,
        "entries": {name: _entry_data(trace, band) for name, trace in traces.items()},
    }


def _entry_data(trace: Trace, band: tuple[float, float]) -> dict[str, Any]:
    matches = match_obstacles(trace.z_true, trace.z_estimated, trace.ds)
    std = trace.z_std
    return {
        "raw": _raw_heights(trace.z_estimated, trace.ds),
        "inside": _in_band_heights(trace.z_estimated, trace.ds, band),
        "std": None if std is None else _encoded_std(std, trace, band),
        "density": _log_density(trace.z_estimated, trace.ds)[1],
        "bumps": None
        if matches is None
        else [
            {
                "found": _obstacle_marks([f for _, f in path.pairs]),
                "missed": _obstacle_marks(path.missed),
                "false": _obstacle_marks(path.false),
            }
            for path in matches
        ],
    }


def _raw_heights(z: np.ndarray, ds: float) -> list[list[int]]:
    """Return heights about their median, since accelerometers do not observe the datum."""
    about = z - np.median(z, axis=1, keepdims=True)
    return [_encoded(path[:: _stride(RAW_SPACING, ds)]) for path in about]


def _in_band_heights(z: np.ndarray, ds: float, band: tuple[float, float]) -> list[list[int]]:
    return [_encoded(path[:: _stride(IN_BAND_SPACING, ds)]) for path in band_pass(z, ds, band)]


def _encoded_std(std: np.ndarray, trace: Trace, band: tuple[float, float]) -> list[list[int]]:
    size = band_pass(trace.z_true, trace.ds, band).shape[1]
    trim = (trace.s.size - size) // 2
    inside = std[:, trim : trim + size : _stride(IN_BAND_SPACING, trace.ds)]
    return np.rint(np.minimum(inside, DRAWN_HEIGHT_LIMIT) / HEIGHT_UNIT).astype(int).tolist()


def _encoded(z: np.ndarray) -> list[int]:
    """Return the differences of heights [m], in units of HEIGHT_UNIT."""
    whole = np.rint(np.clip(z, -DRAWN_HEIGHT_LIMIT, DRAWN_HEIGHT_LIMIT) / HEIGHT_UNIT).astype(int)
    return np.diff(whole, prepend=0).tolist()


def _stride(spacing: float, ds: float) -> int:
    return max(1, round(spacing / ds))


def _obstacle_marks(bumps: Sequence[Obstacle]) -> list[tuple[float, int]]:
    return [(round(bump.s, 2), round(bump.height / HEIGHT_UNIT)) for bump in bumps]


def _log_density(z: np.ndarray, ds: float) -> tuple[np.ndarray, list[float | None]]:
    """Return frequencies and log10 of the density of both paths, None where it is 0."""
    n, G = smooth_psd(*displacement_psd(z, ds))
    return n, [round(math.log10(x), 2) if x > 0.0 else None for x in G.mean(axis=0)]


def _class_line(level: float) -> list[float]:
    # ISO 8608 classes have waviness 2
    return [level * (n / N_0) ** -2.0 for n in CLASS_FREQUENCIES]


def _spectrum_data(row: Row) -> dict[str, list[float | None]]:
    """Return the third-octave errors of all runs and of each group."""
    groups = {ALL_RUNS: row.values, **row.groups}
    return {
        group: [None if (x := values.get(name)) is None else rounded(x) for name in SPECTRUM_SCORES]
        for group, values in groups.items()
    }


def _profile_scores(result: Result, name: str) -> np.ndarray:
    """Return a score (R, C, S) of which a run without a value counts as infinite."""
    values = result.values(name)
    values[result.driven() & np.isnan(values)] = np.inf
    return values


def _profile_data(
    scores: np.ndarray, thresholds: np.ndarray, strata: Strata
) -> dict[str, list[float]]:
    profile = performance_profile(scores, thresholds, replicates=REPLICATES, strata=strata)
    return {name: np.round(100.0 * x, 1).tolist() for name, x in profile._asdict().items()}


def rounded(x: float) -> float:
    """Return `x` with eight digits: the page rounds it once more, to what is printed."""
    return float(f"{x:.8g}")
