"""What the numbers say, in plain sentences made from them."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from leaderboard import metrics
from leaderboard.board import Board
from leaderboard.results import Result
from leaderboard.statistics import interquartile_mean
from leaderboard.tasks import Task
from road_envs.record import GRID, grid
from road_envs.roads import load_road

NETWORK = "static_lm"
"""The estimator that stands for the paper's network."""

PAIRS = 200
UNRELATED = {"kind": "iso8608", "road_class": "D", "n_min": 0.05, "length": 100.0}
"""Roads without waves longer than 20 m, which no 100 m hold enough of."""


def findings(board: Board) -> list[str]:
    """Sentences about the board; those for which nothing was measured are left out."""
    said = [
        unrelated_sentence(),
        _paper_sentence(board),
        _memory_sentence(board),
        _new_road_sentence(board),
        _best_sentence(board),
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
            metrics.about_mean(road.realise(np.random.default_rng([seed, k, j])).height(s))
            for j in range(2)
        )
        levels += metrics.level_error(y, a)[:2]
        y, a = metrics.band_pass(np.stack([y, a]), GRID, metrics.scored_band(1.0))
        r.append(metrics.correlation(y, a, GRID).r)
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


def _paper_sentence(board: Board) -> str:
    found = _results(board, _altered_copies(board), NETWORK)
    if not found:
        return ""
    level, error, r = (pooled(found, name) for name in ("level_error", "nrmse", "r"))
    every = np.concatenate([result.values("level_error").ravel() for result in found])
    return (
        f"Trained as the paper trains it, on an altered copy of the test road, the {NETWORK} "
        f"network has a level error of {_percent(level)} (bumps aside; {np.sum(every < 0.15)} of "
        f"{every.size} trainings stay below 15\u00a0%), at an in-band error of {error:.2f}, where "
        f"a flat road has 1, and correlation {r:.2f}."
    )


def _memory_sentence(board: Board) -> str:
    found = _results(board, _altered_copies(board), "mean")
    if not found:
        return ""
    return (
        "There the mean of the training roads, which measures nothing, has a level error of "
        f"{_percent(pooled(found, 'level_error'))}: the protocol rewards memory."
    )


def _new_road_sentence(board: Board) -> str:
    found = _results(board, _new_road(board), NETWORK)
    if not found:
        return ""
    error, r = pooled(found, "nrmse"), pooled(found, "r")
    return (
        f"On roads it has not seen, the {NETWORK} network has an in-band error of {error:.2f}, "
        f"{'worse' if error > 1.0 else 'better'} than a flat road, and correlation {r:.2f}."
    )


def _best_sentence(board: Board) -> str:
    tasks = _new_road(board)
    entries = {r.estimator for t in tasks for r in board.scored(t) if r.role == "entry"}
    errors = {name: pooled(_results(board, tasks, name), "nrmse") for name in entries}
    if not errors:
        return ""
    best = min(errors, key=lambda name: (errors[name], name))
    found = _results(board, tasks, best)
    return (
        f"The best there is {best}: in-band error {errors[best]:.2f}, correlation "
        f"{pooled(found, 'r'):.2f}, {_percent(pooled(found, 'class_exact'), 0)} of octaves in "
        "the true ISO class."
    )


def _percent(share: float, digits: int = 1) -> str:
    return f"{100.0 * share:.{digits}f}\u00a0%"


def _altered_copies(board: Board) -> list[Task]:
    """The tasks in the paper's manner on random surfaces."""
    return [task for task in board.tasks if task.board == "paper" and not task.bumps]


def _new_road(board: Board) -> list[Task]:
    return [task for task in board.tasks if task.board == "new_road"]


def _results(board: Board, tasks: Sequence[Task], name: str) -> list[Result]:
    return [r for task in tasks for r in board.scored(task) if r.estimator == name]


def pooled(results: Sequence[Result], score: str) -> float:
    """Interquartile mean of a score over all drives and trainings of some tasks."""
    return float(interquartile_mean(np.concatenate([r.values(score).ravel() for r in results])))
