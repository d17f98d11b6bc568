"""Detection of single obstacles, bumps and holes: location, height and wheel path.

`obstacles` has the definitions. They are scored in tasks with obstacles, on roads that have some.
"""

import numpy as np

from leaderboard.metrics.api import ScoredEstimate, metric
from leaderboard.metrics.obstacles import ObstacleScores, obstacle_scores

UNDEFINED_OBSTACLES = ObstacleScores(*(np.nan for _ in ObstacleScores._fields))


def _obstacles(scored: ScoredEstimate) -> ObstacleScores:
    found = obstacle_scores(scored.y, scored.a, scored.ds) if scored.bumps else None
    return found or UNDEFINED_OBSTACLES


@metric("bump precision", unit="%", factor=100.0, digits=0, better="high")
def bump_precision(scored: ScoredEstimate) -> float:
    """Share of detected bumps and holes that are there."""
    return scored.shared(_obstacles).precision


@metric("bump recall", unit="%", factor=100.0, digits=0, better="high")
def bump_recall(scored: ScoredEstimate) -> float:
    """Share of bumps and holes that are detected."""
    return scored.shared(_obstacles).recall


@metric("bump F1", better="high")
def bump_f1(scored: ScoredEstimate) -> float:
    """F1 score of the detection of bumps and holes, within 0.3 m and on the right wheel path."""
    return scored.shared(_obstacles).f1


@metric("bump location error", unit="m", head="location error")
def bump_location_error(scored: ScoredEstimate) -> float:
    """Mean distance of detected obstacles from their true places."""
    return scored.shared(_obstacles).location_error


@metric("bump height error", unit="mm", factor=1000.0, digits=0, head="height error")
def bump_height_error(scored: ScoredEstimate) -> float:
    """Mean absolute error of the height of detected obstacles."""
    return scored.shared(_obstacles).height_error


@metric("relative bump height error", unit="%", factor=100.0, digits=0, head="height error")
def bump_height_error_relative(scored: ScoredEstimate) -> float:
    """Mean absolute error of the height of detected obstacles, relative to the true height."""
    return scored.shared(_obstacles).height_error_relative


@metric("bumps on the wrong side", digits=1, head="wrong side")
def bump_wrong_side(scored: ScoredEstimate) -> float:
    """Number of detected obstacles that only the other wheel path has."""
    return scored.shared(_obstacles).wrong_side
