"""Single obstacles in an estimated road: humps, bumps and potholes between the waves of a road.

A profile is compared with straight lines between its own points, as with a straightedge: of span L,

    d(s) = z(s) - [z(s - L/2) + z(s + L/2)] / 2

The slopes of a random road are nearly white, so d grows with the square root of the span only, and
an obstacle is where |d| exceeds _MIN_HEIGHT and the scatter of the surrounding road at some span.
The line under it is that between its feet on either side; its height is that of its top over the
line, its length the distance over which it exceeds half of that. It is replaced by its line before
the next one is looked for, so that it leaves no side lobes.

The confidence is the probability that a wheel path of 100 m of random road, with the scatter of the
surrounding profile and the error of the estimate, nowhere departs by as much. The largest departure
over 100 m and all spans has a Gumbel distribution, whose constants are the same for roads of any
level:

    exp(-exp(-(x - _GUMBEL_LOCATION) / _GUMBEL_SCALE)),     x = |d| / sqrt(road² + error²)
"""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from leaderboard.metrics.obstacles import MERGE_GAP
from road_envs.records.record import Estimate

_SPANS = (0.6, 1.0, 1.6, 2.5, 4.0, 6.3)  # [m] of the straightedge: potholes to speed humps
_SCATTER_LENGTH = 60.0  # window [m] of the scatter of the random road around an obstacle
_MIN_HEIGHT = 0.015  # least height [m] of an obstacle
_MIN_CONFIDENCE, CERTAIN = 0.95, 0.99  # obstacles below are left out, called possible
FALSE_ALARMS = {"C": (0.37, 0.03), "D": (1.5, 0.15)}
"""Obstacles per km that are listed on random roads of an ISO 8608 class, and those of them that are
not called possible; a slow test of `tests/unit/test_drive_report.py` counts them on 60 km.
"""

_FOOT, _FOOT_WIDTH, _MIN_FOOT_WIDTH = 0.25, 0.15, 0.2
"""The foot of an obstacle is this share of its length beyond half its height, where a half sine
ends; its height is the median over this share of the length, and at least this length [m].
"""

_TOP = 0.2  # highest share of an obstacle, whose mean is its height: not the waves upon it
_READINGS = 3  # iterations that find feet and line, each by the line before
HEIGHT_STD = 0.07
"""Relative standard deviation of a height by tyres that envelop an obstacle and a vehicle that is
not quite the one described, from the simulated drives of `studies/report_trial.py`.
"""

_GUMBEL_LOCATION, _GUMBEL_SCALE = 3.72, 0.30
"""Constants of the largest departure over 100 m in standard deviations, by moments from 160 times
100 m of ISO 8608 roads (w = 2); a test counts the obstacles of random roads.
"""

_MAD_TO_STD = 1.4826  # standard deviation over median absolute deviation, if normal


class DetectedObstacle(NamedTuple):
    """An obstacle: `station` of its middle, `height` (a hole is negative), its standard deviation
    by the waves of the road, and `length` over half the height [m], the wheel paths "left", "right"
    or "both", and the confidence (0 to 1).
    """

    station: float
    height: float
    height_std: float
    length: float
    side: str
    confidence: float


def detect(estimate: Estimate) -> list[DetectedObstacle]:
    """Return the obstacles of both wheel paths by station; one in both paths is one obstacle."""
    std = np.zeros_like(estimate.z) if estimate.z_std is None else estimate.z_std
    paths = zip(estimate.z, std, strict=True)
    left, right = (_highest(_detect_path(z, error, estimate.ds)) for z, error in paths)
    merged = []
    for one in left:
        near = (o for o in right if abs(o.station - one.station) < MERGE_GAP)
        twin = next((o for o in near if (o.height > 0.0) == (one.height > 0.0)), None)
        if twin is None:
            merged.append(one._replace(side="left"))
            continue
        right.remove(twin)
        confidence, names = max(one.confidence, twin.confidence), one._fields[:4]
        means: Any = {name: 0.5 * (getattr(one, name) + getattr(twin, name)) for name in names}
        merged.append(one._replace(side="both", confidence=confidence, **means))
    return sorted([*merged, *(o._replace(side="right") for o in right)])


def _highest(found: Iterable[DetectedObstacle]) -> list[DetectedObstacle]:
    """Return the highest of obstacles less than MERGE_GAP apart, which are one: an edge, or what is
    estimated where a wheel flew, departs at several places.
    """
    groups, end = list[list[DetectedObstacle]](), -np.inf
    for one in sorted(found, key=lambda one: one.station - 0.5 * one.length):
        if one.station - 0.5 * one.length - end >= MERGE_GAP:
            groups.append([])
        groups[-1].append(one)
        end = max(end, one.station + 0.5 * one.length)
    return [max(group, key=lambda one: abs(one.height)) for group in groups]


