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

from leaderboard.conformance.results import EstimatorCard
from leaderboard.evaluation.results import Result
from leaderboard.evaluation.tasks import BoardName, Task
from leaderboard.metrics.baselines import NOISE_LEVEL, TRUTH_PLUS_NOISE
from leaderboard.metrics.bootstrap import (
    Interval,
    interquartile_mean,
    iqm_interval,
    iqm_slope,
    rank_entries,
)
from leaderboard.metrics.registry import SCORES, UNDEFINED
from leaderboard.report.board_definitions import BOARDS, COLUMN_FORMATS, BoardDefinition, Column
from leaderboard.running.board import Board
from road_envs.vehicle.perturbed_vehicle import GRADES

RowState = Literal["scored", "baseline", "claim", "failed", "stale"]
CLAIM_ROW = "paper's claim"
EQ_12_RAW = "level_error_raw"
"""The score that is the paper's equation 12 as printed."""

TRAINING_STATES = ("near_optimal", "sub_optimal", "unstable")
BOUND_ROW = "bound"
"""Name of the line that says what the sensors allow."""

ALL_RUNS = ""
"""Name of the group that holds every run."""

SPECTRUM_SCORES = tuple(name for name in SCORES if name.startswith("error_at_"))
"""The scores that tell the error over spatial frequency."""

ScoreSlice = tuple[list[int] | slice, list[int] | slice]
"""Which roads and which conditions of scores (R, C, S)."""

ALL_SCORES: ScoreSlice = (slice(None), slice(None))
GroupValues = dict[str, dict[str, float | None]]
"""Numbers by group and score."""


@dataclass(frozen=True)
class Row:
    """One entry: printed `cells` and the `values` behind them, by column; or a `text` instead.

    `groups` has the values again over each condition and each family of roads, by its name.
    """

    name: str
    state: RowState
    cells: dict[str, str] = field(default_factory=dict)
    values: dict[str, float | None] = field(default_factory=dict)
    message: str = ""
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
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]
    conditions: tuple[str, ...] = ()


@dataclass(frozen=True)
class BoardView:
    """One board."""

    board: BoardName
    definition: BoardDefinition
    sections: tuple[Section, ...]


def board_views(board: Board) -> list[BoardView]:
    """The boards that have a task, the main one first."""
    return [
        BoardView(name, definition, tuple(_section(board, task, definition) for task in tasks))
        for name, definition in BOARDS.items()
        if (tasks := [task for task in board.tasks if task.board == name])
    ]


def nonempty_columns(view: BoardView, *sections: Section) -> list[Column]:
    """The columns in which at least one line of some sections has something to say."""
    rows = [row for section in sections for row in section.rows]
    return [
        column
        for column in view.definition.columns
        if any(row.cells.get(column.key, "") not in ("", UNDEFINED) for row in rows)
    ]


def run_groups(task: Task) -> dict[str, dict[str, ScoreSlice]]:
    """Conditions and families of a task, each with its part of the scores: roads, conditions.

    A kind of which there is one only is left out.
    """
    every = slice(None)
    conditions: dict[str, ScoreSlice] = {
        c.label: (every, slice(k, k + 1)) for k, c in enumerate(task.conditions)
    }
    families: dict[str, ScoreSlice] = {
        family: (task.test.indices_of_family(family), every)
        for family in dict.fromkeys(task.test.families)
    }
    grades: dict[str, ScoreSlice] = {
        f"car {grade}": (every, [k for k, c in enumerate(task.conditions) if c.grade == grade])
        for grade in dict.fromkeys(c.grade for c in task.conditions)
    }
    kinds = {"condition": conditions, "family": families, "car": grades}
    return {kind: parts for kind, parts in kinds.items() if len(parts) > 1}


def _section(board: Board, task: Task, definition: BoardDefinition) -> Section:
    groups = run_groups(task)
    parts = {name: part for parts in groups.values() for name, part in parts.items()}
    scored = board.scored(task)
    tables = [_aggregate(result, definition, parts) for result in scored]
    values = {table.name: table.values for table in tables}
    _rank(tables, parts, values)
    rows = [
        _scored_row(r, x, definition, board.card(r)) for r, x in zip(scored, tables, strict=True)
    ] + _bound_rows(values, definition)
    rows.sort(
        key=lambda row: (row.state != "scored", _inf_if_none(row.values[definition.ranks_by]))
    )
    claim = [_claim_row(task.claimed_level_error)] if task.claimed_level_error is not None else []
    failed = [Row(r.estimator, "failed", message=r.failure or "") for r in board.failed(task)]
    stale = [Row(r.estimator, "stale", message=why) for r, why in board.stale(task)]
    return Section(
        task.name,
        task.title,
        (*claim, *rows, *failed, *stale),
        (
            *_protocol_notes(task, scored),
            *_surface_notes(task, [*scored, *board.failed(task)]),
            *sanity_warnings(rows),
        ),
        {kind_of_group: tuple(named) for kind_of_group, named in groups.items()},
        tuple(condition.label for condition in task.conditions),
    )


