"""Rows of the boards, as plain data for the terminal, the pages and the exports.

Scores are interquartile means over roads, conditions and training seeds, and again over each
condition and each family of roads alone. Ranks are given among all entries (offline division) and
among the causal ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from estimators import REGISTRY
from leaderboard.conformance.probes import count_passed
from leaderboard.conformance.results import EstimatorCard
from leaderboard.evaluation.boards import BoardDefinition
from leaderboard.evaluation.results import Result, score_arrays
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics import UNDEFINED, bootstrap
from leaderboard.metrics.api import Metric
from leaderboard.metrics.bootstrap import MIN_ROADS, Interval, Strata, count_roads
from leaderboard.metrics.level import EQ_12_RAW, STATE_LIMITS
from leaderboard.metrics.registry import SCORES
from leaderboard.report import board_definitions as boards
from leaderboard.report.notes import has_public_roads, section_notes
from leaderboard.report.run_groups import ScoreSlice, run_groups
from leaderboard.running.board import Board
from road_envs.sensing.perturbed_vehicle import GRADES

_RowState = Literal["scored", "baseline", "claim", "failed", "stale"]
TRAINING_STATES = ("near_optimal", "sub_optimal", "unstable")
ALL_RUNS = ""  # name of the group of all runs
SPECTRUM_SCORES = tuple(name for name in SCORES if name.startswith("error_at_"))  # third octaves
_Values = dict[str, float | None]  # numbers by column; None where one is undefined
_LIMITS = ("bound_nrmse", "attainable_nrmse")
_BOUNDED = [[*SCORES].index(name) for name in ("nrmse", "bound_nrmse")]  # the error and its bound
_OF_DEVIATIONS = np.array([name.startswith(("crps", "coverage_")) for name in SCORES])


@dataclass(frozen=True)
class Row:
    """One entry: `cells` (text) and `values` by column, over all runs and, in `groups`, over each
    group by name, or a `message` instead.
    """

    name: str
    state: _RowState
    cells: dict[str, str] = field(default_factory=dict)
    values: _Values = field(default_factory=dict)
    message: str = ""
    causal: bool | None = None
    groups: dict[str, _Values] = field(default_factory=dict)


@dataclass(frozen=True)
class Section:
    """The rows of one task, best first, with notes for the reader. `groups` names conditions,
    families and others by kind if there is more than one.
    """

    task: Task
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    groups: Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class BoardView:
    """The tables of one board, a section for each of its tasks."""

    board: str
    definition: BoardDefinition
    sections: tuple[Section, ...]


def board_views(board: Board) -> list[BoardView]:
    """Return the boards that have a task: of roads that are not public first, then the main one."""
    definitions = {task.board_name: task.board_definition for task in board.tasks}
    sealed = {task.board_name for task in board.tasks if not has_public_roads(task)}
    ordered = sorted(definitions.items(), key=lambda item: (item[0] not in sealed, item[1].order))
    of_board = {name: [x for x in board.tasks if x.board_name == name] for name in definitions}
    return [
        BoardView(name, own, tuple(_section(board, task) for task in of_board[name]))
        for name, own in ordered
    ]


def nonempty_columns(view: BoardView, *sections: Section) -> list[Metric]:
    """Return the columns in which at least one row of the sections has a value."""
    cells = [item for section in sections for row in section.rows for item in row.cells.items()]
    shown = {key for key, text in cells if text not in ("", UNDEFINED)}
    return [x for x in boards.board_columns(view.board, view.definition) if x.key in shown]


def _section(board: Board, task: Task) -> Section:
    groups, definition = run_groups(task), task.board_definition
    parts: dict[str, ScoreSlice] = {ALL_RUNS: (slice(None), slice(None))}
    parts |= {name: part for named in groups.values() for name, part in named.items()}
    scored = board.scored(task)
    on_level = level_runs(scored, definition)
    tables = [_aggregate(result, task, parts, on_level) for result in scored]
    _rank(tables, task, parts)
    rows = [_scored_row(x, definition, board.card(x.result)) for x in tables]

    def place(row: Row) -> tuple[bool, bool, float, float]:
        rank = row.values.get(boards.rank_column(definition))
        score = row.values[definition.ranks_by]
        outside = row.state != "scored", not is_ranked(row, definition)
        return *outside, rank or np.inf, np.inf if score is None else score

    rows = sorted(rows + _bound_rows(tables, definition), key=place)
    claim = []
    if (level := task.claimed_level_error) is not None:
        text = SCORES[EQ_12_RAW].format_value(level)
        claim = [Row("paper's claim", "claim", {EQ_12_RAW: text}, {EQ_12_RAW: level})]
    failed = [Row(r.estimator, "failed", message=r.failure or "") for r in board.failed(task)]
    stale = [Row(r.estimator, "stale", message=why) for r, why in board.stale(task)]
    notes = section_notes(board, task, rows, int(np.sum(on_level)), training_counts(scored))
    names = {kind: tuple(named) for kind, named in groups.items()}
    return Section(task, (*claim, *rows, *failed, *stale), notes, names)


def is_ranked(row: Row, definition: BoardDefinition) -> bool:
    """Return whether a row is of an entry that its board orders."""
    return row.state == "scored" and (bool(row.causal) or boards.ranked_kind(definition) == "entry")


class _Averages(NamedTuple):  # by group and score; `ranked` (R, C, S) has the ranking score
    result: Result
    values: dict[str, _Values]
    ranked: np.ndarray


def _aggregate(
    result: Result, task: Task, parts: Mapping[str, ScoreSlice], on_level: np.ndarray
) -> _Averages:
    """Average the scores of a result over all runs and each group. Runs `on_level` (R, C) roads
    have no ranking score, which counts against nobody; who lacks it elsewhere has none at all.
    """
    scores, strata = score_arrays(result.scores), task.test.strata
    definition = task.board_definition
    shown = {*definition.columns, *definition.on_request, definition.ranks_by}
    shown |= {*SPECTRUM_SCORES, *_LIMITS}
    ranked = scores[[*SCORES].index(definition.ranks_by)]
    missing = np.isnan(scores) & np.isfinite(scores).any(axis=0) & ~on_level[:, :, None]
    is_unranked = missing[[*SCORES].index(definition.ranks_by)].any()
    ranked[on_level | is_unranked] = np.nan  # a mean of other drives than those of its neighbours
    scores[_OF_DEVIATIONS & missing.any(axis=(1, 2, 3))] = np.nan  # else given where they fit
    values: dict[str, _Values] = {}
    for group, part in parts.items():
        mine, own = scores[:, *part], ranked[part]
        means = dict(zip(SCORES, _mean(mine), strict=True)) | _unknown_limits(mine)
        score = Interval(np.nan, np.nan, np.nan)
        if count_roads(own) >= MIN_ROADS:
            score = bootstrap.iqm_interval(own, strata=strata if group == ALL_RUNS else None)
        error, bound = mine[_BOUNDED]
        known = np.isfinite(error) & np.isfinite(bound)
        below = np.mean(error[known] < bound[known]) if known.any() else None
        values[group] = _defined(
            {name: x for name, x in means.items() if group == ALL_RUNS or name in shown}
            | {"low": score.low, "high": score.high, **_tail(own), boards.BELOW_BOUND: below}
        )
    values[ALL_RUNS] |= {
        "train_seconds": train_seconds(result),
        "estimate_ms_per_100m": result.estimate_ms_per_100m,
        "calibrate_seconds": result.calibrate_seconds,
        "parameters": result.parameters or None,
        **_training_states(scores[[*SCORES].index(EQ_12_RAW)]),
        **_grade_scores(ranked, parts, strata),
    }
    return _Averages(result, values, ranked)


def level_runs(scored: Sequence[Result], definition: BoardDefinition) -> np.ndarray:
    """Return which runs (R, C) of all rows have no ranking score, or no NRMSE and that score in
    some rows alone: over a level road ratios are defined for an estimate that is wrong.
    """
    if not scored:
        return np.zeros((0, 0), dtype=bool)
    defined = np.array([np.isfinite(score_arrays(x.scores)).any(axis=-1) for x in scored])
    ranked, error = (defined[:, [*SCORES].index(key)] for key in (definition.ranks_by, "nrmse"))
    counts = ranked.all(axis=0) | ranked.any(axis=0) & error.any(axis=0)
    return np.logical_and(defined.any(axis=1).all(axis=0), ~counts)


def train_seconds(result: Result) -> float | None:
    """Return the mean time [s] of a training; None if it left no parameters within 0.05 s."""
    seconds = float(np.mean(result.train_seconds)) if result.train_seconds else 0.0
    return seconds if result.parameters or seconds > 0.05 else None


def training_counts(results: Sequence[Result]) -> dict[str, int]:
    """Return the number of training seeds by estimator, of those whose training depends on them:
    not of one that was asked for several and has the runs of one.
    """
    return {
        result.estimator: len(result.seeds)
        for result in results
        if train_seconds(result) is not None
        and not (result.estimator in REGISTRY and result.settings.get("shipped"))
        and (len(result.seeds) == 1 or result.scores["seed"].nunique() > 1)
    }


def _tail(ranked: np.ndarray) -> dict[str, float | None]:
    """Worst drive, of MIN_ROADS roads or more, and shares of drives above each limit."""
    runs = ranked[~np.isnan(ranked)]
    if not runs.size:
        return dict.fromkeys([boards.WORST, *boards.TAIL])
    shares = {name: float(np.mean(runs > limit)) for name, limit in boards.TAIL.items()}
    worst = float(runs.max()) if count_roads(ranked) >= MIN_ROADS else None
    return {boards.WORST: worst, **shares}


def _grade_scores(ranked: np.ndarray, parts: Mapping[str, ScoreSlice], strata: Strata) -> _Values:
    """Return the ranking score on each grade of car, and its slope over the grades."""
    by_grade = {grade: ranked[parts[f"car {grade}"]] for grade in GRADES if f"car {grade}" in parts}
    if len(by_grade) < 2:
        return {}
    values = {f"grade_{grade}": _mean(x[None])[0] for grade, x in by_grade.items()}
    if count_roads(ranked) >= MIN_ROADS:
        whole = all(len(x) == len(ranked) for x in by_grade.values())  # else strata are of others
        graded = {GRADES.index(grade): x for grade, x in by_grade.items()}
        growth = bootstrap.iqm_slope(graded, strata=strata if whole else None)
        values |= {"slope": growth.mean, "slope_low": growth.low, "slope_high": growth.high}
    return _defined(values)


def _rank(tables: Sequence[_Averages], task: Task, parts: Mapping[str, ScoreSlice]) -> None:
    """Add the ranks in every group of MIN_ROADS roads, among all entries and the causal ones, or
    among these alone if the board has no other division; none to an entry without the score there.
    """
    by_name = {x.result.estimator: x for x in tables if x.result.role == "entry"}
    causal = {name: x for name, x in by_name.items() if x.result.causal}
    divisions = {"offline": by_name, "causal": causal}
    if {*task.board_definition.divisions} == {"causal"}:
        del divisions["offline"]
    for group, part in parts.items():
        for division, entries in divisions.items():
            every = {name: x.ranked[part] for name, x in entries.items()}
            scores = {name: x for name, x in every.items() if count_roads(x) >= MIN_ROADS}
            within = task.test.strata if group == ALL_RUNS else None
            for name, rank in bootstrap.rank_entries(scores, strata=within).items():
                by_name[name].values[group][boards.RANK_COLUMNS[division]] = rank


def _scored_row(table: _Averages, definition: BoardDefinition, card: EstimatorCard | None) -> Row:
    result, mine = table.result, table.values[ALL_RUNS]
    entry, forms = result.role == "entry", boards.column_forms(definition)
    known = dict.fromkeys(boards.RANK_COLUMNS.values()) | mine
    cells = {name: forms[name].format_value(x) for name, x in known.items() if name in forms}
    slope = mine.get("slope_low"), mine.get("slope_high")
    cells |= {
        "slope_interval": interval_text(*slope, forms["slope"]),
        "interval": interval_text(mine["low"], mine["high"], forms[definition.ranks_by]),
        "states": "/".join(f"{mine[x]:.0f}" for x in TRAINING_STATES if x in mine),
        "probes": count_passed(card.probes) if card else "",
        "calibrates": {True: "yes", False: "no", None: ""}[result.calibrates if entry else None],
    }
    state: _RowState = "scored" if entry else "baseline"
    groups = {name: x for name, x in table.values.items() if name != ALL_RUNS}
    return Row(result.estimator, state, cells, mine, causal=result.causal, groups=groups)


def _bound_rows(tables: Sequence[_Averages], definition: BoardDefinition) -> list[Row]:
    """Return the rows of bound and attainable error, as far as computed, if NRMSE ranks."""
    rows = []
    for name, key in zip(boards.LIMIT_ROWS, _LIMITS, strict=True):
        for values in (x.values for x in tables if definition.ranks_by == "nrmse"):
            groups = {group: {"nrmse": x.get(key)} for group, x in values.items()}
            if any(x["nrmse"] is not None for x in groups.values()):
                mine = groups.pop(ALL_RUNS)
                cells = {"nrmse": SCORES[key].format_value(mine["nrmse"])}
                rows.append(Row(name, "baseline", cells, mine, groups=groups))
                break
    return rows


def _mean(scores: np.ndarray) -> np.ndarray:
    """Return the interquartile means (K,) of scores (K, R, C, S); NaN if no run has the score."""
    return bootstrap.interquartile_mean(scores.reshape(len(scores), -1))


def _unknown_limits(scores: np.ndarray) -> dict[str, float]:
    """Return NaN for each limit that some drives lack: the NRMSE beside it would be of others."""
    driven = np.isfinite(scores[_BOUNDED[0]])
    lacking = (np.isnan(scores[[*SCORES].index(name)]) & driven for name in _LIMITS)
    return {name: np.nan for name, x in zip(_LIMITS, lacking, strict=True) if x.any()}


def _training_states(error: np.ndarray) -> _Values:
    """Count near-optimal, sub-optimal and unstable runs (Appendix A) by errors (R, C, S)."""
    if error.shape[-1] < 2:
        return {}
    error = error[~np.isnan(error)]
    near, unstable = np.sum(error < STATE_LIMITS[0]), np.sum(error >= STATE_LIMITS[1])
    counts = (near, error.size - near - unstable, unstable)
    return dict(zip(TRAINING_STATES, map(float, counts), strict=True))


def interval_text(low: float | None, high: float | None, score: Metric) -> str:
    """Return the text of an interval of a score."""
    if low is None or high is None:
        return UNDEFINED
    return "–".join(score.format_value(x) for x in (low, high))


def _defined(numbers: Mapping[str, float | None]) -> _Values:
    """Return numbers as plain floats, None for those that are not finite."""
    return {k: float(x) if x is not None and np.isfinite(x) else None for k, x in numbers.items()}