def _departures(z: np.ndarray, std: np.ndarray, ds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return d (L, M) [m] of a wheel path `z` (M,) by span, and its scatter (L, M) [m]: that of the
    road and the error `std` (M,) [m] of the estimate.
    """
    d = np.array([_departure(z, round(0.5 * span / ds)) for span in _SPANS])
    road = _MAD_TO_STD * running_median(np.abs(d), ds, _SCATTER_LENGTH, 0.2)
    # the scatter of an estimate has its share of the error; no more than as much is added
    return d, np.maximum(np.hypot(road, np.minimum(std, road)), 1e-9)


def running_median(x: np.ndarray, ds: float, window: float, step: float) -> np.ndarray:
    """Return the medians (L, M) of `x` (L, M), every `ds` [m], over a `window` [m]; they are found
    every `step` [m] and interpolated, as medians of long windows are slow.
    """
    stride = max(1, round(step / ds))
    size, k = round(window / (stride * ds)) | 1, np.arange(x.shape[1])
    medians = [median_filter(row[::stride], size, mode="reflect") for row in x]
    return np.array([np.interp(k, k[::stride], row) for row in medians])


def _departure(z: np.ndarray, half: int) -> np.ndarray:
    padded = np.pad(z, half, mode="edge")
    return z - 0.5 * (padded[: z.size] + padded[2 * half :])


def _detect_path(z: np.ndarray, std: np.ndarray, ds: float) -> Iterator[DetectedObstacle]:
    z = z.copy()
    d, scatter = _departures(z, std, ds)
    least = _GUMBEL_LOCATION - _GUMBEL_SCALE * np.log(-np.log(_MIN_CONFIDENCE))
    limit = np.maximum(_MIN_HEIGHT, least * scatter)
    halves = [round(0.5 * span / ds) for span in _SPANS]
    beyond, done = np.where(np.abs(d) > limit, np.abs(d), 0.0), np.zeros(z.size, dtype=bool)
    while beyond.any():  # the highest first: its rims depart by up to half as much
        j, peak = (int(k) for k in np.unravel_index(beyond.argmax(), beyond.shape))
        begin, end, found = _read(z, peak, halves[j], float(np.sign(d[j, peak])), ds)
        if found is not None:
            middle, height, length = found
            spread = float(scatter[np.argmin(np.abs(np.array(_SPANS) - length)), peak])
            x = float(np.abs(d[j, peak]) / scatter[j, peak])
            confidence = float(np.exp(-np.exp(-(x - _GUMBEL_LOCATION) / _GUMBEL_SCALE)))
            yield DetectedObstacle(middle, height, spread, length, "", confidence)
        z[begin : end + 1] = np.linspace(z[begin], z[end], end - begin + 1)
        low, high = max(0, begin - halves[-1]), min(z.size, end + halves[-1] + 1)
        for k, half in enumerate(halves):
            first, last = max(0, low - half), min(z.size, high + half)
            d[k, low:high] = _departure(z[first:last], half)[low - first : high - first]
        part = np.abs(d[:, low:high])
        beyond[:, low:high] = np.where(part > limit[:, low:high], part, 0.0)
        beyond[:, begin : end + 1] = 0.0
        done[peak] = True  # its feet may lie beside it
        beyond[:, done] = 0.0


def _read(
    z: np.ndarray, peak: int, half: int, sign: float, ds: float
) -> tuple[int, int, tuple[float, float, float] | None]:
    """Return the feet of the obstacle at `peak`, as indices, and its middle, height and length [m],
    None if it is too low.
    """
    first, last = max(0, peak - half), min(z.size - 1, peak + half)
    for _ in range(_READINGS):
        size = max(round(_FOOT_WIDTH * (last - first)), round(_MIN_FOOT_WIDTH / ds), 1)
        beyond = z[max(0, first - size + 1) : first + 1], z[last : last + size]
        levels = [np.median(part) for part in beyond]
        line = np.interp(np.arange(z.size), [first, last], levels)
        above = sign * (z - line)
        top = first + int(np.argmax(above[first : last + 1]))
        if above[top] <= 0.0:
            return first, last, None
        over = above > 0.5 * above[top]
        begin = top - int(np.argmin(over[top::-1])) + 1 if not over[: top + 1].all() else 0
        end = top + int(np.argmin(over[top:])) - 1 if not over[top:].all() else z.size - 1
        reach = max(1, round(_FOOT * (end - begin + 1)))
        first, last = max(0, begin - reach), min(z.size - 1, end + reach)
    highest = np.sort(above[begin : end + 1])[-max(1, round(_TOP * (end - begin + 1))) :]
    height = float(highest.mean())
    if height < _MIN_HEIGHT:
        return first, last, None
    return first, last, (0.5 * ds * (begin + end), sign * height, ds * (end - begin + 1))
