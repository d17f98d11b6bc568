"""Content of the page of one estimator: method, settings, errors, calibration, cost, failures."""

import inspect
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm

from estimators.registry import REGISTRY
from leaderboard.conformance.method_card import MethodCard
from leaderboard.evaluation.boards import BoardDefinition
from leaderboard.evaluation.results import Result, Trace
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics.api import UNDEFINED
from leaderboard.metrics.heights import band_pass, scored_band
from leaderboard.report.board_definitions import COLUMNS, label_with_unit
from leaderboard.report.charts import bound_line, error_axes, error_lines
from leaderboard.report.figures import (
    QUIET,
    Chart,
    axis,
    chart,
    colour,
    curve,
    interval_bars,
    line_style,
    rounded,
    upright,
)
from leaderboard.report.tables import Row, Section

WORST_DRIVES = 3
"""Number of drives of a task with the largest errors that are listed."""

LABEL_LENGTH = 20
"""Length at which the name of a group is continued on a second line [characters]."""

NOMINAL_SHARES = np.linspace(0.05, 0.95, 19)
"""Probabilities of the intervals of a calibration chart."""


Figure = dict[str, Any]
Evaluated = tuple[Task, Result, Row, Section, BoardDefinition]
"""One result with its task and its row on the board."""


def estimator_charts(evaluated: Sequence[Evaluated]) -> dict[str, Chart]:
    """Return the charts of an estimator that are not empty, with a figure for each task."""
    errors: dict[str, Figure | None] = {}
    spectra: dict[str, Figure | None] = {}
    calibrations: dict[str, Figure | None] = {}
    for task, result, row, section, definition in evaluated:
        errors[task.name] = _error_figure(row, section, definition)
        spectra[task.name] = _spectrum_figure(row, task)
        calibrations[task.name] = _calibration_figure(result)
    made: dict[str, tuple[str, dict[str, Figure | None], dict[str, Any]]] = {
        "errors": ("Error by condition and family", errors, ERROR_LAYOUT),
        "spectrum": ("Error over spatial frequency", spectra, error_axes()),
        "calibration": ("Calibration of the stated intervals", calibrations, CALIBRATION_LAYOUT),
    }
    return {
        name: chart(title, figures, layout, by=("task",))
        for name, (title, found, layout) in made.items()
        if (figures := {task: figure for task, figure in found.items() if figure})
    }


class Method(NamedTuple):
    """Documentation of an estimator of this package: paragraphs of its module and of its class."""

    paragraphs: list[tuple[str, bool]]
    settings: list[tuple[str, bool]]
    source: str


def method(name: str) -> Method | None:
    """Return the documentation of an estimator; None if it comes from another package."""
    cls = REGISTRY.get(name)
    if cls is None:
        return None
    module = inspect.getmodule(cls)
    text = inspect.getdoc(module) or ""
    return Method(
        _paragraphs(text),
        _paragraphs(inspect.getdoc(cls) or ""),
        f"{cls.__module__.replace('.', '/')}.py",
    )


def method_card_rows(card: MethodCard | None) -> list[tuple[str, str]]:
    """Return label and text of each line of the authors' card of an entry."""
    texts = {} if card is None else {**vars(card), "authors": ", ".join(card.authors)}
    return [(label, text) for label, text in texts.items()]


def _paragraphs(text: str) -> list[tuple[str, bool]]:
    """Return the paragraphs of a docstring, and whether each is indented: formulas, lists."""
    blocks = [block for block in re.split(r"\n\s*\n", text.strip("\n")) if block.strip()]
    return [
        (inspect.cleandoc(block) if indented else " ".join(block.split()), indented)
        for block in blocks
        for indented in [block.startswith(" ")]
    ]


ERROR_LAYOUT = {
    "margin": {"l": 8, "r": 12, "t": 34, "b": 44},
    "showlegend": False,
    "bargap": 0.3,
    "yaxis": axis("", autorange="reversed", showgrid=False, fixedrange=True),
}
CALIBRATION_LAYOUT = {
    "xaxis": axis("stated probability [%]", 0.0, 100.0),
    "yaxis": axis("errors inside [%]", 0.0, 100.0),
}


