"""What a board shows, as plain rows: the terminal, the page and JSON print the same ones.

Scores are interquartile means over roads, conditions and training seeds, and again over each
condition and each family of roads alone. Every line carries its numbers and their printed form; a
failed or stale result is a line without scores and a sentence. An entry stands in the causal
division or in the offline one; ranks are given among all entries and among the causal ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from leaderboard.conformance.results import Card
from leaderboard.evaluation.results import Result
from leaderboard.evaluation.tasks import BoardName, Task
from leaderboard.metrics.baselines import NOISE, TRUTH_PLUS_NOISE
from leaderboard.metrics.bootstrap import Interval, interquartile_mean, interval, slope, standings
from leaderboard.metrics.registry import NOTHING, SCORES
from leaderboard.report.board_definitions import BOARDS, FORMS, Column, Kind
from leaderboard.running.board import Board
from road_envs.vehicle.perturbed_vehicle import GRADES

State = Literal["scored", "sentinel", "claim", "failed", "stale"]
CLAIM = "paper's claim"
PRINTED = "level_error_raw"
"""The score that is the paper's equation 12 as printed."""

TRAININGS = ("near_optimal", "sub_optimal", "unstable")
BOUND = "bound"
"""Name of the line that says what the sensors allow."""

ALL = ""
"""Name of the group that holds every run."""

SPECTRUM = tuple(name for name in SCORES if name.startswith("error_at_"))
"""The scores that tell the error over spatial frequency."""

Part = tuple[list[int] | slice, list[int] | slice]
"""Which roads and which conditions of scores (R, C, S)."""

EVERY: Part = (slice(None), slice(None))
Values = dict[str, dict[str, float | None]]
"""Numbers by group and score."""


@dataclass(frozen=True)
class Line:
    """One entry: printed `cells` and the `values` behind them, by column; or a `text` instead.

    `groups` has the values again over each condition and each family of roads, by its name.
    """

    name: str
    state: State
    cells: dict[str, str] = field(default_factory=dict)
    values: dict[str, float | None] = field(default_factory=dict)
    text: str = ""
    causal: bool | None = None
    groups: dict[str, dict[str, float | None]] = field(default_factory=dict)


@dataclass(frozen=True)
class Section:
    """One task: its lines, best first, and what a reader has to know about it.

    On a single road there is no spread over roads, so neither an interval nor a rank. `groups`
    names conditions and families, as far as there is more than one of a kind.
    """

    task: str
    title: str
    lines: tuple[Line, ...]
    notes: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]
    conditions: tuple[str, ...] = ()


@dataclass(frozen=True)
class View:
    """One board."""

    board: BoardName
    kind: Kind
    sections: tuple[Section, ...]


def views(board: Board) -> list[View]:
    """The boards that have a task, the main one first."""
    return [
        View(name, kind, tuple(_section(board, task, kind) for task in tasks))
        for name, kind in BOARDS.items()
        if (tasks := [task for task in board.tasks if task.board == name])
    ]


def filled(view: View, *sections: Section) -> list[Column]:
    """The columns in which at least one line of some sections has something to say."""
    lines = [line for section in sections for line in section.lines]
    return [
        column
        for column in view.kind.columns
        if any(line.cells.get(column.key, "") not in ("", NOTHING) for line in lines)
    ]


def groups_of(task: Task) -> dict[str, dict[str, Part]]:
    """Conditions and families of a task, each with its part of the scores: roads, conditions.

    A kind of which there is one only is left out.
    """
    every = slice(None)
    conditions: dict[str, Part] = {
        c.label: (every, slice(k, k + 1)) for k, c in enumerate(task.conditions)
    }
    families: dict[str, Part] = {
        family: (task.test.drives_of(family), every) for family in dict.fromkeys(task.test.families)
    }
    grades: dict[str, Part] = {
        f"car {grade}": (every, [k for k, c in enumerate(task.conditions) if c.grade == grade])
        for grade in dict.fromkeys(c.grade for c in task.conditions)
    }
    kinds = {"condition": conditions, "family": families, "car": grades}
    return {kind: parts for kind, parts in kinds.items() if len(parts) > 1}


