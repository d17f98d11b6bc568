"""The boards as one HTML file that needs nothing else: tables, drawings and style are inside."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from leaderboard import figures
from leaderboard.board import Board
from leaderboard.findings import NETWORK, UNRELATED, findings, pooled, unrelated_levels
from leaderboard.results import Result, Trace
from leaderboard.scores import NOTHING, SCORES
from leaderboard.sentinels import NOISE
from leaderboard.tasks import Task
from leaderboard.view import Line, Section, filled, views
from road_envs.files import write_text

COMPARED = (NETWORK, "mean", "unrelated_road")
"""Whose numbers stand beside the paper's."""

AXIS = 2.0
"""Error at the right end of the bars that stand for intervals."""


@dataclass(frozen=True)
class Figure:
    """Panels side by side, with what they show in words."""

    panels: Sequence[str]
    caption: str


@dataclass(frozen=True)
class Claims:
    """What the paper says and what was measured: eq. 12, NRMSE and r of each of `names`."""

    names: Sequence[str]
    rows: Sequence[tuple[str, str, list[str]]]  # task, title, cells: the claim, then three a name


@dataclass(frozen=True)
class Case:
    """A task on the page: its rows and its drawings."""

    task: Task
    section: Section
    figures: Sequence[Figure]


def write_page(board: Board, out: Path) -> Path:
    """Write `out`/index.html, whole or not at all, and return its path."""
    path = out / "index.html"
    write_text(path, render(board))
    return path


def render(board: Board) -> str:
    """The page."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("leaderboard"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {"bar": interval_bar, "filled": filled}
    tasks = {task.name: task for task in board.tasks}
    boards = [
        (view, [_case(board, tasks[s.task], s) for s in view.sections]) for view in views(board)
    ]
    return environment.get_template("index.html").render(
        findings=findings(board),
        levels=_levels_figure(board),
        boards=boards,
        claims=claims(board),
        noise=NOISE,
        axis=AXIS,
        provenance=provenance(board),
    )


def interval_bar(line: Line) -> Mapping[str, float] | None:
    """Where mean and interval of a line stand on the bar's axis, in percent; None without them."""
    low, mean, high = (line.values.get(key) for key in ("low", "nrmse", "high"))
    if low is None or mean is None or high is None:
        return None
    at = [100.0 * min(x / AXIS, 1.0) for x in (low, mean, high)]
    return {"low": at[0], "mean": at[1], "width": at[2] - at[0], "one": 100.0 / AXIS}


def claims(board: Board) -> Claims | None:
    """The paper's cases with its numbers and ours side by side; None if none was run."""
    rows = []
    for task in (task for task in board.tasks if task.board == "paper"):
        results = {result.estimator: result for result in board.scored(task)}
        cells = [
            SCORES[score].text(pooled([results[name]], score)) if name in results else NOTHING
            for name in COMPARED
            for score in ("level_error", "nrmse", "r")
        ]
        claim = task.claimed_level_error
        said = NOTHING if claim is None else SCORES["level_error"].text(claim)
        rows.append((task.name, task.title, [said, *cells]))
    return Claims(COMPARED, rows) if rows else None


def provenance(board: Board) -> dict[str, list[tuple[str, str]]]:
    """Where the numbers come from: machines and versions, and the tasks with their digests."""
    shown = [r for task in board.tasks for r in board.scored(task)]
    made = dict.fromkeys(_machine(r) for r in shown)
    return {
        "made": [("Made by", text) for text in made],
        "tasks": [(task.name, _drives(task, board.scored(task))) for task in board.tasks],
    }


def _machine(result: Result) -> str:
    versions = {"roadrecon": result.package_version, "metrics": result.metric_version}
    return ", ".join(f"{name} {value}" for name, value in (versions | result.environment).items())


def _drives(task: Task, results: Sequence[Result]) -> str:
    seeds = max((len(r.seeds) for r in results), default=0)
    return (
        f"version {task.version}, digest {task.digest[:12]}; conditions: {len(task.conditions)}, "
        f"each with {len(task.training.pairs)} training and {len(task.test.pairs)} test drives; "
        f"trainings: {seeds}"
    )


def _case(board: Board, task: Task, section: Section) -> Case:
    order = [line.name for line in section.lines]
    entries = [r for r in board.scored(task) if r.role == "entry"] or board.scored(task)
    entries.sort(key=lambda r: (r.estimator != NETWORK, order.index(r.estimator)))
    drawn = {r.estimator: r for r in entries[: len(figures.SERIES)]}
    if not drawn:
        return Case(task, section, ())
    draw = _paper_figures if task.board == "paper" else _new_road_figures
    return Case(task, section, draw(task, drawn))


def _paper_figures(task: Task, drawn: Mapping[str, Result]) -> list[Figure]:
    """Overlays of both wheel paths, and the densities where the road is random."""
    made = []
    for k, condition in enumerate(task.conditions):
        traces = {name: result.traces[k] for name, result in drawn.items()}
        name, trace = next(iter(traces.items()))
        panels = [figures.overlay(trace, side) for side in range(2)]
        densities = ""
        if not task.bumps:
            panels.append(figures.spectra(traces))
            densities = " Right: densities over the classes of ISO 8608; dotted: the scored band."
        made.append(
            Figure(
                panels,
                f"Truth (solid) and {name} (dashed), {condition.label}; training seed "
                f"{trace.seed}, the one in the middle by in-band error. Heights about their "
                f"median.{densities}",
            )
        )
    return made


def _new_road_figures(task: Task, drawn: Mapping[str, Result]) -> list[Figure]:
    """Left wheel path inside the scored band, entry by entry, and the densities."""
    made = []
    for k, condition in enumerate(task.conditions):
        traces = {name: result.traces[k] for name, result in drawn.items()}
        overlays = [
            figures.band_overlay(trace, 0, name, series)
            for series, (name, trace) in enumerate(traces.items())
        ]
        trace: Trace = next(iter(traces.values()))
        made.append(
            Figure(
                [*overlays, figures.spectra(traces)],
                f"{condition.label}, the first test road ({trace.road}, seed {trace.road_seed}), "
                "left wheel path inside the scored band: truth (solid) and estimate (dashed). "
                "Last: densities of the first 100 m over the classes of ISO 8608; dotted: the "
                "scored band.",
            )
        )
    return made


def _levels_figure(board: Board) -> Figure:
    claims = [t.claimed_level_error for t in board.tasks if t.claimed_level_error is not None]
    errors, _ = unrelated_levels()
    what = f"{errors.size} wheel paths of class {UNRELATED['road_class']}"
    marks = " Upright lines: what the paper reports for its network." if claims else ""
    return Figure(
        [figures.levels(errors, claims)],
        f"Level error (eq. 12) of {what}, {UNRELATED['length']:g} m each, against another road of "
        f"that class: the share of pairs below each error.{marks}",
    )
