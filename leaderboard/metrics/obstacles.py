"""Are the obstacles where they stand, as high as they are, and on the right wheel path?

Obstacles stand on a road that is level between them, so the profile's median is the level. A bump
is a stretch of one wheel path that rises above half the height of the lowest true obstacle; a hole,
a bump of negative height, falls as far below. Stretches less than 0.5 m apart are one. It stands
at the middle of its stretch. An estimated bump is found if it is the nearest within 0.3 m of a
true one of its kind on the same wheel path; one bump answers for one.
"""

from typing import NamedTuple

import numpy as np

MATCH_DISTANCE = 0.3  # [m]
MERGE_GAP = 0.5  # [m]
MIN_HEIGHT = 0.02  # [m] true heights below this are no obstacles
LEVEL_TOLERANCE = 0.005  # [m] about the median, where at least half of each wheel path lies


class Obstacle(NamedTuple):
    """An obstacle: the station of its middle and its height, both [m]; a hole's is negative."""

    s: float
    height: float


class ObstacleMatches(NamedTuple):
    """Bumps of one wheel path: `pairs` (true, found), true ones missed, found ones not there."""

    pairs: list[tuple[Obstacle, Obstacle]]
    missed: list[Obstacle]
    false: list[Obstacle]


class ObstacleScores(NamedTuple):
    """Shares [-]; mean absolute errors of the bumps found, NaN if none was; ghosts counted."""

    precision: float
    recall: float
    f1: float
    location_error: float  # [m]
    height_error: float  # [m]
    height_error_relative: float  # of the true height
    ghosts: int  # estimated where only the other wheel path has a bump


def detect_obstacles(z: np.ndarray, ds: float, threshold: float) -> list[Obstacle]:
    """Where one wheel path `z` (M,) rises or falls by more than `threshold` [m] from its median."""
    z = z - np.median(z)
    found = []
    for sign in (1.0, -1.0):
        beyond = np.flatnonzero(sign * z > threshold)
        stretches = np.split(beyond, np.flatnonzero(np.diff(beyond) * ds > MERGE_GAP) + 1)
        found += [
            Obstacle(ds * (i[0] + i[-1]) / 2, sign * float((sign * z[i]).max()))
            for i in stretches
            if i.size
        ]
    return sorted(found)


def true_obstacles(y: np.ndarray, ds: float) -> tuple[list[Obstacle], list[Obstacle]]:
    """The obstacles of both wheel paths of a true road `y` (2, M) [m]; none on an uneven road."""
    about_level = np.abs(y - np.median(y, axis=1, keepdims=True)) < LEVEL_TOLERANCE
    if (about_level.mean(axis=1) < 0.5).any():
        return [], []
    left, right = (detect_obstacles(z, ds, MIN_HEIGHT) for z in y)
    return left, right


def match_obstacles(
    y: np.ndarray, a: np.ndarray, ds: float
) -> tuple[ObstacleMatches, ObstacleMatches] | None:
    """Which bumps of the truth `y` an estimate `a` has, both (2, M) [m]; None if there are none."""
    heights = [abs(bump.height) for path in true_obstacles(y, ds) for bump in path]
    if not heights:
        return None
    threshold = min(heights) / 2
    left, right = (_match_path(y[k], a[k], ds, threshold) for k in range(2))
    return left, right


def obstacle_scores(y: np.ndarray, a: np.ndarray, ds: float) -> ObstacleScores | None:
    """Scores of estimate `a` against truth `y`, both (2, M) [m]; None if the truth has no bump."""
    paths = match_obstacles(y, a, ds)
    if paths is None:
        return None
    pairs = [pair for path in paths for pair in path.pairs]
    true = [[*path.missed, *(t for t, _ in path.pairs)] for path in paths]
    found = [[*path.false, *(f for _, f in path.pairs)] for path in paths]
    ghosts = sum(
        _has_match(bump, true[1 - side]) and not _has_match(bump, true[side])
        for side in range(2)
        for bump in found[side]
    )
    n_true, n_found = sum(map(len, true)), sum(map(len, found))
    s, height, relative = np.mean(_errors(pairs), axis=0) if pairs else (np.nan,) * 3
    return ObstacleScores(
        precision=len(pairs) / n_found if n_found else 0.0,
        recall=len(pairs) / n_true,
        f1=2 * len(pairs) / (n_true + n_found),
        location_error=float(s),
        height_error=float(height),
        height_error_relative=float(relative),
        ghosts=int(ghosts),
    )


def _match_path(y: np.ndarray, a: np.ndarray, ds: float, threshold: float) -> ObstacleMatches:
    true, found = detect_obstacles(y, ds, threshold), detect_obstacles(a, ds, threshold)
    pairs = _pair_nearest(true, found)
    return ObstacleMatches(
        pairs,
        [bump for bump in true if not any(bump is t for t, _ in pairs)],
        [bump for bump in found if not any(bump is f for _, f in pairs)],
    )


def _pair_nearest(true: list[Obstacle], found: list[Obstacle]) -> list[tuple[Obstacle, Obstacle]]:
    """Pairs (true, found) at most TOLERANCE apart, nearest first, each bump in one pair."""
    pairs: list[tuple[Obstacle, Obstacle]] = []
    for t, f in sorted(((t, f) for t in true for f in found), key=lambda p: abs(p[0].s - p[1].s)):
        taken = any(t is t_ or f is f_ for t_, f_ in pairs)
        if _is_match(t, f) and not taken:
            pairs.append((t, f))
    return pairs


def _has_match(bump: Obstacle, others: list[Obstacle]) -> bool:
    return any(_is_match(bump, other) for other in others)


def _is_match(a: Obstacle, b: Obstacle) -> bool:
    """Whether two obstacles are of one kind and stand at one place."""
    return abs(a.s - b.s) <= MATCH_DISTANCE and (a.height > 0.0) == (b.height > 0.0)


def _errors(pairs: list[tuple[Obstacle, Obstacle]]) -> list[tuple[float, float, float]]:
    return [
        (abs(f.s - t.s), abs(f.height - t.height), abs(f.height - t.height) / abs(t.height))
        for t, f in pairs
    ]