def _section(board: Board, task: Task, kind: Kind) -> Section:
    groups = groups_of(task)
    parts = {name: part for parts in groups.values() for name, part in parts.items()}
    scored = board.scored(task)
    tables = [_table(result, kind, parts) for result in scored]
    values = {table.name: table.values for table in tables}
    _rank(tables, parts, values)
    lines = [
        _line(r, x, kind, board.card(r)) for r, x in zip(scored, tables, strict=True)
    ] + _bound(values, kind)
    lines.sort(key=lambda line: (line.state != "scored", _last_if_none(line.values[kind.ranks_by])))
    claim = [_claim(task.claimed_level_error)] if task.claimed_level_error is not None else []
    failed = [Line(r.estimator, "failed", text=r.failure or "") for r in board.failed(task)]
    stale = [Line(r.estimator, "stale", text=why) for r, why in board.stale(task)]
    return Section(
        task.name,
        task.title,
        (*claim, *lines, *failed, *stale),
        (*_protocol(task, scored), *_surface(task, [*scored, *board.failed(task)]), *flags(lines)),
        {kind_of_group: tuple(named) for kind_of_group, named in groups.items()},
        tuple(condition.label for condition in task.conditions),
    )


class Table(NamedTuple):
    """The numbers of a result: `values` by group and score; `ranked` (R, C, S) is what ranks."""

    name: str
    values: Values
    ranked: np.ndarray
    division: tuple[bool, bool]  # ranked among all, among the causal


def _table(result: Result, kind: Kind, parts: Mapping[str, Part]) -> Table:
    """The numbers of a result over every run and over each group of runs; its drives read once."""
    scores = arrays(result)
    shown = {c.key for c in kind.columns} | {kind.ranks_by, "bound_nrmse"} | set(SPECTRUM)
    values: Values = {ALL: {name: _mean(scores.get(name)) for name in SCORES}}
    for group, part in parts.items():
        values[group] = {name: _mean(x[part]) for name, x in scores.items() if name in shown}
    ranked = scores[kind.ranks_by]
    for group, part in {ALL: EVERY, **parts}.items():
        mine = ranked[part]
        score = interval(mine) if len(mine) > 1 else Interval(np.nan, np.nan, np.nan)
        values[group] |= {"low": _number(score.low), "high": _number(score.high)}
    values[ALL] |= {
        "train_seconds": _number(float(np.mean(result.train_seconds)))
        if result.parameters
        else None,
        "estimate_ms_per_100m": result.estimate_ms_per_100m,
        "parameters": result.parameters or None,
        **_trainings(scores),
        **_over_grades(ranked, parts),
    }
    entry = result.role == "entry"
    division = entry, entry and bool(result.causal)
    return Table(result.estimator, values, ranked, division)


def _over_grades(ranked: np.ndarray, parts: Mapping[str, Part]) -> dict[str, float | None]:
    """The ranking score on each car, and how fast it grows from one to the next."""
    found = {grade: ranked[parts[f"car {grade}"]] for grade in GRADES if f"car {grade}" in parts}
    if len(found) < 2:
        return {}
    values = {f"grade_{grade}": _mean(x) for grade, x in found.items()}
    if len(ranked) < 2:
        return values
    growth = slope(list(found.values()))
    told = {"slope": growth.mean, "slope_low": growth.low, "slope_high": growth.high}
    return values | {name: _number(x) for name, x in told.items()}


def arrays(result: Result) -> dict[str, np.ndarray]:
    """Every score of a result as (R, C, S): roads, conditions, seeds; NaN where it is not defined."""
    places = [(d.drive, d.condition, d.seed) for d in result.drives]
    axes = [
        {name: k for k, name in enumerate(dict.fromkeys(axis))}
        for axis in zip(*places, strict=True)
    ]
    shape = tuple(map(len, axes))
    found = {name: np.full(shape, np.nan) for name in SCORES}
    for place, drive in zip(places, result.drives, strict=True):
        at = tuple(axis[name] for axis, name in zip(axes, place, strict=True))
        for name, value in drive.scores.items():
            found[name][at] = value
    return found


def _rank(tables: Sequence[Table], parts: Mapping[str, Part], values: Mapping[str, Values]) -> None:
    """Write into `values` where each entry stands in every group, among all and among the causal.

    There is no rank on a single road.
    """
    for group, part in {ALL: EVERY, **parts}.items():
        for k, key in enumerate(("rank", "rank_causal")):
            scores = {x.name: x.ranked[part] for x in tables if x.division[k]}
            spread = {name: x for name, x in scores.items() if len(x) > 1}
            for name, standing in standings(spread).items():
                values[name][group][key] = standing.rank


