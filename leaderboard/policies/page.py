"""Page of the policy comparison, and the Pareto plot beside it."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from leaderboard.policies.ride_metrics import METRICS
from leaderboard.policies.summary import PARETO_METRICS, format_metric
from leaderboard.policies.timeline import Timeline, drive_chart
from leaderboard.report.figures import QUIET, Chart, axis, chart
from leaderboard.report.rendering import (
    BOARD_PAGE,
    POLICY_PAGE,
    file_name,
    render,
    write_static,
)
from road_envs.core.atomic_io import write_text
from road_envs.policies.greedy_information import GreedyInformation

COLOURS = {"Pareto-optimal": "#D55E00", "dominated": "#0072B2", "oracle": "#808080"}
"""Colours of the plot; the page has its own."""

PAGE_COLOURS = {
    "Pareto-optimal": "var(--line-0)",
    "dominated": "var(--line-1)",
    "oracle": "var(--line-6)",
}
SYMBOLS = {
    "circle": "o",
    "square": "s",
    "diamond": "D",
    "triangle-up": "^",
    "triangle-down": "v",
    "triangle-left": "<",
    "triangle-right": ">",
    "cross": "P",
    "x": "X",
    "pentagon": "p",
    "hexagon": "h",
    "star": "*",
}
"""Markers of the policies of one status in turn, by their names in Plotly and in matplotlib."""

SWEEP_PREFIX = "information "
"""Names of the greedy information policies of a sweep: this prefix, then the weight."""


def write_policy_page(data: dict[str, Any], timelines: Mapping[str, Timeline], out: Path) -> Path:
    """Write policies.html and pareto.png under `out`; return the path of the page."""
    draw_pareto(data, out / "pareto.png")
    page = out / POLICY_PAGE
    write_static(out)
    write_text(page, render_page(data, timelines, out))
    return page


def render_page(
    data: dict[str, Any],
    timelines: Mapping[str, Timeline] = MappingProxyType({}),
    out: Path | None = None,
) -> str:
    """Render the page from the data of `summarize_results` and one drive of each policy.

    The page links to the leaderboard and to those estimators that have a page under `out`.
    """
    first = next((row for row in data["rows"] if not row["failure"]), None)
    estimators = list(first["errors"]) if first else []
    pages = {name: f"estimators/{file_name(name)}" for name in estimators}
    linked = {name: page for name, page in pages.items() if out and (out / page).exists()}
    return render(
        "site/policies.html",
        root="",
        data=data,
        metrics=METRICS,
        estimators=estimators,
        estimator_pages=linked,
        format_metric=format_metric,
        pareto=pareto_chart(data) if first else None,
        drives=drive_chart(timelines) if timelines else None,
        board=bool(out and (out / BOARD_PAGE).exists()),
        policies=True,
    )


def pareto_chart(data: dict[str, Any]) -> Chart:
    """Return comfort and handling, each against the error of the first estimator."""
    rows = [row for row in data["rows"] if not row["failure"]]
    traces = [_sweep_line(rows, k) for k in range(len(PARETO_METRICS))]
    for row, symbol in zip(rows, _symbols(rows), strict=True):
        for k in range(len(PARETO_METRICS)):
            traces.append(_policy_trace(row, symbol, k))
    layout = {
        "height": 460,
        "xaxis": axis("comfort [m/s²]", domain=[0.0, 0.48], nticks=5),
        "xaxis2": axis("tyre load", domain=[0.52, 1.0], nticks=5),
        "yaxis": axis("error of the reconstruction"),
    }
    return chart(
        "Comfort and tyre load of every policy against its reconstruction error",
        {"": {"data": traces}},
        layout,
    )


def _policy_trace(row: dict[str, Any], symbol: str, k: int) -> dict[str, Any]:
    """Return a policy in panel `k` with its intervals; its marker is filled if Pareto-optimal."""
    x, y = row["metrics"][PARETO_METRICS[k]], first_error(row)
    colour = PAGE_COLOURS[status(row)]
    spans = {
        f"error_{name}": {
            "type": "data",
            "array": [max(value["high"] - value["mean"], 0.0)],
            "arrayminus": [max(value["mean"] - value["low"], 0.0)],
            "thickness": 1,
            "width": 0,
            "color": colour,
        }
        for name, value in (("x", x), ("y", y))
    }
    return {
        "name": row["policy"],
        "legendgroup": row["policy"],
        "showlegend": k == 0,
        "mode": "markers",
        "x": [x["mean"]],
        "y": [y["mean"]],
        "xaxis": "x" if k == 0 else "x2",
        "marker": {
            "symbol": symbol if row["pareto"] else f"{symbol}-open",
            "size": 10,
            "color": colour,
            "line": {"width": 2, "color": colour},
        },
        "customdata": [f"#policy-{row['policy'].replace(' ', '-')}"],
        "hovertemplate": f"{row['policy']}, {status(row)}: %{{x:.3f}}, error %{{y:.3f}}"
        "<extra></extra>",
        **spans,
    }


def _sweep_line(rows: list[dict[str, Any]], k: int) -> dict[str, Any]:
    points = sweep_points(rows, PARETO_METRICS[k])
    return {
        "name": "greedy information, weight swept",
        "legendgroup": "sweep",
        "showlegend": bool(k == 0 and points),
        "mode": "lines",
        "x": [x for x, _ in points],
        "y": [y for _, y in points],
        "xaxis": "x" if k == 0 else "x2",
        "line": {"color": QUIET, "width": 1, "dash": "dot"},
        "hoverinfo": "skip",
    }


def _symbols(rows: list[dict[str, Any]]) -> list[str]:
    """Return a symbol for each row, different ones within a status and so within a colour."""
    counts = dict.fromkeys(PAGE_COLOURS, 0)
    symbols = []
    for row in rows:
        symbols.append(list(SYMBOLS)[counts[status(row)] % len(SYMBOLS)])
        counts[status(row)] += 1
    return symbols


def status(row: dict[str, Any]) -> str:
    """Return whether a policy is Pareto-optimal, dominated, or a former "oracle"."""
    return "Pareto-optimal" if row["pareto"] else "dominated" if row["attainable"] else "oracle"


def sweep_points(rows: list[dict[str, Any]], metric: str) -> list[tuple[float, float]]:
    """Return metric and error of the greedy information policies by weight; empty if not swept."""
    swept = [(weight, row) for row in rows if (weight := _weight(row["policy"])) is not None]
    if len(swept) < 3:
        return []
    swept.sort(key=lambda item: item[0])
    return [(row["metrics"][metric]["mean"], first_error(row)["mean"]) for _, row in swept]


def _weight(name: str) -> float | None:
    """Return the weight of the unresolved variance of a greedy policy; None for other policies."""
    # without a weight on the variance, the greedy policy stays in ride mode
    known = {"fixed_ride": 0.0, "greedy_information": GreedyInformation().weight}
    return (
        float(name.removeprefix(SWEEP_PREFIX)) if name.startswith(SWEEP_PREFIX) else known.get(name)
    )


def first_error(row: dict[str, Any]) -> dict[str, float]:
    """Return the error of the first estimator, or the bound without estimators."""
    return next(iter(row["errors"].values()), row["metrics"]["bound"])


def draw_pareto(data: dict[str, Any], path: Path) -> None:
    """Draw the chart of `pareto_chart` as a picture, with the same markers."""
    from leaderboard.report.plots import write_figure

    rows = [row for row in data["rows"] if not row["failure"]]
    marks = [SYMBOLS[symbol] for symbol in _symbols(rows)]

    def paint(figure: Any) -> None:
        for axes, name in zip(figure.subplots(1, 2, sharey=True), PARETO_METRICS, strict=True):
            for row, mark in zip(rows, marks, strict=True):
                _draw_policy(axes, row["metrics"][name], first_error(row), row, mark)
            if points := sweep_points(rows, name):
                axes.plot(*zip(*points, strict=True), ":", color="0.4", lw=1.0, zorder=0)
            axes.set(xlabel=f"{METRICS[name].label} [{METRICS[name].unit or '-'}]")
            axes.grid(color="0.93", lw=0.6)
        figure.axes[0].set(ylabel="error of the reconstruction (in-band NRMSE)")
        figure.legend(
            *figure.axes[0].get_legend_handles_labels(),
            loc="outside right center",
            frameon=False,
            fontsize=8,
            title="filled, orange: Pareto-optimal\nblue: dominated; grey: oracle\n"
            "dotted: information weight swept",
            title_fontsize=8,
        )

    write_figure(paint, (10.0, 5.0), path)


def _draw_policy(
    axes: Any, x: dict[str, float], y: dict[str, float], row: dict[str, Any], mark: str
) -> None:
    """Draw a policy with its intervals; an empty marker if another one dominates it."""
    colour = COLOURS[status(row)]
    spans = [
        np.array([[max(v["mean"] - v["low"], 0.0)], [max(v["high"] - v["mean"], 0.0)]])
        for v in (x, y)
    ]
    at = (x["mean"], y["mean"])
    axes.errorbar(*at, xerr=spans[0], yerr=spans[1], color=colour, lw=0.7, alpha=0.5, zorder=1)
    inside = colour if row["pareto"] else "white"
    look = {"marker": mark, "facecolor": inside, "edgecolor": colour, "label": row["policy"]}
    axes.scatter(*at, s=34.0, zorder=2, **look)
