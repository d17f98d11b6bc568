"""What a board shows, as plain rows: the terminal, the page and JSON print the same ones.

Scores are interquartile means over roads, conditions and training seeds. Every line carries its
numbers and their printed form; a failed or stale result is a line without scores and a sentence.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from leaderboard.board import Board
from leaderboard.results import Result
from leaderboard.scores import NOTHING, SCORES
from leaderboard.sentinels import NOISE, TRUTH_PLUS_NOISE
from leaderboard.statistics import Interval, interquartile_mean, interval, standings
from leaderboard.tasks import BoardName, Task

State = Literal["scored", "sentinel", "claim", "failed", "stale"]
CLAIM = "paper's claim"


@dataclass(frozen=True)
class Column:
    """One column; a `wide` one is left out where room is short."""

    key: str
    label: str
    unit: str = ""
    wide: bool = False


@dataclass(frozen=True)
class Line:
    """One entry: printed `cells` and the `values` behind them, by column; or a `text` instead."""

    name: str
    state: State
    cells: dict[str, str] = field(default_factory=dict)
    values: dict[str, float | None] = field(default_factory=dict)
    text: str = ""


@dataclass(frozen=True)
class Section:
    """One task: its lines, best first, and what a reader has to know about it.

    On a single road there is no spread over roads, so neither an interval nor a rank.
    """

    task: str
    title: str
    lines: tuple[Line, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class View:
    """One board."""

    board: BoardName
    title: str
    columns: tuple[Column, ...]
    sections: tuple[Section, ...]


PAPER_COLUMNS = (
    Column("level_error_left", "eq. 12 left", "%"),
    Column("level_error_right", "eq. 12 right", "%"),
    Column("level_error", "eq. 12 both", "%"),
    Column("nrmse", "NRMSE"),
    Column("r", "r"),
    Column("bump_f1", "bump F1"),
    Column("bump_height_error", "height error", "mm", wide=True),
    Column("bump_ghosts", "ghosts", wide=True),
    Column("states", "trainings", "<15/15-25/>25 %", wide=True),
    Column("train_seconds", "train", "s", wide=True),
)
NEW_ROAD_COLUMNS = (
    Column("rank", "rank"),
    Column("nrmse", "NRMSE"),
    Column("interval", "95 %"),
    Column("r", "r"),
    Column("level_error", "eq. 12", "%"),
    Column("class_exact", "class", "%"),
    Column("class_within_one", "within one", "%", wide=True),
    Column("iri_error", "IRI", "mm/m"),
    Column("dsd_distance_db", "DSD", "dB", wide=True),
    Column("train_seconds", "train", "s"),
    Column("estimate_ms_per_100m", "time", "ms/100m"),
    Column("parameters", "weights", wide=True),
)


def views(board: Board) -> list[View]:
    """The boards that have a task, the main one first."""
    kinds: list[tuple[BoardName, str, tuple[Column, ...]]] = [
        ("new_road", "New road", NEW_ROAD_COLUMNS),
        ("paper", "The paper's protocol", PAPER_COLUMNS),
    ]
    return [
        View(name, title, columns, tuple(_section(board, task) for task in tasks))
        for name, title, columns in kinds
        if (tasks := [task for task in board.tasks if task.board == name])
    ]


def filled(view: View, *sections: Section) -> list[Column]:
    """The columns in which at least one line of some sections has something to say."""
    lines = [line for section in sections for line in section.lines]
    return [
        column
        for column in view.columns
        if any(line.cells.get(column.key, "") not in ("", NOTHING) for line in lines)
    ]


def _section(board: Board, task: Task) -> Section:
    scored = board.scored(task)
    many = {r.estimator: x for r in scored if len(x := r.values("nrmse")) > 1}
    entries = [r.estimator for r in scored if r.role == "entry"]
    ranks = standings({name: many[name] for name in entries if name in many})
    lines = [_line(r, ranks[r.estimator].rank if r.estimator in ranks else None) for r in scored]
    lines.sort(key=lambda line: (line.state != "scored", _last_if_none(line.values["nrmse"])))
    claim = [_claim(task.claimed_level_error)] if task.claimed_level_error is not None else []
    failed = [Line(r.estimator, "failed", text=r.failure or "") for r in board.failed(task)]
    stale = [Line(r.estimator, "stale", text=why) for r, why in board.stale(task)]
    return Section(
        task.name,
        task.title,
        (*claim, *lines, *failed, *stale),
        (*_protocol(task), *_surface([*scored, *board.failed(task)]), *flags(scored)),
    )


def _line(result: Result, rank: int | None) -> Line:
    error = result.values("nrmse")
    score = interval(error) if len(error) > 1 else Interval(np.nan, np.nan, np.nan)
    values: dict[str, float | None] = {name: _mean(result, name) for name in SCORES}
    values |= {
        "rank": rank,
        "nrmse_low": _number(score.low),
        "nrmse_high": _number(score.high),
        "train_seconds": _number(float(np.mean(result.train_seconds)))
        if result.parameters
        else None,
        "estimate_ms_per_100m": result.estimate_ms_per_100m,
        "parameters": result.parameters or None,
    }
    cells = {name: SCORES[name].text(_nan_if_none(values[name])) for name in SCORES}
    cells |= {
        "rank": str(rank or ""),
        "interval": _range(score),
        "states": _states(result),
        "train_seconds": _digits(values["train_seconds"], 1),
        "estimate_ms_per_100m": _digits(values["estimate_ms_per_100m"], 1),
        "parameters": _digits(values["parameters"], 0),
    }
    state: State = "sentinel" if result.role == "sentinel" else "scored"
    return Line(result.estimator, state, cells, values)


def _claim(level_error: float) -> Line:
    text = SCORES["level_error"].text(level_error)
    return Line(CLAIM, "claim", {"level_error": text}, {"level_error": level_error})


def flags(results: list[Result]) -> list[str]:
    """What is suspicious about scores: entries too good to be true, or a judge out of order."""
    error = {r.estimator: _mean(r, "nrmse") for r in results}
    said = []
    best = error.get(TRUTH_PLUS_NOISE)
    for r in results:
        mine = error[r.estimator]
        if r.role == "entry" and mine is not None and best is not None and mine < best:
            said.append(
                f"{r.estimator} scores better than the truth with {100 * NOISE:g} % noise: "
                "it has seen the truth, or the judge is broken"
            )
    for name, wanted in (("flat", 1.0), (TRUTH_PLUS_NOISE, NOISE)):
        mine = error.get(name)
        if mine is not None and abs(mine - wanted) > 0.1 * wanted:
            said.append(f"the judge is broken: {name} scores {mine:.3f} and not {wanted:g}")
    return said


def _protocol(task: Task) -> list[str]:
    trained = "Trained on altered copies of the test road." if task.trains_on_test_road else ""
    return [text for text in (trained, task.note) if text]


def _surface(results: list[Result]) -> list[str]:
    notes = dict.fromkeys(note for r in results for note in r.notes)
    return [f"Surface: {'; '.join(notes)}."] if notes else []


def _mean(result: Result, score: str) -> float | None:
    """Interquartile mean over everything; None where no drive has the score."""
    values = result.values(score).ravel()
    values = values[np.isfinite(values)]
    return float(interquartile_mean(values)) if values.size else None


def _states(result: Result) -> str:
    """How many trainings were near-optimal, sub-optimal, unstable: Appendix A of the paper."""
    error = 100.0 * result.values("level_error")
    if error.shape[-1] < 2:
        return ""
    near, unstable = int(np.sum(error < 15)), int(np.sum(error > 25))
    return f"{near}/{error.size - near - unstable}/{unstable}"


def _range(score: Interval) -> str:
    return f"{score.low:.2f}–{score.high:.2f}" if np.isfinite(score.low + score.high) else NOTHING


def _digits(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _nan_if_none(value: float | None) -> float:
    return np.nan if value is None else value


def _last_if_none(value: float | None) -> float:
    return np.inf if value is None else value