def _line(result: Result, table: Table, kind: Kind, card: Card | None) -> Line:
    mine = table.values[ALL]
    cells = {name: FORMS[name].text(_nan_if_none(x)) for name, x in mine.items() if name in FORMS}
    cells |= {
        "slope_interval": interval_text(mine.get("slope_low"), mine.get("slope_high"), "slope"),
        "rank": _digits(mine.get("rank"), 0),
        "rank_causal": _digits(mine.get("rank_causal"), 0),
        "interval": interval_text(mine["low"], mine["high"], kind.ranks_by),
        "states": _states(mine),
        "train_seconds": _digits(mine["train_seconds"], 1),
        "estimate_ms_per_100m": _digits(mine["estimate_ms_per_100m"], 1),
        "parameters": _digits(mine["parameters"], 0),
        "probes": card.mark if card else "",
    }
    state: State = "sentinel" if result.role == "sentinel" else "scored"
    groups = {name: x for name, x in table.values.items() if name != ALL}
    return Line(result.estimator, state, cells, mine, causal=result.causal, groups=groups)


def _bound(values: Mapping[str, Values], kind: Kind) -> list[Line]:
    """The bound as a line of its own, where it was computed and NRMSE ranks."""
    told = [v for v in values.values() if v[ALL].get("bound_nrmse") is not None]
    if not told or kind.ranks_by != "nrmse":
        return []
    groups = {group: {"nrmse": x.get("bound_nrmse")} for group, x in told[0].items()}
    mine = groups.pop(ALL)
    cells = {"nrmse": SCORES["bound_nrmse"].text(_nan_if_none(mine["nrmse"]))}
    return [Line(BOUND, "sentinel", cells, mine, groups=groups)]


def _claim(level_error: float) -> Line:
    text = SCORES[PRINTED].text(level_error)
    return Line(CLAIM, "claim", {PRINTED: text}, {PRINTED: level_error})


def flags(lines: Sequence[Line]) -> list[str]:
    """What is suspicious about scores: entries too good to be true, or a judge out of order."""
    error = {line.name: line.values.get("nrmse") for line in lines}
    said = []
    best = error.get(TRUTH_PLUS_NOISE)
    for line in lines:
        mine = error[line.name]
        if line.state == "scored" and mine is not None and best is not None and mine < best:
            said.append(
                f"{line.name} scores better than the truth with {100 * NOISE:g} % noise: "
                "it has seen the truth, or the judge is broken"
            )
    for name, wanted in (("flat", 1.0), (TRUTH_PLUS_NOISE, NOISE)):
        mine = error.get(name)
        if mine is not None and abs(mine - wanted) > 0.1 * wanted:
            said.append(f"the judge is broken: {name} scores {mine:.3f} and not {wanted:g}")
    return said


def _protocol(task: Task, results: Sequence[Result]) -> list[str]:
    trained, brought = "", [r.estimator for r in results if r.settings.get("shipped")]
    if task.trains_on_test_road:
        trained = "Trained on altered copies of the test road"
        trained += f"; {', '.join(brought)} with the weights brought along." if brought else "."
    return [text for text in (trained, task.note) if text]


def _surface(task: Task, results: list[Result]) -> list[str]:
    """What was done to a surface from a file."""
    notes = dict.fromkeys(note for r in results for note in r.notes)
    return [f"Surface: {'; '.join(notes)}."] if notes and task.board == "measured" else []


def _mean(scores: np.ndarray | None) -> float | None:
    """Interquartile mean; None where no run has the score."""
    if scores is None:
        return None
    values = scores[np.isfinite(scores)]
    return float(interquartile_mean(values)) if values.size else None


def _trainings(scores: Mapping[str, np.ndarray]) -> dict[str, float | None]:
    """How many runs were near-optimal, sub-optimal, unstable: Appendix A of the paper."""
    error = scores[PRINTED]
    if error.shape[-1] < 2:
        return {}
    near, unstable = int(np.sum(error < 0.15)), int(np.sum(error > 0.25))
    counts = (near, error.size - near - unstable, unstable)
    return dict(zip(TRAININGS, map(float, counts), strict=True))


def _states(values: Mapping[str, float | None]) -> str:
    return "/".join(_digits(values[name], 0) for name in TRAININGS if name in values)


def interval_text(low: float | None, high: float | None, score: str) -> str:
    """An interval of a score as printed."""
    if low is None or high is None:
        return NOTHING
    return "–".join(FORMS[score].text(x) for x in (low, high))


def _digits(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _nan_if_none(value: float | None) -> float:
    return np.nan if value is None else value


def _last_if_none(value: float | None) -> float:
    return np.inf if value is None else value
