"""Page of the comparison of policies: table, scores of each drive, and one drive over time."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from leaderboard.policies.comparison import BEST_FOUND, GROUPS, Comparison, interval_text
from leaderboard.policies.timeline import Timeline, drive_chart
from leaderboard.report.figures import QUIET, Chart, axis, chart
from leaderboard.report.rendering import BOARD_PAGE, POLICY_PAGE, render, write_static
from road_envs.core.atomic_io import write_text

_SHOWN_DRIVE = 0  # number of the drive that is shown over time


def timelines(comparison: Comparison) -> dict[str, Timeline]:
    """Return the shown drive under each of the shown policies."""
    shown = {name: comparison.rollouts[name].actions for name in _shown_policies(comparison.data)}
    return {k: Timeline.from_drive(comparison.drives, _SHOWN_DRIVE, x) for k, x in shown.items()}


def write_page(data: Mapping[str, Any], lines: Mapping[str, Timeline], out: Path) -> Path:
    """Write policies.html under `out`, and return its path; arguments as of `_render_page`."""
    page = out / POLICY_PAGE
    write_static(out)
    write_text(page, _render_page(data, lines, board=(out / BOARD_PAGE).exists()))
    return page


def _render_page(
    data: Mapping[str, Any], lines: Mapping[str, Timeline] | None = None, board: bool = False
) -> str:
    """Render the page of a comparison; it links to the leaderboard if there is a `board`."""
    present = [group for group in GROUPS if any(group in r.get("groups", {}) for r in data["rows"])]
    return render(
        "site/policies.html",
        root="",
        data=data,
        best_found=BEST_FOUND,
        interval_text=interval_text,
        groups=present,
        scores=_score_chart(data) if _shown_policies(data) else None,
        shown=data["drives"][_SHOWN_DRIVE],
        drives=drive_chart(lines) if lines else None,
        board=board,
        policies=True,
    )


def _shown_policies(data: Mapping[str, Any]) -> list[str]:
    """Return the policies that charts show: the eight best rows, and the reference."""
    names = [row["policy"] for row in data["rows"] if not row["failure"]]
    return [n for k, n in enumerate(names) if k < 8 or n == data["reference"]]


def _score_chart(data: Mapping[str, Any]) -> Chart:
    """Return the score of each drive: markers of the policies, the best found as a line."""
    rows = {row["policy"]: row for row in data["rows"]}
    traces = []
    for k, name in enumerate(_shown_policies(data)):
        symbol = ("circle", "diamond")[k // 7]  # there are seven colours
        marker = {"size": 9, "color": f"var(--line-{k % 7})", "symbol": symbol}
        look: dict[str, Any] = {"marker": marker}
        if name == BEST_FOUND:
            look = {"line": {"color": QUIET, "width": 2, "shape": "hvh"}}
        trace = {
            "name": name,
            "mode": "lines" if name == BEST_FOUND else "markers",
            "x": [str(i + 1) for i in range(len(data["drives"]))],
            "y": rows[name]["scores"],
            "customdata": data["drives"],
            "hovertemplate": f"{name}: %{{y:.2f}}, %{{customdata}}<extra></extra>",
        }
        traces.append(trace | look)
    axes = {"xaxis": axis("drive", type="category"), "yaxis": axis("score [m²/s⁴]")}
    return chart("Score of each drive", {"": {"data": traces}}, {"height": 420, **axes})