class AggregatedScores(NamedTuple):
    """The numbers of a result: `values` by group and score; `ranked` (R, C, S) is what ranks."""

    name: str
    values: GroupValues
    ranked: np.ndarray
    division: tuple[bool, bool]  # ranked among all, among the causal


def _aggregate(
    result: Result, definition: BoardDefinition, parts: Mapping[str, ScoreSlice]
) -> AggregatedScores:
    """The numbers of a result over every run and over each group of runs; its drives read once."""
    scores = score_arrays(result)
    shown = (
        {c.key for c in definition.columns}
        | {definition.ranks_by, "bound_nrmse"}
        | set(SPECTRUM_SCORES)
    )
    values: GroupValues = {ALL_RUNS: {name: _mean(scores.get(name)) for name in SCORES}}
    for group, part in parts.items():
        values[group] = {name: _mean(x[part]) for name, x in scores.items() if name in shown}
    ranked = scores[definition.ranks_by]
    for group, part in {ALL_RUNS: ALL_SCORES, **parts}.items():
        mine = ranked[part]
        score = iqm_interval(mine) if len(mine) > 1 else Interval(np.nan, np.nan, np.nan)
        values[group] |= {"low": _finite_or_none(score.low), "high": _finite_or_none(score.high)}
    values[ALL_RUNS] |= {
        "train_seconds": _finite_or_none(float(np.mean(result.train_seconds)))
        if result.parameters
        else None,
        "estimate_ms_per_100m": result.estimate_ms_per_100m,
        "parameters": result.parameters or None,
        **_training_states(scores),
        **_grade_scores(ranked, parts),
    }
    entry = result.role == "entry"
    division = entry, entry and bool(result.causal)
    return AggregatedScores(result.estimator, values, ranked, division)


def _grade_scores(ranked: np.ndarray, parts: Mapping[str, ScoreSlice]) -> dict[str, float | None]:
    """The ranking score on each car, and how fast it grows from one to the next."""
    found = {grade: ranked[parts[f"car {grade}"]] for grade in GRADES if f"car {grade}" in parts}
    if len(found) < 2:
        return {}
    values = {f"grade_{grade}": _mean(x) for grade, x in found.items()}
    if len(ranked) < 2:
        return values
    growth = iqm_slope(list(found.values()))
    told = {"slope": growth.mean, "slope_low": growth.low, "slope_high": growth.high}
    return values | {name: _finite_or_none(x) for name, x in told.items()}


def score_arrays(result: Result) -> dict[str, np.ndarray]:
    """Return every score of a result as (R, C, S) (roads, conditions, seeds), NaN if undefined."""
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


def _rank(
    tables: Sequence[AggregatedScores],
    parts: Mapping[str, ScoreSlice],
    values: Mapping[str, GroupValues],
) -> None:
    """Write into `values` where each entry stands in every group, among all and among the causal.

    There is no rank on a single road.
    """
    for group, part in {ALL_RUNS: ALL_SCORES, **parts}.items():
        for k, key in enumerate(("rank", "rank_causal")):
            scores = {x.name: x.ranked[part] for x in tables if x.division[k]}
            spread = {name: x for name, x in scores.items() if len(x) > 1}
            for name, rank in rank_entries(spread).items():
                values[name][group][key] = rank.rank