def _error_figure(row: Row, section: Section, definition: BoardDefinition) -> dict[str, Any] | None:
    """Return the ranking score over all runs and by condition and family, with intervals."""
    key, score = definition.ranks_by, COLUMNS[definition.ranks_by]
    names = [group for groups in section.groups.values() for group in groups]
    groups = {"all drives": row.values, **{name: row.groups.get(name, {}) for name in names}}
    found = {name: x for name, values in groups.items() if (x := values.get(key)) is not None}
    if len(found) < 2:
        return None
    labels = {
        f"{'<br>'.join(textwrap.wrap(name, LABEL_LENGTH))}  <b>{score.format_value(x)}</b>": x
        for name, x in found.items()
    }
    ends = [(groups[name].get("low"), groups[name].get("high")) for name in found]
    bars = {
        **interval_bars(row.name, labels, ends),
        "marker": {"color": colour(row.name)},
        "hovertemplate": "%{y}<extra></extra>",
    }
    layout = {
        "height": 30 * len(found) + 80,
        "xaxis": axis(label_with_unit(score), rangemode="tozero"),
        "shapes": [upright(1.0)] if key == "nrmse" and max(found.values()) > 0.5 else [],
    }
    return {"data": [bars], "layout": layout}


def _spectrum_figure(row: Row, task: Task) -> dict[str, Any]:
    """Return the error over spatial frequency, with the bound under the first condition."""
    condition = task.conditions[0]
    bound = bound_line(task, condition) | {"name": f"bound, {condition.label}"}
    return {"data": [bound, *error_lines({row.name: row}, "")]}


def _calibration_figure(result: Result) -> dict[str, Any] | None:
    """Return the share of errors inside intervals of every probability; None without intervals.

    The errors are those of the stored start of one drive under each condition, in the scored band.
    """
    ratios = [_standardized(trace) for trace in result.traces if trace.z_std is not None]
    if not ratios:
        return None
    errors = np.concatenate(ratios)
    inside = [np.mean(errors <= norm.ppf(0.5 + share / 2.0)) for share in NOMINAL_SHARES]
    exact = {"color": QUIET, "dash": "dot", "width": 1.2}
    measured = curve(
        result.estimator,
        [rounded(100.0 * share, 4) for share in NOMINAL_SHARES],
        [rounded(100.0 * share, 4) for share in inside],
        mode="lines+markers",
        line=line_style(result.estimator),
        marker={"color": colour(result.estimator)},
        hovertemplate="%{y:.0f} % of the errors inside the %{x:.0f} % interval",
    )
    return {"data": [curve("exact", [0, 100], [0, 100], line=exact, hoverinfo="skip"), measured]}


def _standardized(trace: Trace) -> np.ndarray:
    """Return in-band errors over their stated standard deviations, without signs."""
    band = scored_band(trace.speed_kmh / 3.6)
    errors = band_pass(trace.z_estimated, trace.ds, band) - band_pass(trace.z_true, trace.ds, band)
    first = (trace.s.size - errors.shape[1]) // 2
    std = trace.z_std
    assert std is not None
    inside = std[:, first : first + errors.shape[1]]
    return np.abs(errors[inside > 0.0]) / inside[inside > 0.0]


def worst_drives(task: Task, result: Result, key: str) -> list[tuple[str, ...]]:
    """Return task, road, condition, training seed and error of the worst of several drives."""
    runs = result.scores[result.scores["score"] == key]
    if len(runs) < 2:
        return []
    form = COLUMNS[key]
    return [
        (
            task.name,
            f"{run.road}, seed {run.road_seed}",
            run.condition,
            f"{run.seed}",
            f"{form.format_value(run.value)} {form.unit}",
        )
        for run in runs.nlargest(WORST_DRIVES, "value").itertuples()
    ]


def cost(task: Task, result: Result) -> tuple[str, ...]:
    """Return task, time per 100 m, time of a training, parameters and memory of an estimator."""
    trained = bool(result.parameters and result.train_seconds)
    return (
        task.name,
        _text(result.estimate_ms_per_100m, "{:.0f} ms"),
        _text(float(np.mean(result.train_seconds)) if trained else None, "{:.1f} s"),
        _text(result.parameters or None, "{:d}"),
        _text(result.peak_memory, "{:.2f} GiB"),
    )


def _text(value: float | None, form: str) -> str:
    return UNDEFINED if value is None else form.format(value)


def settings_in_words(settings: Mapping[str, Any]) -> str:
    """Return the settings of an entry in one line."""
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in settings.items())
