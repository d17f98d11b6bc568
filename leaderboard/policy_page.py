"""The league of policies as one self-contained page, with the Pareto plot beside it."""

from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from leaderboard.ride import METRICS
from leaderboard.standings import FRONT, text
from road_envs.files import write_text


def write(data: dict[str, Any], out: Path) -> Path:
    """Write policies.html and pareto.png under `out`; the path of the page."""
    draw_pareto(data, out / "pareto.png")
    page = out / "policies.html"
    write_text(page, render(data))
    return page


def render(data: dict[str, Any]) -> str:
    """The page from a summary of standings."""
    env = Environment(
        loader=PackageLoader("leaderboard"), autoescape=True, undefined=StrictUndefined
    )
    template = env.get_template("policies.html")
    first = next((row for row in data["rows"] if not row["failure"]), None)
    readers = list(first["errors"]) if first else []
    return template.render(data=data, metrics=METRICS, readers=readers, text=text)


def draw_pareto(data: dict[str, Any], path: Path) -> None:
    """Comfort against the first estimator's error; the size of a dot is the tyre load."""
    from leaderboard.plots import write_figure

    rows = [row for row in data["rows"] if not row["failure"]]

    def paint(figure: Any) -> None:
        axes = figure.subplots()
        for row in rows:
            x, y = row["metrics"][FRONT[0]], _error(row)
            colour = "#D55E00" if row["pareto"] else "#0072B2" if row["attainable"] else "0.6"
            size = 30.0 + 400.0 * max(row["metrics"][FRONT[1]]["mean"] - 0.2, 0.0)
            bars = (
                [[max(v["mean"] - v["low"], 0.0)] for v in (x, y)],
                [[max(v["high"] - v["mean"], 0.0)] for v in (x, y)],
            )
            at = (x["mean"], y["mean"])
            spans = [np.array([low, high]) for low, high in zip(*bars, strict=True)]
            axes.errorbar(*at, xerr=spans[0], yerr=spans[1], color=colour, lw=0.8, zorder=1)
            axes.scatter(*at, s=size, color=colour, alpha=0.8, zorder=2)
            axes.annotate(row["policy"], at, (5, 4), textcoords="offset points", fontsize=7)
        axes.set(
            xlabel="W_k-weighted RMS heave acceleration [m/s²]",
            ylabel="in-band reconstruction error [-]",
            title="Comfort against what the drive tells of the road (red: Pareto front)",
        )

    write_figure(paint, (8.0, 5.5), path)


def _error(row: dict[str, Any]) -> dict[str, float]:
    return next(iter(row["errors"].values()), row["metrics"]["bound"])
