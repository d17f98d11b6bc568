"""Are the obstacles where they stand, as high as they are, and on the right wheel path?

A bump is a stretch of one wheel path that rises above half the height of the lowest true bump,
heights counted from the profile's median; stretches less than 0.5 m apart are one bump. It stands
at the middle of its stretch. An estimated bump is found if it is the nearest within 0.3 m of a
true bump of the same wheel path; one bump answers for one.
"""

from typing import NamedTuple

import numpy as np

TOLERANCE = 0.3  # [m]
GAP = 0.5  # [m]
LEAST = 0.02  # [m] true heights below this are no obstacles


class Bump(NamedTuple):
    """An obstacle: the station of its middle and its height, both [m]."""

    s: float
    height: float


class BumpScores(NamedTuple):
    """Shares [-]; mean absolute errors of the bumps found, NaN if none was; ghosts counted."""

    precision: float
    recall: float
    f1: float
    location_error: float  # [m]
    height_error: float  # [m]
    height_error_relative: float  # of the true height
    ghosts: int  # estimated where only the other wheel path has a bump


def find_bumps(z: np.ndarray, ds: float, threshold: float) -> list[Bump]:
    """The bumps of one wheel path `z` (M,) that rise above `threshold` [m] over its median."""
    z = z - np.median(z)
    above = np.flatnonzero(z > threshold)
    if above.size == 0:
        return []
    stretches = np.split(above, np.flatnonzero(np.diff(above) * ds > GAP) + 1)
    return [Bump(ds * (i[0] + i[-1]) / 2, float(z[i].max())) for i in stretches]


def bump_scores(y: np.ndarray, a: np.ndarray, ds: float) -> BumpScores | None:
    """Scores of estimate `a` against truth `y`, both (2, M) [m]; None if the truth has no bump."""
    heights = [bump.height for z in y for bump in find_bumps(z, ds, LEAST)]
    if not heights:
        return None
    threshold = min(heights) / 2
    true = [find_bumps(z, ds, threshold) for z in y]
    found = [find_bumps(z, ds, threshold) for z in a]
    pairs = [pair for t, f in zip(true, found, strict=True) for pair in _matches(t, f)]
    ghosts = sum(
        _near(bump, true[1 - side]) and not _near(bump, true[side])
        for side in range(2)
        for bump in found[side]
    )
    n_true, n_found = sum(map(len, true)), sum(map(len, found))
    s, height, relative = np.mean(_errors(pairs), axis=0) if pairs else (np.nan,) * 3
    return BumpScores(
        precision=len(pairs) / n_found if n_found else 0.0,
        recall=len(pairs) / n_true,
        f1=2 * len(pairs) / (n_true + n_found),
        location_error=float(s),
        height_error=float(height),
        height_error_relative=float(relative),
        ghosts=int(ghosts),
    )


def _matches(true: list[Bump], found: list[Bump]) -> list[tuple[Bump, Bump]]:
    """Pairs (true, found) at most TOLERANCE apart, nearest first, each bump in one pair."""
    pairs: list[tuple[Bump, Bump]] = []
    for t, f in sorted(((t, f) for t in true for f in found), key=lambda p: abs(p[0].s - p[1].s)):
        taken = any(t is t_ or f is f_ for t_, f_ in pairs)
        if abs(t.s - f.s) <= TOLERANCE and not taken:
            pairs.append((t, f))
    return pairs


def _near(bump: Bump, others: list[Bump]) -> bool:
    return any(abs(bump.s - other.s) <= TOLERANCE for other in others)


def _errors(pairs: list[tuple[Bump, Bump]]) -> list[tuple[float, float, float]]:
    return [
        (abs(f.s - t.s), abs(f.height - t.height), abs(f.height - t.height) / t.height)
        for t, f in pairs
    ]
