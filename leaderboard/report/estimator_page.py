"""Content of the page of one estimator: method, settings, errors, calibration, cost, failures."""

import inspect
import json
import re
import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.stats import norm

from estimators.registry import REGISTRY
from leaderboard.evaluation.results import Result, Trace
from leaderboard.evaluation.tasks import ALL_DRIVES, Task
from leaderboard.metrics import UNDEFINED
from leaderboard.metrics.heights import band_pass, scored_band
from leaderboard.report import figures as fig
from leaderboard.report.board_definitions import COLUMNS, rank_column
from leaderboard.report.charts import ERROR_AXES, bound_lines, error_lines
from leaderboard.report.tables import BoardView, Row, Section, train_seconds
from leaderboard.running.board import Board

_NOMINAL_SHARES = np.linspace(0.05, 0.95, 19)  # probabilities of intervals that are calibrated
_Evaluated = tuple[Section, Result, Row]  # a row of a board


def page_values(
    board: Board, views: Sequence[BoardView], name: str, results: Sequence[tuple[Task, Result]]
) -> dict[str, Any]:
    """Return the values of the page of an entry, from its rows on all boards and its `results`."""
    places = [(view, section) for view in views for section in view.sections]
    rows = [(*place, row) for place in places for row in place[1].rows if row.name == name]
    by_task = {task.name: result for task, result in results}
    scored = ((x, row) for _, x, row in rows if row.state in ("scored", "baseline"))
    evaluated = [(section, by_task[section.task.name], row) for section, row in scored]
    first, about = results[0][1], board.methods.get(name)
    settings = (f"{key.replace('_', ' ')} {x}" for key, x in first.settings.items())
    statements = vars(about) | {"authors": ", ".join(about.authors)} if about else {}
    cards = {card.identity: card for _, result in results if (card := board.card(result))}
    return {
        "root": "../",
        "name": name,
        "role": first.role,
        "causal": all(result.causal for _, result in results),
        "lag": first.lag,
        "settings": ", ".join(settings),
        "programs": len({(x.code, json.dumps(x.settings, sort_keys=True)) for _, x in results}),
        "method": _method(name),
        "method_card": statements.items(),
        "cards": [*cards.values()],
        "rows": rows,
        "rank_column": rank_column,
        "charts": _charts(evaluated),
        "tasks": [section.task for section, *_ in evaluated],
        "cost": [_cost(result) for _, result, *_ in evaluated],
        "worst": [drive for where in evaluated for drive in _worst_drives(*where)],
        "failures": [(task, result.failure) for task, result in results if result.failure],
        "results": [(task, one, _result_provenance(board, task, one)) for task, one in results],
    }


def _result_provenance(board: Board, task: Task, result: Result) -> list[tuple[str, str]]:
    facts = {
        "file": f"results/{result.task}/{result.estimator}.json",
        "task": f"version {task.version}, digest {result.task_digest}",
        "code": result.code,
        "state": board.stale_reason(task, result) or "fresh",
        "package": f"road-envs {result.package_version}, metrics {result.metric_version}",
        "isolation": result.isolation,
        "limits": "{:g} s, {:g} GiB".format(*result.limits) if any(result.limits) else "unknown",
        "training seeds": ", ".join(map(str, result.seeds)),
        "settings": json.dumps(result.settings) if result.settings else "none",
    }
    return [*facts.items(), *result.environment.items()]


def _charts(evaluated: Sequence[_Evaluated]) -> dict[str, fig.Chart]:
    """Return the charts of an estimator that are not empty, with a figure for each task."""
    ranked = {
        "margin": {"l": 8, "r": 12, "t": 34, "b": 44},
        "showlegend": False,
        "bargap": 0.3,
        "yaxis": fig.axis("", autorange="reversed", showgrid=False, fixedrange=True),
    }
    titles = {"xaxis": "stated probability [%]", "yaxis": "errors inside [%]"}
    shares = {name: fig.axis(title, 0.0, 100.0) for name, title in titles.items()}
    made: dict[str, tuple[str, dict[str, Any], Callable[..., dict[str, Any] | None]]] = {
        "errors": ("Error by condition and family", ranked, _error_figure),
        "spectrum": ("Error over spatial frequency", ERROR_AXES, _spectrum_figure),
        "calibration": ("Calibration of the stated intervals", shares, _calibration_figure),
    }
    return {
        name: fig.chart(title, figures, layout, by=("task",))
        for name, (title, layout, draw) in made.items()
        if (figures := {one[0].task.name: figure for one in evaluated if (figure := draw(*one))})
    }


def _method(name: str) -> dict[str, Any] | None:
    """Paragraphs of the docstrings of an estimator's module and class; None of another package."""
    if (cls := REGISTRY.get(name)) is None:
        return None
    return {
        "paragraphs": _paragraphs(inspect.getmodule(cls)),
        "settings": _paragraphs(cls),
        "source": f"{cls.__module__.replace('.', '/')}.py",
    }


