"""What the pages' scripts draw, as plain JSON: tables by group, and the traces of a task.

Heights are whole numbers of 0.1 mm, coded as differences; densities are logarithms. So a task of
seven conditions and eight entries takes about a megabyte.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leaderboard.evaluation.results import Result, Trace
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics.bootstrap import performance_profile
from leaderboard.metrics.bound import third_octave_bound
from leaderboard.metrics.heights import band_pass, scored_band
from leaderboard.metrics.obstacles import Obstacle, match_obstacles, true_obstacles
from leaderboard.metrics.registry import SCORES, UNDEFINED
from leaderboard.metrics.roughness import THIRD_OCTAVES
from leaderboard.report.board_definitions import COLUMN_FORMATS, BoardDefinition, Column
from leaderboard.report.tables import (
    ALL_RUNS,
    ALL_SCORES,
    BOUND_ROW,
    SPECTRUM_SCORES,
    BoardView,
    Row,
    Section,
    score_arrays,
)
from road_envs.analysis.roughness import CLASSES, N_0, displacement_psd, smooth_psd

HEIGHT_UNIT = 1e-4
"""Heights are told in this [m]."""

RAW_SPACING, IN_BAND_SPACING = 0.05, 0.1
"""Spacing [m] at which raw and band-passed heights are drawn, at least."""

DRAWN_HEIGHT_LIMIT = 3.0
"""Heights [m] beyond this are drawn there."""

TEXT_COLUMNS = ("interval", "states", "slope_interval")
"""Columns that are not one number."""

CLASS_FREQUENCIES = (0.05, 10.0)
THRESHOLDS = 41
REPLICATES = 300
"""Of the bootstrap behind a performance profile: enough for a line."""


def table_data(view: BoardView, section: Section, columns: Sequence[Column]) -> dict[str, Any]:
    """The rows of a task with their numbers over all runs and over each group."""
    keys = [
        *(column.key for column in columns),
        view.definition.ranks_by,
        "rank_causal",
        "low",
        "high",
    ]
    wanted = dict.fromkeys(key for key in keys if key not in TEXT_COLUMNS)
    return {
        "ranks_by": view.definition.ranks_by,
        "scale": view.definition.scale,
        "flat": 1.0 if view.definition.ranks_by == "nrmse" else None,
        "groups": {kind: list(names) for kind, names in section.groups.items()},
        "columns": {key: _column_format(key) for key in dict.fromkeys(keys)},
        "rows": [_row_data(row, list(wanted)) for row in section.rows],
    }


def _row_data(row: Row, keys: Sequence[str]) -> dict[str, Any]:
    groups = {ALL_RUNS: row.values, **row.groups}
    return {
        "name": row.name,
        "state": row.state,
        "causal": bool(row.causal),
        "message": row.message,
        "sparse": row.state == "claim" or row.name == BOUND_ROW,
        "cells": {key: row.cells[key] for key in TEXT_COLUMNS if row.cells.get(key)},
        "groups": {
            name: {key: rounded(x) for key in keys if (x := found.get(key)) is not None}
            for name, found in groups.items()
        },
    }


def _column_format(key: str) -> dict[str, Any]:
    """How a script prints a column: as `Score.format_value` does."""
    if key in COLUMN_FORMATS:
        score = COLUMN_FORMATS[key]
        told = {"factor": score.factor, "digits": score.digits, "blank": UNDEFINED}
        return {"better": score.better, "format": {**told, "sign": score.better == "zero"}}
    plain = {"rank": 0, "rank_causal": 0, "parameters": 0}
    plain |= {"train_seconds": 1, "estimate_ms_per_100m": 1}
    if key in plain:
        form = {"factor": 1, "digits": plain[key], "sign": False, "blank": ""}
        return {"better": "low", "format": form}
    return {"better": "low", "format": None}


def chart_data(
    task: Task, definition: BoardDefinition, results: Mapping[str, Result], rows: Mapping[str, Row]
) -> dict[str, Any]:
    """All that is drawn of a task, of the results by name in their order."""
    told = {name: score_arrays(result) for name, result in results.items()}
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
            name: _profile_data(scores[definition.ranks_by][ALL_SCORES], thresholds)
            for name, scores in told.items()
            if len(scores[definition.ranks_by]) > 1
        },
        "class_n": CLASS_FREQUENCIES,
        "classes": [
            {"letter": letter, "low": _class_line(0.5 * mean), "high": _class_line(2.0 * mean)}
            for letter, mean in CLASSES.items()
        ],
    }


def _condition_data(task: Task, place: int, traces: Mapping[str, Trace]) -> dict[str, Any]:
    """One condition: the truth, and what each entry made of it."""
    condition = task.conditions[place]
    band = scored_band(condition.speed_kmh / 3.6)
    if not traces:
        return {"caption": "", "band": band, "bound": None, "entries": {}, "bumps": [[], []]}
    first = next(iter(traces.values()))
    n, density = _log_density(first.z_true, first.ds)
    trim = (first.s.size - band_pass(first.z_true, first.ds, band).shape[1]) // 2
    steps = {"raw": _stride(RAW_SPACING, first.ds), "inside": _stride(IN_BAND_SPACING, first.ds)}
    place_of = {"raw": 0.0, "inside": trim * first.ds}
    truth = {
        "raw": _raw_heights(first.z_true, first.ds),
        "inside": _in_band_heights(first.z_true, first.ds, band),
    }
    return {
        "caption": f"{first.road}, seed {first.road_seed}: the first test road, "
        f"{first.s[-1] + first.ds:.0f} m of it; of each learner the training that is in the middle "
        "by error",
        "band": band,
        "bound": [rounded(x) for x in third_octave_bound(task, condition)],
        **{
            kind: {"ds": steps[kind] * first.ds, "first": place_of[kind], "truth": truth[kind]}
            for kind in truth
        },
        "bumps": [_obstacle_marks(path) for path in true_obstacles(first.z_true, first.ds)],
        "density_n": [rounded(x) for x in n],
        "density": density,
        "entries": {name: _entry_data(trace, band) for name, trace in traces.items()},
    }


def _entry_data(trace: Trace, band: tuple[float, float]) -> dict[str, Any]:
    found = match_obstacles(trace.z_true, trace.z_estimated, trace.ds)
    std = trace.z_std
    return {
        "raw": _raw_heights(trace.z_estimated, trace.ds),
        "inside": _in_band_heights(trace.z_estimated, trace.ds, band),
        "std": None if std is None else _encoded_std(std, trace, band),
        "density": _log_density(trace.z_estimated, trace.ds)[1],
        "bumps": None
        if found is None
        else [
            {
                "found": _obstacle_marks([f for _, f in path.pairs]),
                "missed": _obstacle_marks(path.missed),
                "false": _obstacle_marks(path.false),
            }
            for path in found
        ],
    }


def _raw_heights(z: np.ndarray, ds: float) -> list[list[int]]:
    """Heights about their median, for no accelerometer sees the datum."""
    about = z - np.median(z, axis=1, keepdims=True)
    return [_encoded(path[:: _stride(RAW_SPACING, ds)]) for path in about]


def _in_band_heights(z: np.ndarray, ds: float, band: tuple[float, float]) -> list[list[int]]:
    return [_encoded(path[:: _stride(IN_BAND_SPACING, ds)]) for path in band_pass(z, ds, band)]


def _encoded_std(std: np.ndarray, trace: Trace, band: tuple[float, float]) -> list[list[int]]:
    size = band_pass(trace.z_true, trace.ds, band).shape[1]
    trim = (trace.s.size - size) // 2
    kept = std[:, trim : trim + size : _stride(IN_BAND_SPACING, trace.ds)]
    return np.rint(np.minimum(kept, DRAWN_HEIGHT_LIMIT) / HEIGHT_UNIT).astype(int).tolist()


def _encoded(z: np.ndarray) -> list[int]:
    """Differences of heights [m] in units."""
    whole = np.rint(np.clip(z, -DRAWN_HEIGHT_LIMIT, DRAWN_HEIGHT_LIMIT) / HEIGHT_UNIT).astype(int)
    return np.diff(whole, prepend=0).tolist()


def _stride(spacing: float, ds: float) -> int:
    return max(1, round(spacing / ds))


def _obstacle_marks(bumps: Sequence[Obstacle]) -> list[tuple[float, int]]:
    return [(round(bump.s, 2), round(bump.height / HEIGHT_UNIT)) for bump in bumps]


def _log_density(z: np.ndarray, ds: float) -> tuple[np.ndarray, list[float | None]]:
    """Where, and the logarithm of, the density of both wheel paths; None where there is none."""
    n, G = smooth_psd(*displacement_psd(z, ds))
    return n, [round(math.log10(x), 2) if x > 0.0 else None for x in G.mean(axis=0)]


def _class_line(level: float) -> list[float]:
    return [level * (n / N_0) ** -2.0 for n in CLASS_FREQUENCIES]


def _spectrum_data(row: Row) -> dict[str, list[float | None]]:
    """Error over spatial frequency, of all runs and of each group."""
    groups = {ALL_RUNS: row.values, **row.groups}
    return {
        group: [None if (x := found.get(name)) is None else rounded(x) for name in SPECTRUM_SCORES]
        for group, found in groups.items()
    }


def _profile_data(scores: np.ndarray, thresholds: np.ndarray) -> dict[str, list[float]]:
    found = performance_profile(scores, thresholds, replicates=REPLICATES)
    return {name: np.round(100.0 * x, 1).tolist() for name, x in found._asdict().items()}


def rounded(x: float) -> float:
    """Four digits, which is more than is printed."""
    return float(f"{x:.4g}")
