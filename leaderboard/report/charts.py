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
from leaderboard.metrics.bootstrap import performance
from leaderboard.metrics.bound import bound_over_n
from leaderboard.metrics.heights import band_pass, scored_band
from leaderboard.metrics.obstacles import Bump, obstacles, sort_out
from leaderboard.metrics.registry import NOTHING, SCORES
from leaderboard.metrics.roughness import THIRDS
from leaderboard.report.board_definitions import FORMS, Column, Kind
from leaderboard.report.tables import ALL, BOUND, EVERY, SPECTRUM, Line, Section, View, arrays
from road_envs.analysis.roughness import CLASSES, N_0, dsd, smooth

UNIT = 1e-4
"""Heights are told in this [m]."""

RAW, INSIDE = 0.05, 0.1
"""Spacing [m] at which raw and band-passed heights are drawn, at least."""

FARTHEST = 3.0
"""Heights [m] beyond this are drawn there."""

WORDS = ("interval", "states", "slope_interval")
"""Columns that are not one number."""

CLASS_N = (0.05, 10.0)
THRESHOLDS = 41
REPLICATES = 300
"""Of the bootstrap behind a performance profile: enough for a line."""


def table(view: View, section: Section, columns: Sequence[Column]) -> dict[str, Any]:
    """The rows of a task with their numbers over all runs and over each group."""
    keys = [*(column.key for column in columns), view.kind.ranks_by, "rank_causal", "low", "high"]
    wanted = dict.fromkeys(key for key in keys if key not in WORDS)
    return {
        "ranks_by": view.kind.ranks_by,
        "scale": view.kind.scale,
        "flat": 1.0 if view.kind.ranks_by == "nrmse" else None,
        "groups": {kind: list(names) for kind, names in section.groups.items()},
        "columns": {key: _form(key) for key in dict.fromkeys(keys)},
        "lines": [_line(line, list(wanted)) for line in section.lines],
    }


def _line(line: Line, keys: Sequence[str]) -> dict[str, Any]:
    groups = {ALL: line.values, **line.groups}
    return {
        "name": line.name,
        "state": line.state,
        "causal": bool(line.causal),
        "text": line.text,
        "sparse": line.state == "claim" or line.name == BOUND,
        "cells": {key: line.cells[key] for key in WORDS if line.cells.get(key)},
        "groups": {
            name: {key: rounded(x) for key in keys if (x := found.get(key)) is not None}
            for name, found in groups.items()
        },
    }


def _form(key: str) -> dict[str, Any]:
    """How a script prints a column: as `Score.text` does."""
    if key in FORMS:
        score = FORMS[key]
        told = {"factor": score.factor, "digits": score.digits, "blank": NOTHING}
        return {"better": score.better, "form": {**told, "sign": score.better == "zero"}}
    plain = {"rank": 0, "rank_causal": 0, "parameters": 0}
    plain |= {"train_seconds": 1, "estimate_ms_per_100m": 1}
    if key in plain:
        form = {"factor": 1, "digits": plain[key], "sign": False, "blank": ""}
        return {"better": "low", "form": form}
    return {"better": "low", "form": None}


def scenes(
    task: Task, kind: Kind, results: Mapping[str, Result], lines: Mapping[str, Line]
) -> dict[str, Any]:
    """All that is drawn of a task, of the results by name in their order."""
    told = {name: arrays(result) for name, result in results.items()}
    thresholds = np.linspace(0.0, kind.scale, THRESHOLDS)
    return {
        "entries": list(results),
        "ranks_by": SCORES[kind.ranks_by].label,
        "scale": kind.scale,
        "scenes": {
            condition.label: _scene(
                task, k, {name: r.traces[k] for name, r in results.items() if len(r.traces) > k}
            )
            for k, condition in enumerate(task.conditions)
        },
        "thirds": [rounded(n) for n in THIRDS],
        "spectrum": {name: _spectrum(lines[name]) for name in results},
        "thresholds": [rounded(x) for x in thresholds],
        "performance": {
            name: _performance(scores[kind.ranks_by][EVERY], thresholds)
            for name, scores in told.items()
            if len(scores[kind.ranks_by]) > 1
        },
        "class_n": CLASS_N,
        "classes": [
            {"letter": letter, "low": _class(0.5 * mean), "high": _class(2.0 * mean)}
            for letter, mean in CLASSES.items()
        ],
    }


