"""Single obstacles in an estimated road: humps, bumps and potholes between the waves of a road.

The level of a wheel path is its running median over LEVEL_LENGTH; an obstacle is where the profile
leaves it by more than MIN_HEIGHT and by more than the random road does. Its height is that of its
peak over the level, its length the distance over which it exceeds half of that.

The confidence is the probability that a wheel path of 100 m of random road, with the scatter of the
surrounding profile and the error of the estimate, nowhere leaves its level by as much. The largest
departure over 100 m has a Gumbel distribution, whose constants are the same for roads of any level:

    exp(-exp(-(z - GUMBEL_LOCATION) / GUMBEL_SCALE)),     z = |height| / sqrt(road² + error²)
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from leaderboard.metrics.obstacles import MERGE_GAP
from road_envs.data.record import Estimate

LEVEL_LENGTH = 10.0
"""Window [m] of the running median: more than twice the length of a hump."""

SCATTER_LENGTH = 60.0
"""Window [m] of the scatter of the random road around an obstacle."""

MIN_HEIGHT = 0.015
"""Least height [m] of an obstacle."""

MIN_CONFIDENCE = 0.95
"""Obstacles of a lower confidence are left out."""

SIDE_LOBE_REACH, SIDE_LOBE_SHARE = 5.0, 0.5
"""An obstacle closer than this [m] to one that is higher is a side lobe of it if it has less than
this share of its height: the band of an estimate is limited, so obstacles ring.
"""

GUMBEL_LOCATION, GUMBEL_SCALE = 3.75, 0.57
"""Constants of the largest departure over 100 m in standard deviations, by moments from 180 times
100 m of ISO 8608 roads (w = 2); a test counts the obstacles of random roads.
"""

MAD_TO_STD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


class DetectedObstacle(NamedTuple):
    """An obstacle: `station` of its middle, `height` (a hole is negative) and `length` [m], the
    wheel paths "left", "right" or "both", and the confidence (0 to 1).
    """

    station: float
    height: float
    length: float
    side: str
    confidence: float


def detect(estimate: Estimate) -> list[DetectedObstacle]:
    """Return the obstacles of both wheel paths by station; one in both paths is one obstacle."""
    std = np.zeros_like(estimate.z) if estimate.z_std is None else estimate.z_std
    left, right = (_detect_path(z, e, estimate.ds) for z, e in zip(estimate.z, std, strict=True))
    merged = []
    for one in left:
        twin = next((o for o in right if _is_same(one, o)), None)
        if twin is None:
            merged.append(one._replace(side="left"))
            continue
        right.remove(twin)
        merged.append(
            DetectedObstacle(
                0.5 * (one.station + twin.station),
                0.5 * (one.height + twin.height),
                0.5 * (one.length + twin.length),
                "both",
                max(one.confidence, twin.confidence),
            )
        )
    found = sorted([*merged, *(o._replace(side="right") for o in right)])
    return [one for one in found if not any(_is_side_lobe(one, other) for other in found)]


def _detect_path(z: np.ndarray, std: np.ndarray, ds: float) -> list[DetectedObstacle]:
    stride = max(1, round(0.1 / ds))  # medians of long windows are slow
    coarse = median_filter(z[::stride], round(LEVEL_LENGTH / (stride * ds)) | 1, mode="nearest")
    k = np.arange(z.size)
    above = z - np.interp(k, k[::stride], coarse)
    window = round(SCATTER_LENGTH / (stride * ds)) | 1
    mad = median_filter(np.abs(above[::stride]), window, mode="reflect")
    scatter = np.hypot(MAD_TO_STD * np.interp(k, k[::stride], mad), std)
    found = []
    for sign in (1.0, -1.0):
        beyond = np.flatnonzero(sign * above > np.maximum(MIN_HEIGHT, 2.0 * scatter))
        for part in np.split(beyond, np.flatnonzero(np.diff(beyond) * ds > MERGE_GAP) + 1):
            if not part.size:
                continue
            peak = part[np.argmax(sign * above[part])]
            height = float(above[peak])
            half = sign * above > 0.5 * abs(height)
            first = peak - int(np.argmin(half[peak::-1])) + 1
            last = peak + int(np.argmin(half[peak:])) - 1
            confidence = _confidence(abs(height), float(scatter[peak]))
            if confidence >= MIN_CONFIDENCE:
                middle, length = 0.5 * ds * (first + last), ds * (last - first + 1)
                found.append(DetectedObstacle(middle, height, length, "", confidence))
    return sorted(found)


def _confidence(height: float, scatter: float) -> float:
    z = height / max(scatter, 1e-9)
    return float(np.exp(-np.exp(-(z - GUMBEL_LOCATION) / GUMBEL_SCALE)))


def _is_side_lobe(one: DetectedObstacle, other: DetectedObstacle) -> bool:
    near = abs(one.station - other.station) < SIDE_LOBE_REACH
    return near and abs(one.height) < SIDE_LOBE_SHARE * abs(other.height)


def _is_same(a: DetectedObstacle, b: DetectedObstacle) -> bool:
    return abs(a.station - b.station) < MERGE_GAP and (a.height > 0.0) == (b.height > 0.0)