def _paragraphs(documented: object) -> list[tuple[str, bool]]:
    """Return the paragraphs of a docstring, and whether each is indented: formulas, lists."""
    blocks = re.split(r"\n\s*\n", (inspect.getdoc(documented) or "").strip("\n"))
    texts = [(x, x.startswith(" ")) for x in blocks if x.strip()]
    return [(inspect.cleandoc(x) if own else " ".join(x.split()), own) for x, own in texts]


def _error_figure(section: Section, result: Result, row: Row) -> fig.Chart | None:
    """Return the ranking score over all runs and by condition and family, with intervals."""
    key = section.task.board_definition.ranks_by
    score = COLUMNS[key]
    names = [group for groups in section.groups.values() for group in groups]
    groups = {ALL_DRIVES: row.values, **{name: row.groups.get(name, {}) for name in names}}
    found = {name: x for name, values in groups.items() if (x := values.get(key)) is not None}
    if len(found) < 2:
        return None
    labels = {  # in lines of 20 characters
        f"{'<br>'.join(textwrap.wrap(name, 20))}  <b>{score.format_value(x)}</b>": x
        for name, x in found.items()
    }
    ends = [(groups[name].get("low"), groups[name].get("high")) for name in found]
    bars = fig.interval_bars(row.name, labels, ends, score.factor)
    bars |= {"marker": {"color": fig.colour(row.name)}, "hovertemplate": "%{y}<extra></extra>"}
    layout = {
        "height": 30 * len(found) + 80,
        "xaxis": fig.axis(score.heading, rangemode="tozero"),
        "shapes": [fig.upright(1.0)] if key == "nrmse" and max(found.values()) > 0.5 else [],
    }
    return {"data": [bars], "layout": layout}


def _spectrum_figure(section: Section, result: Result, row: Row) -> fig.Chart:
    condition = section.task.conditions[0]
    bound = bound_lines(section.task, condition, f"bound, {condition.label}")
    return {"data": [*bound, *error_lines({row.name: row}, "")]}


def _calibration_figure(section: Section, result: Result, *_: Any) -> dict[str, Any] | None:
    """Return the share of errors inside intervals of every probability, in the scored band of the
    stored start of one drive under each condition; None without intervals.
    """
    ratios = [_standardized(trace).ravel() for trace in result.traces if trace.z_std is not None]
    if not ratios:
        return None
    errors = np.concatenate(ratios)
    inside = [np.mean(errors <= norm.ppf(0.5 + share / 2.0)) for share in _NOMINAL_SHARES]
    look = {"color": fig.QUIET, "dash": "dot", "width": 1.2}
    exact = fig.curve("exact", [0, 100], [0, 100], line=look, hoverinfo="skip")
    x, y = ([fig.rounded(100.0 * s, 4) for s in shares] for shares in (_NOMINAL_SHARES, inside))
    measured = fig.curve(
        result.estimator, x, y, mode="lines+markers", line=fig.line_style(result.estimator),
        marker={"color": fig.colour(result.estimator)},
        hovertemplate="%{y:.0f} % of the errors inside the %{x:.0f} % interval",
    )  # fmt: skip
    return {"data": [exact, measured]}


def _standardized(trace: Trace) -> np.ndarray:
    """Return in-band errors (2, K) over their stated standard deviations, without signs."""
    band = scored_band(trace.speed_kmh / 3.6)  # in units of the trace, as the deviations are
    errors = band_pass(trace.estimate, trace.ds, band) - band_pass(trace.truth, trace.ds, band)
    first = (trace.s.size - errors.shape[1]) // 2
    assert trace.deviation is not None
    # a deviation that is rounded to 0 is half a unit at most: any larger error is far outside
    return np.abs(errors) / np.maximum(trace.deviation[:, first : first + errors.shape[1]], 0.5)


def _worst_drives(section: Section, result: Result, *_: Any) -> list[tuple[str, ...]]:
    """Return task, road, condition, training seed and error of the worst three of some drives."""
    key = section.task.board_definition.ranks_by
    runs = result.scores[result.scores["score"] == key]
    if len(runs) < 2:
        return []
    return [
        (result.task, f"{run.road}, seed {run.road_seed}", run.condition, f"{run.seed}",
         COLUMNS[key].text(run.value))
        for run in runs.nlargest(3, "value").itertuples()
    ]  # fmt: skip


def _cost(result: Result) -> tuple[str, ...]:
    """Return task, time per 100 m, time of a training, parameters and memory of an estimator."""
    values = (
        (result.estimate_ms_per_100m, "{:.0f} ms"),
        (train_seconds(result), "{:.1f} s"),
        (result.parameters or None, "{:d}"),
        (result.peak_memory, "{:.2f} GiB"),
    )
    return result.task, *(UNDEFINED if x is None else form.format(x) for x, form in values)
