"""Detection scores of single obstacles: location, height and wheel path.

Obstacles rise from a road that is level between them, so the median of the profile is its level. A
bump is a section of one wheel path that rises above half the height of the lowest true obstacle; a
hole, of negative height, falls as far below. Sections less than MERGE_GAP apart are one obstacle,
located at its middle. An estimated obstacle matches the nearest true one within MATCH_DISTANCE, of
the same sign and on the same wheel path; each is matched at most once. They are scored in tasks
with obstacles, on roads that have some.
"""

from itertools import product
from typing import NamedTuple

import numpy as np

from leaderboard.metrics.api import PERCENT, Metric, ScoredEstimate, metrics

MATCH_DISTANCE = 0.3  # [m]
MERGE_GAP = 0.5  # [m]
_MIN_HEIGHT = 0.02  # [m] lower true heights are no obstacles
_LEVEL_TOLERANCE = 0.005  # [m] about the median, where at least half of each wheel path lies


class Obstacle(NamedTuple):
    """Station of the middle and height, both [m]; a hole has a negative height."""

    s: float
    height: float


_Pairs = list[tuple[Obstacle, Obstacle]]
_Matches = tuple[_Pairs, list[Obstacle], list[Obstacle]]
"""Obstacles of one wheel path: matched pairs (true, estimated), misses, false alarms."""


def detect_obstacles(z: np.ndarray, ds: float, threshold: float) -> list[Obstacle]:
    """Detect the sections of `z` (M,) that leave the median by more than `threshold` [m]."""
    z = z - np.median(z)
    detected = []
    for sign in (1.0, -1.0):
        beyond = np.flatnonzero(sign * z > threshold)
        sections = np.split(beyond, np.flatnonzero(np.diff(beyond) * ds > MERGE_GAP) + 1)
        for i in filter(len, sections):
            detected.append(Obstacle(ds * (i[0] + i[-1]) / 2, sign * float((sign * z[i]).max())))
    return sorted(detected)


def true_obstacles(y: np.ndarray, ds: float) -> tuple[list[Obstacle], list[Obstacle]]:
    """Return the obstacles of each wheel path of a true road `y` (2, M) [m]; none if uneven."""
    about_level = np.abs(y - np.median(y, axis=1, keepdims=True)) < _LEVEL_TOLERANCE
    if (about_level.mean(axis=1) < 0.5).any():
        return [], []
    left, right = (detect_obstacles(z, ds, _MIN_HEIGHT) for z in y)
    return left, right


def match_obstacles(y: np.ndarray, a: np.ndarray, ds: float) -> list[_Matches]:
    """Match the obstacles of estimate `a` with those of truth `y`, both (2, M), by wheel path; an
    empty list if the truth has none.
    """
    heights = [abs(obstacle.height) for path in true_obstacles(y, ds) for obstacle in path]
    if not heights:
        return []
    least, paths = min(heights) / 2, zip(y, a, strict=True)
    return [_match(*(detect_obstacles(z, ds, least) for z in path)) for path in paths]


def _match(true: list[Obstacle], detected: list[Obstacle]) -> _Matches:
    """Match the obstacles of a wheel path, nearest first, each in one pair."""
    pairs: _Pairs = []
    for t, f in sorted(product(true, detected), key=lambda pair: abs(pair[0].s - pair[1].s)):
        if _is_match(t, f) and not any(t is t_ or f is f_ for t_, f_ in pairs):
            pairs.append((t, f))
    missed = [obstacle for obstacle in true if all(obstacle is not t for t, _ in pairs)]
    false = [obstacle for obstacle in detected if all(obstacle is not f for _, f in pairs)]
    return pairs, missed, false


def _is_match(a: Obstacle, b: Obstacle) -> bool:
    return abs(a.s - b.s) <= MATCH_DISTANCE and (a.height > 0.0) == (b.height > 0.0)


@metrics(
    Metric("bump_precision", "bump precision", **PERCENT, better="high",
           help="Share of detected bumps and holes that are there."),
    Metric("bump_recall", "bump recall", **PERCENT, better="high",
           help="Share of bumps and holes that are detected."),
    Metric("bump_f1", "bump F1", better="high", help="F1 score of the detection of bumps and "
           "holes, within 0.3 m and on the right wheel path."),
    Metric("bump_location_error", "bump location error", unit="m", head="location error",
           help="Mean distance of detected obstacles from their true places."),
    Metric("bump_height_error", "bump height error", unit="mm", factor=1000.0, digits=0,
           head="height error", help="Mean absolute error of the height of detected obstacles."),
    Metric("bump_height_error_relative", "relative bump height error", **PERCENT,
           head="height error", help="Mean absolute error of the height of detected obstacles, "
           "relative to the true height."),
    Metric("bump_wrong_side", "bumps on the wrong side", digits=1, head="wrong side",
           help="Number of detected obstacles that only the other wheel path has."),
)  # fmt: skip
def _obstacles(scored: ScoredEstimate) -> tuple[float, ...]:
    paths = match_obstacles(scored.y, scored.a, scored.ds) if scored.bumps else []
    if not paths:
        return (np.nan,) * 7
    pairs = [pair for matched, _, _ in paths for pair in matched]
    true = [[*missed, *(t for t, _ in matched)] for matched, missed, _ in paths]
    detected = [[*false, *(f for _, f in matched)] for matched, _, false in paths]
    wrong_side = sum(
        any(_is_match(obstacle, other) for other in true[1 - side])
        and not any(_is_match(obstacle, own) for own in true[side])
        for side in range(2)
        for obstacle in detected[side]
    )
    n_true, n_detected = sum(map(len, true)), sum(map(len, detected))
    errors = [
        (abs(f.s - t.s), abs(f.height - t.height), abs(f.height - t.height) / abs(t.height))
        for t, f in pairs
    ]
    of_matched = np.mean(errors, axis=0).tolist() if pairs else (np.nan,) * 3
    precision = len(pairs) / n_detected if n_detected else 0.0
    f1 = 2 * len(pairs) / (n_true + n_detected)
    return precision, len(pairs) / n_true, f1, *of_matched, float(wrong_side)
