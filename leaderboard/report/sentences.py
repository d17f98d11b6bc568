"""What the numbers say, in plain sentences made from them."""

from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np

from leaderboard.metrics import heights
from leaderboard.report.tables import PRINTED, TRAININGS, Line, View
from road_envs.data.record import GRID, grid
from road_envs.roads import load_road

NETWORK = "static_lm"
"""The estimator that stands for the paper's network."""

PAIRS = 200
UNRELATED = {"kind": "iso8608", "road_class": "D", "n_min": 0.05, "length": 100.0}
"""Roads without waves longer than 20 m, which no 100 m hold enough of."""


def findings(views: Sequence[View]) -> list[str]:
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
def unrelated_levels(pairs: int = PAIRS, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Level errors (2 pairs,) of unrelated class-D roads, path by path, and correlations (pairs,).

    Both roads of a pair are 100 m of class D, of equal roughness and nothing else in common.
    """
    road, s = load_road(UNRELATED), grid(100.0)
    levels: list[float] = []
    r: list[float] = []
    for k in range(pairs):
        y, a = (
            heights.about_mean(road.realise(np.random.default_rng([seed, k, j])).height(s))
            for j in range(2)
        )
        levels += heights.level_error(y, a)[:2]
        y, a = heights.band_pass(np.stack([y, a]), GRID, heights.scored_band(1.0))
        r.append(heights.correlation(y, a, GRID).r)
    return np.abs(levels), np.array(r)


def unrelated_sentence() -> str:
    """What equation 12 says of a road that has nothing to do with the truth."""
    levels, r = unrelated_levels()
    low, median, high = 100.0 * np.quantile(levels, [0.1, 0.5, 0.9])
    fine = _percent(float(np.mean(levels < 0.15)), 0)
    return (
        f"An unrelated road of the same class D has a level error (the paper's eq. 12) of "
        f"{median:.0f}\u00a0% in the median, {low:.0f} to {high:.0f}\u00a0% from the 10th to the "
        f"90th percentile, and below 15\u00a0% in {fine} of cases, at correlation "
        f"{abs(np.mean(r)):.2f} ({r.size} pairs of 100 m). The paper reports 10.2 to 14.8\u00a0% "
        "for its network: eq. 12 alone cannot tell a reconstruction from a stranger."
    )


def _paper_sentence(views: Sequence[View]) -> str:
    found = list(_lines(views, "paper", NETWORK, claimed=True))
    if not found:
        return ""
    near, every = (
        sum(int(line.values.get(name) or 0) for line in found for name in names)
        for names in (TRAININGS[:1], TRAININGS)
    )
    counted = f" ({near} of {every} trainings below 15\u00a0%)" if every else ""
    cars = sorted(_other_cars(views, "paper"))
    asked = f" and asked on another car ({', '.join(cars)})" if cars else ""
    return (
        f"Trained as the paper trains it, on an altered copy of the paving{asked}, the {NETWORK} "
        f"network has a level error of {_percent(_mean(found, PRINTED))} by eq. 12 as printed"
        f"{counted}, which counts the datum, and {_percent(_mean(found, 'level_error'))} of "
        f"heights about their mean, at an in-band error of {_mean(found, 'nrmse'):.2f}, where a "
        "flat road has 1, "
        f"and correlation {_mean(found, 'r'):.2f}."
    )


def _memory_sentence(views: Sequence[View]) -> str:
    found = list(_lines(views, "paper", "mean", claimed=True))
    if not found:
        return ""
    return (
        "There the mean of the training roads, which measures nothing, has a level error of "
        f"{_percent(_mean(found, PRINTED))}: the protocol rewards memory."
    )


def _new_road_sentence(views: Sequence[View]) -> str:
    found = list(_lines(views, "new_road", NETWORK))
    if not found:
        return ""
    error, r = _mean(found, "nrmse"), _mean(found, "r")
    return (
        f"On roads it has not seen, the {NETWORK} network has an in-band error of {error:.2f}, "
        f"{'worse' if error > 1.0 else 'better'} than a flat road, and correlation {r:.2f}."
    )


def _best_sentence(views: Sequence[View]) -> str:
    scored = [line for line in _lines(views, "new_road") if line.state == "scored"]
    if not scored:
        return ""
    names = dict.fromkeys(line.name for line in scored)
    by_name = {name: [line for line in scored if line.name == name] for name in names}
    best = min(names, key=lambda name: (_mean(by_name[name], "nrmse"), name))
    found = by_name[best]
    bound = list(_lines(views, "new_road", "bound"))
    allowed = f" (bound of linear estimators: {_mean(bound, 'nrmse'):.2f})" if bound else ""
    return (
        f"The best there is {best}: in-band error {_mean(found, 'nrmse'):.2f}{allowed}, "
        f"correlation {_mean(found, 'r'):.2f}, {_percent(_mean(found, 'class_exact'), 0)} of "
        "octaves in the true ISO class."
    )


def _causal_sentence(views: Sequence[View]) -> str:
    found = [line for line in _lines(views, "new_road") if line.state == "scored" and line.causal]
    if not found:
        return ""
    errors = {
        line.name: _mean([one for one in found if one.name == line.name], "nrmse") for line in found
    }
    best = min(errors, key=lambda name: (errors[name], name))
    return f"The best that tells heights while driving is {best}: in-band error {errors[best]:.2f}."


def _other_cars(views: Sequence[View], board: str) -> set[str]:
    """Grades of the cars that a board's claimed tasks are driven by, if not that of training."""
    labels = (
        label
        for view in views
        for section in view.sections
        if view.board == board and any(line.state == "claim" for line in section.lines)
        for label in section.conditions
    )
    return {car for label in labels if (car := label.partition(", car ")[2])}


def _lines(
    views: Sequence[View], board: str, name: str | None = None, claimed: bool = False
) -> Iterator[Line]:
    """Scored lines of a board, of one entry or of all; of tasks that the paper has a figure for."""
    for view in views:
        for section in view.sections if view.board == board else ():
            lines = section.lines
            if not claimed or any(line.state == "claim" for line in lines):
                yield from (
                    line
                    for line in lines
                    if line.values and line.state != "claim" and name in (None, line.name)
                )


def _mean(lines: Sequence[Line], score: str) -> float:
    found = [x for line in lines if (x := line.values.get(score)) is not None]
    return float(np.mean(found)) if found else np.nan


def _percent(share: float, digits: int = 1) -> str:
    return f"{100.0 * share:.{digits}f}\u00a0%"
