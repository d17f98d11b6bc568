"""Findings: sentences about the boards, made from their numbers."""

from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np

from leaderboard.metrics import heights
from leaderboard.metrics.level import EQ_12_RAW, STATE_LIMITS
from leaderboard.report.board_definitions import WORST
from leaderboard.report.tables import TRAINING_STATES, BoardView, Row
from road_envs.data.record import PROFILE_SPACING, profile_stations
from road_envs.roads import load_road

PAPER_NETWORK = "static_lm"
"""The estimator that implements the paper's network."""

N_PAIRS = 200
UNRELATED_ROAD = {"kind": "iso8608", "road_class": "D", "length": 100.0}


def findings(views: Sequence[BoardView]) -> list[str]:
    """Return the sentences about the boards, without those for which results are missing."""
    sentences = [
        unrelated_sentence(),
        _paper_sentence(views),
        _memory_sentence(views),
        _new_road_sentence(views),
        _best_sentence(views),
        _causal_sentence(views),
    ]
    return [sentence for sentence in sentences if sentence]


@cache
def unrelated_level_errors(
    pairs: int = N_PAIRS, seed: int = 0, longest_wave: float = 20.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return level errors (2 pairs,) and correlations (pairs,) of unrelated class-D roads.

    Level errors are those of single wheel paths. The two roads of a pair are 100 m of the same
    class and independent.
    """
    road = load_road({**UNRELATED_ROAD, "n_min": 1.0 / longest_wave})
    s = profile_stations(100.0)
    levels: list[float] = []
    r: list[float] = []
    for k in range(pairs):
        y, a = (
            heights.remove_mean(road.realise(np.random.default_rng([seed, k, j])).height(s))
            for j in range(2)
        )
        levels += heights.level_error(y, a)[:2]
        # at 1 m/s the low-pass does not shorten the scored band
        y, a = heights.band_pass(np.stack([y, a]), PROFILE_SPACING, heights.scored_band(1.0))
        r.append(heights.correlation(y, a, PROFILE_SPACING).r)
    return np.abs(levels), np.array(r)


def unrelated_sentence() -> str:
    """Return the sentence about equation 12 for a road that is unrelated to the truth."""
    levels, r = unrelated_level_errors()
    with_long_waves, _ = unrelated_level_errors(longest_wave=100.0)
    low, median, high = 100.0 * np.quantile(levels, [0.1, 0.5, 0.9])
    low_share = _percent(float(np.mean(levels < STATE_LIMITS[0])), 0)
    long_median = 100.0 * np.median(with_long_waves)
    return (
        f"An unrelated road of the same class D has a level error (the paper's eq. 12) of "
        f"{median:.0f}\u00a0% in the median where no wave is longer than 20 m ({low:.0f} to "
        f"{high:.0f}\u00a0% from the 10th to the 90th percentile, below 15\u00a0% in "
        f"{low_share} of cases), and of {long_median:.0f}\u00a0% with waves up to 100 m, at "
        f"correlation {abs(np.mean(r)):.2f} ({r.size} pairs of 100 m, heights about their mean). "
        "The paper reports 10.2 to 14.8\u00a0% for its network: eq. 12 alone cannot distinguish a "
        "reconstruction from an unrelated road."
    )


def _paper_sentence(views: Sequence[BoardView]) -> str:
    found = list(_rows(views, "paper", PAPER_NETWORK, claimed=True))
    if not found:
        return ""
    near, total = (
        sum(int(row.values.get(name) or 0) for row in found for name in names)
        for names in (TRAINING_STATES[:1], TRAINING_STATES)
    )
    counted = f" ({near} of {total} trainings below 15\u00a0%)" if total else ""
    cars = sorted(_other_cars(views, "paper"))
    tested = f" and tested on another car ({', '.join(cars)})" if cars else ""
    return (
        f"Trained as the paper trains it, on an altered copy of the paving{tested}, the "
        f"{PAPER_NETWORK} network has a level error of {_percent(_mean(found, EQ_12_RAW))} by "
        f"eq. 12 as printed{counted}, which counts the datum, and "
        f"{_percent(_mean(found, 'level_error'))} of heights about their mean, at an in-band error "
        f"of {_mean(found, 'nrmse'):.2f}, where a flat road has 1, and correlation "
        f"{_mean(found, 'r'):.2f}."
    )


def _memory_sentence(views: Sequence[BoardView]) -> str:
    found = list(_rows(views, "paper", "mean", claimed=True))
    if not found:
        return ""
    return (
        "There the mean of the training roads, which uses no measurement, has a level error of "
        f"{_percent(_mean(found, EQ_12_RAW))}: the protocol rewards memorising the road."
    )


def _new_road_sentence(views: Sequence[BoardView]) -> str:
    found = list(_rows(views, "new_road", PAPER_NETWORK))
    if not found:
        return ""
    error, r = _mean(found, "nrmse"), _mean(found, "r")
    return (
        f"On roads it has not seen, the {PAPER_NETWORK} network has an in-band error of "
        f"{error:.2f}, {'worse' if error > 1.0 else 'better'} than a flat road, and "
        f"correlation {r:.2f}."
    )


def _best_sentence(views: Sequence[BoardView]) -> str:
    scored = [row for row in _rows(views, "new_road") if row.state == "scored"]
    if not scored:
        return ""
    names = dict.fromkeys(row.name for row in scored)
    by_name = {name: [row for row in scored if row.name == name] for name in names}
    best = min(names, key=lambda name: (_mean(by_name[name], "nrmse"), name))
    found = by_name[best]
    bound = list(_rows(views, "new_road", "bound"))
    limit = f", where the linear bound is {_mean(bound, 'nrmse'):.3f}" if bound else ""
    return (
        f"The best entry there is {best}: in-band error {_mean(found, 'nrmse'):.3f}{limit}, "
        f"{_worst(found):.2f} on its worst drive, correlation {_mean(found, 'r'):.2f}."
    )


def _worst(rows: Sequence[Row]) -> float:
    """Return the error of the worst drive of an entry."""
    return max(row.values.get(WORST) or 0.0 for row in rows)


def _causal_sentence(views: Sequence[BoardView]) -> str:
    found = [row for row in _rows(views, "new_road") if row.state == "scored" and row.causal]
    if not found:
        return ""
    by_name = {row.name: [other for other in found if other.name == row.name] for row in found}
    best = min(by_name, key=lambda name: (_mean(by_name[name], "nrmse"), name))
    return (
        f"The best causal entry is {best}: in-band error {_mean(by_name[best], 'nrmse'):.3f}, "
        f"{_worst(by_name[best]):.2f} on its worst drive."
    )


def _other_cars(views: Sequence[BoardView], board: str) -> set[str]:
    """Return the grades of the cars of a board's tasks with a claim, except that of training."""
    labels = (
        label
        for view in views
        for section in view.sections
        if view.board == board and any(row.state == "claim" for row in section.rows)
        for label in section.conditions
    )
    return {car for label in labels if (car := label.partition(", car ")[2])}


def _rows(
    views: Sequence[BoardView], board: str, name: str | None = None, claimed: bool = False
) -> Iterator[Row]:
    """Yield scored rows of a board, of one entry or all; if `claimed`, of tasks with a claim."""
    for view in views:
        for section in view.sections if view.board == board else ():
            rows = section.rows
            if not claimed or any(row.state == "claim" for row in rows):
                yield from (
                    row
                    for row in rows
                    if row.values and row.state != "claim" and name in (None, row.name)
                )


def _mean(rows: Sequence[Row], score: str) -> float:
    found = [x for row in rows if (x := row.values.get(score)) is not None]
    return float(np.mean(found)) if found else np.nan


def _percent(share: float, digits: int = 1) -> str:
    return f"{100.0 * share:.{digits}f}\u00a0%"
