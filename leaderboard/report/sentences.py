"""Findings: sentences about the boards, made from their numbers.

A board names those about itself by their keys in FINDINGS (`evaluation.boards`).
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache

import numpy as np

from leaderboard.evaluation.boards import BoardDefinition
from leaderboard.metrics import heights
from leaderboard.metrics.baselines import MEMORY
from leaderboard.metrics.level import EQ_12_RAW, STATE_LIMITS
from leaderboard.report.board_definitions import BOUND_NAME, COLUMNS, WORST, board_columns
from leaderboard.report.tables import BOUND_ROW, TRAINING_STATES, BoardView, Row
from road_envs.core.config import validate_choice
from road_envs.records.record import PROFILE_SPACING, profile_stations
from road_envs.roads import load_road

PAPER_NETWORK = "static_lm"
"""The estimator that implements the paper's network."""

N_PAIRS = 200
"""Number of pairs of unrelated roads."""

UNRELATED_ROAD = {"kind": "iso8608", "road_class": "D", "length": 100.0}
"""Road of the pairs, of the class of the training roads."""


@cache
def unrelated_level_errors(
    longest_wave: float = 20.0, about_mean: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return level errors (2 N_PAIRS,) and correlations (N_PAIRS,) of unrelated class-D roads.

    Level errors are those of single wheel paths, of heights about their mean or about the first
    one. The two roads of a pair are 100 m of the same class and independent.
    """
    levels: list[float] = []
    r: list[float] = []
    for y, a in _unrelated_roads(longest_wave):
        if about_mean:
            y, a = heights.remove_mean(y), heights.remove_mean(a)
        levels += heights.level_error(y, a)[:2]
        # at 1 m/s the low-pass does not shorten the scored band
        y, a = heights.band_pass(np.stack([y, a]), PROFILE_SPACING, heights.scored_band(1.0))
        r.append(heights.correlation(y, a, PROFILE_SPACING).r)
    return np.abs(levels), np.array(r)


@lru_cache(maxsize=1)
def _unrelated_roads(longest_wave: float) -> list[list[np.ndarray]]:
    """Return pairs of independent roads, each the heights (2, M) [m] of both wheel paths."""
    road = load_road({**UNRELATED_ROAD, "n_min": 1.0 / longest_wave})
    s = profile_stations(100.0)
    return [
        [road.realise(np.random.default_rng([0, k, j])).height(s) for j in range(2)]
        for k in range(N_PAIRS)
    ]


def unrelated_sentence() -> str:
    """Return the sentence about equation 12 for a road that is unrelated to the truth."""
    levels, r = unrelated_level_errors()
    long_waves, as_printed = (
        100.0 * np.median(unrelated_level_errors(longest_wave=100.0, about_mean=mean)[0])
        for mean in (True, False)
    )
    low, median, high = 100.0 * np.quantile(levels, [0.1, 0.5, 0.9])
    low_share = _percent(float(np.mean(levels < STATE_LIMITS[0])), 0)
    return (
        f"An unrelated road of the same class D has a level error (the paper's eq. 12) of "
        f"{median:.0f}\u00a0% in the median where no wave is longer than 20 m ({low:.0f} to "
        f"{high:.0f}\u00a0% from the 10th to the 90th percentile, below 15\u00a0% in "
        f"{low_share} of cases); with waves up to 100 m it has {long_waves:.0f}\u00a0%, and "
        f"{as_printed:.0f}\u00a0% as printed, of heights above the first one instead of the mean "
        f"({r.size} pairs of 100 m, each wheel path; correlation {abs(np.mean(r)):.2f}). The paper "
        "reports 10.2 to 14.8\u00a0% for its network: eq. 12 alone cannot distinguish a "
        "reconstruction from an unrelated road."
    )


def findings(views: Sequence[BoardView]) -> list[str]:
    """Return the sentences about the boards, without those for which results are missing."""
    about = [FINDINGS[name](view) for view in views for name in view.definition.findings]
    return [sentence for sentence in [unrelated_sentence(), *about] if sentence]


def _paper_protocol(view: BoardView) -> str:
    found = [row for row in _rows(view, claimed=True) if row.name == PAPER_NETWORK]
    if not found:
        return ""
    near, total = (
        sum(int(row.values.get(name) or 0) for row in found for name in names)
        for names in (TRAINING_STATES[:1], TRAINING_STATES)
    )
    counted = f" ({near} of {total} trainings below 15\u00a0%)" if total else ""
    cars = sorted(_other_cars(view))
    tested = f" and tested on another car ({', '.join(cars)})" if cars else ""
    return (
        f"Trained as the paper trains it, on an altered copy of the paving{tested}, the "
        f"{PAPER_NETWORK} network has a level error of {_percent(_mean(found, EQ_12_RAW))} by "
        f"eq. 12 as printed{counted}, which counts the datum, and "
        f"{_percent(_mean(found, 'level_error'))} of heights about their mean, at an in-band error "
        f"of {_mean(found, 'nrmse'):.2f}, where a flat road has 1, and correlation "
        f"{_mean(found, 'r'):.2f}."
    )


def _memory(view: BoardView) -> str:
    found = [row for row in _rows(view, claimed=True) if row.name == MEMORY]
    if not found:
        return ""
    return (
        "There the training road, moved back by its known delay, has an in-band error of "
        f"{_mean(found, 'nrmse'):.2f} and a level error of {_percent(_mean(found, EQ_12_RAW))} as "
        f"printed, and uses no measurement ({MEMORY}): the protocol rewards memorising the road."
    )


def _paper_network(view: BoardView) -> str:
    found = [row for row in _rows(view) if row.name == PAPER_NETWORK]
    if not found:
        return ""
    error, r = _mean(found, "nrmse"), _mean(found, "r")
    return (
        f"{view.definition.title}: the paper's network, {PAPER_NETWORK}, has an in-band error of "
        f"{error:.2f}, {'worse' if error > 1.0 else 'better'} than a flat road, and "
        f"correlation {r:.2f}."
    )


def _best(view: BoardView) -> str:
    rows = _rows(view)
    found = _best_rows([row for row in rows if row.state == "scored"], view)
    if not found:
        return ""
    bound = [row for row in rows if row.name == BOUND_ROW]
    limit = f" (the {BOUND_NAME}: {_mean(bound, 'nrmse'):.3f})" if bound else ""
    return f"{view.definition.title}: the best entry is {_described(found, view, limit)}."


def _best_causal(view: BoardView) -> str:
    found = _best_rows([row for row in _rows(view) if row.state == "scored" and row.causal], view)
    if not found:
        return ""
    return f"{view.definition.title}: the best causal entry is {_described(found, view)}."


FINDINGS: Mapping[str, Callable[[BoardView], str]] = {
    "best": _best,
    "best_causal": _best_causal,
    "paper_network": _paper_network,
    "paper_protocol": _paper_protocol,
    "memory": _memory,
}
"""Sentences about a board by the names that boards use; empty without the results for one."""


def check_board(name: str, board: BoardDefinition) -> None:
    """Raise ConfigError if a board names an unknown column or sentence."""
    board_columns(name, board)
    for finding in board.findings:
        validate_choice(f"finding of the board {name}:", finding, FINDINGS)


def _best_rows(rows: Sequence[Row], view: BoardView) -> list[Row]:
    """Return the rows, one for each task, of the entry with the least mean ranking score."""
    by_name: dict[str, list[Row]] = {}
    for row in rows:
        by_name.setdefault(row.name, []).append(row)
    score = view.definition.ranks_by
    return min(by_name.values(), key=lambda own: (_mean(own, score), own[0].name), default=[])


def _described(rows: Sequence[Row], view: BoardView, limit: str = "") -> str:
    """Return name, ranking score and worst drive of an entry."""
    form = COLUMNS[view.definition.ranks_by]
    score = form.format_value(_mean(rows, form.key)) + (f"\u00a0{form.unit}" if form.unit else "")
    worst = max((x for row in rows if (x := row.values.get(WORST)) is not None), default=None)
    tail = "" if worst is None else f", {COLUMNS[WORST].format_value(worst)} on its worst drive"
    return (
        f"{rows[0].name}, with {form.label} {score}{limit}{tail}, and correlation "
        f"{_mean(rows, 'r'):.2f}"
    )


def _other_cars(view: BoardView) -> set[str]:
    """Return the grades of the cars of a board's tasks with a claim, except that of training."""
    labels = (
        label
        for section in view.sections
        if any(row.state == "claim" for row in section.rows)
        for label in section.conditions
    )
    return {car for label in labels if (car := label.partition(", car ")[2])}


def _rows(view: BoardView, claimed: bool = False) -> list[Row]:
    """Return the rows with scores of a board; if `claimed`, those of tasks with a claim."""
    return [
        row
        for section in view.sections
        if not claimed or any(row.state == "claim" for row in section.rows)
        for row in section.rows
        if row.values and row.state != "claim"
    ]


def _mean(rows: Sequence[Row], score: str) -> float:
    found = [x for row in rows if (x := row.values.get(score)) is not None]
    return float(np.mean(found)) if found else np.nan


def _percent(share: float, digits: int = 1) -> str:
    return f"{100.0 * share:.{digits}f}\u00a0%"
