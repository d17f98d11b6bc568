"""What the numbers say, in plain sentences made from them."""

from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np

from leaderboard.metrics import heights
from leaderboard.report.tables import EQ_12_RAW, TRAINING_STATES, BoardView, Row
from road_envs.data.record import PROFILE_SPACING, profile_stations
from road_envs.roads import load_road

PAPER_NETWORK = "static_lm"
"""The estimator that stands for the paper's network."""

N_PAIRS = 200
UNRELATED_ROAD = {"kind": "iso8608", "road_class": "D", "n_min": 0.05, "length": 100.0}
"""Roads without waves longer than 20 m, which no 100 m hold enough of."""


def findings(views: Sequence[BoardView]) -> list[str]:
    """Sentences about the boards; those for which nothing was measured are left out."""
    said = [
        unrelated_sentence(),
        _paper_sentence(views),
        _memory_sentence(views),
        _new_road_sentence(views),
        _best_sentence(views),
        _causal_sentence(views),
    ]
    return [sentence for sentence in said if sentence]


@cache
def unrelated_level_errors(pairs: int = N_PAIRS, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Level errors (2 pairs,) of unrelated class-D roads, path by path, and correlations (pairs,).

    Both roads of a pair are 100 m of class D, of equal roughness and nothing else in common.
    """
    road, s = load_road(UNRELATED_ROAD), profile_stations(100.0)
    levels: list[float] = []
    r: list[float] = []
    for k in range(pairs):
        y, a = (
            heights.remove_mean(road.realise(np.random.default_rng([seed, k, j])).height(s))
            for j in range(2)
        )
        levels += heights.level_error(y, a)[:2]
        y, a = heights.band_pass(np.stack([y, a]), PROFILE_SPACING, heights.scored_band(1.0))
        r.append(heights.correlation(y, a, PROFILE_SPACING).r)
    return np.abs(levels), np.array(r)


def unrelated_sentence() -> str:
    """What equation 12 says of a road that has nothing to do with the truth."""
    levels, r = unrelated_level_errors()
    low, median, high = 100.0 * np.quantile(levels, [0.1, 0.5, 0.9])
    fine = _percent(float(np.mean(levels < 0.15)), 0)
    return (
        f"An unrelated road of the same class D has a level error (the paper's eq. 12) of "
        f"{median:.0f}\u00a0% in the median, {low:.0f} to {high:.0f}\u00a0% from the 10th to the "
        f"90th percentile, and below 15\u00a0% in {fine} of cases, at correlation "
        f"{abs(np.mean(r)):.2f} ({r.size} pairs of 100 m). The paper reports 10.2 to 14.8\u00a0% "
        "for its network: eq. 12 alone cannot tell a reconstruction from a stranger."
    )


def _paper_sentence(views: Sequence[BoardView]) -> str:
    found = list(_rows(views, "paper", PAPER_NETWORK, claimed=True))
    if not found:
        return ""
    near, every = (
        sum(int(row.values.get(name) or 0) for row in found for name in names)
        for names in (TRAINING_STATES[:1], TRAINING_STATES)
    )
    counted = f" ({near} of {every} trainings below 15\u00a0%)" if every else ""
    cars = sorted(_other_cars(views, "paper"))
    asked = f" and asked on another car ({', '.join(cars)})" if cars else ""
    return (
        f"Trained as the paper trains it, on an altered copy of the paving{asked}, the "
        f"{PAPER_NETWORK} network has a level error of {_percent(_mean(found, EQ_12_RAW))} by "
        f"eq. 12 as printed{counted}, which counts the datum, and "
        f"{_percent(_mean(found, 'level_error'))} of heights about their mean, at an in-band error of {_mean(found, 'nrmse'):.2f}, where a "
        "flat road has 1, "
        f"and correlation {_mean(found, 'r'):.2f}."
    )


def _memory_sentence(views: Sequence[BoardView]) -> str:
    found = list(_rows(views, "paper", "mean", claimed=True))
    if not found:
        return ""
    return (
        "There the mean of the training roads, which measures nothing, has a level error of "
        f"{_percent(_mean(found, EQ_12_RAW))}: the protocol rewards memory."
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
    allowed = f" (bound of linear estimators: {_mean(bound, 'nrmse'):.2f})" if bound else ""
    return (
        f"The best there is {best}: in-band error {_mean(found, 'nrmse'):.2f}{allowed}, "
        f"correlation {_mean(found, 'r'):.2f}, {_percent(_mean(found, 'class_exact'), 0)} of "
        "octaves in the true ISO class."
    )


def _causal_sentence(views: Sequence[BoardView]) -> str:
    found = [row for row in _rows(views, "new_road") if row.state == "scored" and row.causal]
    if not found:
        return ""
    errors = {
        row.name: _mean([one for one in found if one.name == row.name], "nrmse") for row in found
    }
    best = min(errors, key=lambda name: (errors[name], name))
    return f"The best that tells heights while driving is {best}: in-band error {errors[best]:.2f}."


def _other_cars(views: Sequence[BoardView], board: str) -> set[str]:
    """Grades of the cars that a board's claimed tasks are driven by, if not that of training."""
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
    """Scored lines of a board, of one entry or of all; of tasks that the paper has a figure for."""
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