def _scene(task: Task, place: int, traces: Mapping[str, Trace]) -> dict[str, Any]:
    """One condition: the truth, and what each entry made of it."""
    condition = task.conditions[place]
    band = scored_band(condition.speed_kmh / 3.6)
    if not traces:
        return {"said": "", "band": band, "bound": None, "entries": {}, "bumps": [[], []]}
    first = next(iter(traces.values()))
    n, density = _density(first.z_true, first.ds)
    trim = (first.s.size - band_pass(first.z_true, first.ds, band).shape[1]) // 2
    steps = {"raw": _every(RAW, first.ds), "inside": _every(INSIDE, first.ds)}
    place_of = {"raw": 0.0, "inside": trim * first.ds}
    truth = {"raw": _raw(first.z_true, first.ds), "inside": _inside(first.z_true, first.ds, band)}
    return {
        "said": f"{first.road}, seed {first.road_seed}: the first test road, "
        f"{first.s[-1] + first.ds:.0f} m of it; of each learner the training that is in the middle "
        "by error",
        "band": band,
        "bound": [rounded(x) for x in bound_over_n(task, condition)],
        **{
            kind: {"ds": steps[kind] * first.ds, "first": place_of[kind], "truth": truth[kind]}
            for kind in truth
        },
        "bumps": [_bumps(path) for path in obstacles(first.z_true, first.ds)],
        "density_n": [rounded(x) for x in n],
        "density": density,
        "entries": {name: _entry(trace, band) for name, trace in traces.items()},
    }


def _entry(trace: Trace, band: tuple[float, float]) -> dict[str, Any]:
    found = sort_out(trace.z_true, trace.z_estimated, trace.ds)
    std = trace.z_std
    return {
        "raw": _raw(trace.z_estimated, trace.ds),
        "inside": _inside(trace.z_estimated, trace.ds, band),
        "std": None if std is None else _deviation(std, trace, band),
        "density": _density(trace.z_estimated, trace.ds)[1],
        "bumps": None
        if found is None
        else [
            {
                "found": _bumps([f for _, f in path.pairs]),
                "missed": _bumps(path.missed),
                "false": _bumps(path.false),
            }
            for path in found
        ],
    }


def _raw(z: np.ndarray, ds: float) -> list[list[int]]:
    """Heights about their median, for no accelerometer sees the datum."""
    about = z - np.median(z, axis=1, keepdims=True)
    return [_coded(path[:: _every(RAW, ds)]) for path in about]


def _inside(z: np.ndarray, ds: float, band: tuple[float, float]) -> list[list[int]]:
    return [_coded(path[:: _every(INSIDE, ds)]) for path in band_pass(z, ds, band)]


def _deviation(std: np.ndarray, trace: Trace, band: tuple[float, float]) -> list[list[int]]:
    size = band_pass(trace.z_true, trace.ds, band).shape[1]
    trim = (trace.s.size - size) // 2
    kept = std[:, trim : trim + size : _every(INSIDE, trace.ds)]
    return np.rint(np.minimum(kept, FARTHEST) / UNIT).astype(int).tolist()


def _coded(z: np.ndarray) -> list[int]:
    """Differences of heights [m] in units."""
    whole = np.rint(np.clip(z, -FARTHEST, FARTHEST) / UNIT).astype(int)
    return np.diff(whole, prepend=0).tolist()


def _every(spacing: float, ds: float) -> int:
    return max(1, round(spacing / ds))


def _bumps(bumps: Sequence[Bump]) -> list[tuple[float, int]]:
    return [(round(bump.s, 2), round(bump.height / UNIT)) for bump in bumps]


def _density(z: np.ndarray, ds: float) -> tuple[np.ndarray, list[float | None]]:
    """Where, and the logarithm of, the density of both wheel paths; None where there is none."""
    n, G = smooth(*dsd(z, ds))
    return n, [round(math.log10(x), 2) if x > 0.0 else None for x in G.mean(axis=0)]


def _class(level: float) -> list[float]:
    return [level * (n / N_0) ** -2.0 for n in CLASS_N]


def _spectrum(line: Line) -> dict[str, list[float | None]]:
    """Error over spatial frequency, of all runs and of each group."""
    groups = {ALL: line.values, **line.groups}
    return {
        group: [None if (x := found.get(name)) is None else rounded(x) for name in SPECTRUM]
        for group, found in groups.items()
    }


def _performance(scores: np.ndarray, thresholds: np.ndarray) -> dict[str, list[float]]:
    found = performance(scores, thresholds, replicates=REPLICATES)
    return {name: np.round(100.0 * x, 1).tolist() for name, x in found._asdict().items()}


def rounded(x: float) -> float:
    """Four digits, which is more than is printed."""
    return float(f"{x:.4g}")