def _scored_row(
    result: Result, table: AggregatedScores, definition: BoardDefinition, card: EstimatorCard | None
) -> Row:
    mine = table.values[ALL_RUNS]
    cells = {
        name: COLUMN_FORMATS[name].format_value(_nan_if_none(x))
        for name, x in mine.items()
        if name in COLUMN_FORMATS
    }
    cells |= {
        "slope_interval": interval_text(mine.get("slope_low"), mine.get("slope_high"), "slope"),
        "rank": _format_number(mine.get("rank"), 0),
        "rank_causal": _format_number(mine.get("rank_causal"), 0),
        "interval": interval_text(mine["low"], mine["high"], definition.ranks_by),
        "states": _states_text(mine),
        "train_seconds": _format_number(mine["train_seconds"], 1),
        "estimate_ms_per_100m": _format_number(mine["estimate_ms_per_100m"], 1),
        "parameters": _format_number(mine["parameters"], 0),
        "probes": card.passed_count if card else "",
    }
    state: RowState = "baseline" if result.role == "sentinel" else "scored"
    groups = {name: x for name, x in table.values.items() if name != ALL_RUNS}
    return Row(result.estimator, state, cells, mine, causal=result.causal, groups=groups)


def _bound_rows(values: Mapping[str, GroupValues], definition: BoardDefinition) -> list[Row]:
    """The bound as a line of its own, where it was computed and NRMSE ranks."""
    told = [v for v in values.values() if v[ALL_RUNS].get("bound_nrmse") is not None]
    if not told or definition.ranks_by != "nrmse":
        return []
    groups = {group: {"nrmse": x.get("bound_nrmse")} for group, x in told[0].items()}
    mine = groups.pop(ALL_RUNS)
    cells = {"nrmse": SCORES["bound_nrmse"].format_value(_nan_if_none(mine["nrmse"]))}
    return [Row(BOUND_ROW, "baseline", cells, mine, groups=groups)]


def _claim_row(level_error: float) -> Row:
    text = SCORES[EQ_12_RAW].format_value(level_error)
    return Row(CLAIM_ROW, "claim", {EQ_12_RAW: text}, {EQ_12_RAW: level_error})


def sanity_warnings(rows: Sequence[Row]) -> list[str]:
    """What is suspicious about scores: entries too good to be true, or a judge out of order."""
    error = {row.name: row.values.get("nrmse") for row in rows}
    said = []
    best = error.get(TRUTH_PLUS_NOISE)
    for row in rows:
        mine = error[row.name]
        if row.state == "scored" and mine is not None and best is not None and mine < best:
            said.append(
                f"{row.name} scores better than the truth with {100 * NOISE_LEVEL:g} % noise: "
                "it has seen the truth, or the judge is broken"
            )
    for name, wanted in (("flat", 1.0), (TRUTH_PLUS_NOISE, NOISE_LEVEL)):
        mine = error.get(name)
        if mine is not None and abs(mine - wanted) > 0.1 * wanted:
            said.append(f"the judge is broken: {name} scores {mine:.3f} and not {wanted:g}")
    return said


def _protocol_notes(task: Task, results: Sequence[Result]) -> list[str]:
    trained, brought = "", [r.estimator for r in results if r.settings.get("shipped")]
    if task.trains_on_test_road:
        trained = "Trained on altered copies of the test road"
        trained += f"; {', '.join(brought)} with the weights brought along." if brought else "."
    return [text for text in (trained, task.note) if text]


def _surface_notes(task: Task, results: list[Result]) -> list[str]:
    """What was done to a surface from a file."""
    notes = dict.fromkeys(note for r in results for note in r.notes)
    return [f"Surface: {'; '.join(notes)}."] if notes and task.board == "measured" else []


def _mean(scores: np.ndarray | None) -> float | None:
    """Interquartile mean; None where no run has the score."""
    if scores is None:
        return None
    values = scores[np.isfinite(scores)]
    return float(interquartile_mean(values)) if values.size else None


def _training_states(scores: Mapping[str, np.ndarray]) -> dict[str, float | None]:
    """How many runs were near-optimal, sub-optimal, unstable: Appendix A of the paper."""
    error = scores[EQ_12_RAW]
    if error.shape[-1] < 2:
        return {}
    near, unstable = int(np.sum(error < 0.15)), int(np.sum(error > 0.25))
    counts = (near, error.size - near - unstable, unstable)
    return dict(zip(TRAINING_STATES, map(float, counts), strict=True))


def _states_text(values: Mapping[str, float | None]) -> str:
    return "/".join(_format_number(values[name], 0) for name in TRAINING_STATES if name in values)


def interval_text(low: float | None, high: float | None, score: str) -> str:
    """An interval of a score as printed."""
    if low is None or high is None:
        return UNDEFINED
    return "–".join(COLUMN_FORMATS[score].format_value(x) for x in (low, high))


def _format_number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _finite_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _nan_if_none(value: float | None) -> float:
    return np.nan if value is None else value


def _inf_if_none(value: float | None) -> float:
    return np.inf if value is None else value
