"""Self-contained HTML page of the policy comparison, and the Pareto plot beside it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from leaderboard.policies.ride_metrics import METRICS
from leaderboard.policies.summary import PARETO_METRICS, format_metric
from leaderboard.policies.timeline import MODE_NAMES, Timeline
from leaderboard.report.rendering import render
from road_envs._atomic_io import write_text
from road_envs._extras import optional_import
from road_envs.policies.greedy_information import GreedyInformation

PARETO_COLOUR, DOMINATED_COLOUR, ORACLE_COLOUR, SWEEP_COLOUR = (
    "#D55E00",
    "#0072B2",
    "0.6",
    "#009E73",
)

SWEEP_PREFIX = "information "
"""Names of the greedy information policies of a sweep: this prefix, then the weight."""


def write_policy_page(data: dict[str, Any], timelines: Mapping[str, Timeline], out: Path) -> Path:
    """Write policies.html and pareto.png under `out`; return the path of the page."""
    draw_pareto(data, out / "pareto.png")
    page = out / "policies.html"
    write_text(page, render_page(data, timelines, board=(out / "index.html").exists()))
    return page


def render_page(
    data: dict[str, Any],
    timelines: Mapping[str, Timeline] = MappingProxyType({}),
    board: bool = False,
) -> str:
    """Render the page from the data of `summarize_results` and one drive of each policy.

    With `board`, the page links to the leaderboard of estimators beside it.
    """
    first = next((row for row in data["rows"] if not row["failure"]), None)
    estimators = list(first["errors"]) if first else []
    pictures = {name: timeline.svg() for name, timeline in timelines.items()}
    return render(
        "policies.html",
        data=data,
        metrics=METRICS,
        estimators=estimators,
        format_metric=format_metric,
        timelines=pictures,
        states=MODE_NAMES,
        board=board,
    )


def draw_pareto(data: dict[str, Any], path: Path) -> None:
    """Draw comfort and handling, each against the error of the first estimator.

    Markers of Pareto-optimal policies are filled; a line joins the greedy information policies.
    """
    from leaderboard.report.plots import write_figure

    rows = [row for row in data["rows"] if not row["failure"]]
    swept = [row for row in rows if _sensing_weight(row["policy"]) is not None]
    swept.sort(key=lambda row: _sensing_weight(row["policy"]) or 0.0)

    def paint(figure: Any) -> None:
        for axes, name in zip(figure.subplots(1, 2, sharey=True), PARETO_METRICS, strict=True):
            for row in rows:
                _draw_policy(axes, row["metrics"][name], _first_error(row), row)
            line = [(row["metrics"][name]["mean"], _first_error(row)["mean"]) for row in swept]
            if len(line) > 2:
                axes.plot(*zip(*line, strict=True), color=SWEEP_COLOUR, lw=1.0, zorder=0)
            metric = METRICS[name]
            axes.set(xlabel=f"{metric.label} [{metric.unit}]")
            axes.grid(color="0.93", lw=0.6)
        figure.axes[0].set(ylabel="in-band reconstruction error [-]")
        figure.legend(
            handles=_legend_entries(rows), loc="outside right center", frameon=False, fontsize=8
        )
        figure.suptitle("Comfort and handling against the reconstruction error")
        for k, row in enumerate(rows, start=1):
            for axes, name in zip(figure.axes, PARETO_METRICS, strict=True):
                at = (row["metrics"][name]["mean"], _first_error(row)["mean"])
                axes.annotate(str(k), at, (4, 3), textcoords="offset points", fontsize=8)

    write_figure(paint, (10.0, 5.0), path)


def _sensing_weight(name: str) -> float | None:
    """Return the weight of the unresolved variance of a greedy policy; None for other policies."""
    # without a weight on the variance, the greedy policy stays in ride mode
    known = {"fixed_ride": 0.0, "greedy_information": GreedyInformation().weight}
    return (
        float(name.removeprefix(SWEEP_PREFIX)) if name.startswith(SWEEP_PREFIX) else known.get(name)
    )


def _legend_entries(rows: Sequence[dict[str, Any]]) -> list[Any]:
    """Return the legend: numbers and names of the policies, and the colours."""
    with optional_import("a figure"):
        from matplotlib.lines import Line2D

    colours = {
        "Pareto-optimal": PARETO_COLOUR,
        "dominated": DOMINATED_COLOUR,
        "oracle (knows the road)": ORACLE_COLOUR,
    }
    names = [Line2D([], [], ls="", label=f"{k}  {row['policy']}") for k, row in enumerate(rows, 1)]
    dots = [Line2D([], [], ls="", marker="o", color=c, label=n) for n, c in colours.items()]
    return [
        *dots,
        Line2D([], [], color=SWEEP_COLOUR, label="greedy information, weight swept"),
        *names,
    ]


def _draw_policy(axes: Any, x: dict[str, float], y: dict[str, float], row: dict[str, Any]) -> None:
    """Draw a policy with its intervals; an empty circle if another one dominates it."""
    colour = (
        PARETO_COLOUR if row["pareto"] else DOMINATED_COLOUR if row["attainable"] else ORACLE_COLOUR
    )
    spans = [
        np.array([[max(v["mean"] - v["low"], 0.0)], [max(v["high"] - v["mean"], 0.0)]])
        for v in (x, y)
    ]
    at = (x["mean"], y["mean"])
    axes.errorbar(*at, xerr=spans[0], yerr=spans[1], color=colour, lw=0.7, alpha=0.5, zorder=1)
    inside = colour if row["pareto"] else "white"
    axes.scatter(*at, s=26.0, facecolor=inside, edgecolor=colour, zorder=2)


def _first_error(row: dict[str, Any]) -> dict[str, float]:
    """Return the error of the first estimator, or the bound without estimators."""
    return next(iter(row["errors"].values()), row["metrics"]["bound"])
