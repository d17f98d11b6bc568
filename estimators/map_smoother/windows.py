"""A drive of any length, window by window.

A window begins in the state and on the road that the one before found an `overlap` before its own
end, where all that follows has long been heard; both are kept as they are. So the windows' roads
join in height and slope, the car moves on without a jolt, and memory is that of one window.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimators.map_smoother.course import Course
from estimators.map_smoother.problem import Belief, Problem
from estimators.map_smoother.readings import readings
from estimators.map_smoother.road import Road, amplitude, nodes
from estimators.map_smoother.search import Found
from road_envs.dynamics import N_DOF
from road_envs.observability import RoadPrior
from road_envs.suspension import memory_at_rest

MARGIN = 4
"""Nodes before the first and behind the last that carries a wheel."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A whole drive as it is to be explained: samples `a` (S, T) [m/s²], which of them are `used`
    (S, T), in blocks of `block`; the `course` of the car, its `reach` (14,) from rest at the start;
    and the nodes of the road: `start` [m], `ds` [m], how many (`size`), and which may rise or fall
    (`free` (size,), 0 or 1).
    """

    a: np.ndarray
    used: np.ndarray
    block: int
    course: Course
    reach: np.ndarray
    start: float
    ds: float
    free: np.ndarray

    @property
    def unit(self) -> int:
        """Steps of a block."""
        return self.block * self.course.every

    def node(self, s: float) -> int:
        """The node at the station `s` [m] or just before."""
        return int((s - self.start) / self.ds)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Coefficients `c` (2, K) [m] of the road, the `spread` (K,) [m] of its error in the judged
    band, and how many times the instruments' noise was left over in each window.
    """

    c: np.ndarray
    spread: np.ndarray
    excess: tuple[float, ...]


def cuts(blocks: int, window: int, overlap: int) -> list[tuple[int, int, int]]:
    """Windows over `blocks`: where each begins, where the next one does, and where it ends."""
    found, begin = [], 0
    while blocks - begin > window + overlap:
        found.append((begin, begin + window - overlap, begin + window))
        begin += window - overlap
    return [*found, (begin, blocks, blocks)]


def reconstruct(
    belief: Belief,
    drive: Drive,
    prior: RoadPrior,
    windows: list[tuple[int, int, int]],
    solve: Callable[[Problem], tuple[Found, np.ndarray]],
) -> Reconstruction:
    """The road of a whole drive; `solve` finds it, and its spread (K,), in one window."""
    c, spread, excess = np.zeros((2, drive.free.size)), np.zeros(drive.free.size), []
    state, reach = np.full(2 * N_DOF, 1e-7), drive.reach  # exactly at rest friction has a kink
    memory, first = memory_at_rest(int(drive.course.commands[0])), 0
    level = np.array([0.0, 1.0]), np.ones(2)
    for begin, after, end in windows:
        course = drive.course.part(begin * drive.unit, end * drive.unit)
        part = slice(begin * drive.block, end * drive.block)
        heard = readings(drive.a[:, part], drive.used[:, part], drive.block)
        low = drive.node(course.s[0] - belief.wheelbase) - MARGIN
        first = max(first, low)
        road = _road(drive, prior, c, (low, first, drive.node(course.s[-1]) + MARGIN))
        road = road.as_likely(np.interp(road.n, *level))
        found, std = solve(Problem(belief, memory, state, reach, road, course, heard))
        excess.append(found.excess)
        final, x = found.point.problem, found.point.x
        new = final.road.coefficients(final.split(x)[0])
        level = road.n, level_of(final.road, prior)
        last = min(low + road.size, drive.free.size)
        if after < end:
            steps = (after - begin) * drive.unit
            state, memory = final.until(x, steps)
            reach, last = np.zeros(2 * N_DOF), drive.node(course.s[2 * steps]) + 3
        c[:, first:last], spread[first:last] = (
            new[:, first - low : last - low],
            std[first - low : last - low],
        )
        c[:, last:], spread[last:] = c[:, last - 1 : last], spread[last - 1]
        first = last
    return Reconstruction(c, spread, tuple(excess))


def _road(drive: Drive, prior: RoadPrior, c: np.ndarray, reach: tuple[int, int, int]) -> Road:
    """The road of a window over the nodes from `reach[0]` to `reach[2]` at least, known before
    `reach[1]` as the coefficients `c` (2, K) have it.
    """
    low, first, high = reach
    size = nodes(high + 1 - low)
    known, free = c[:, low : low + size], drive.free[low : low + size].copy()
    free[: first - low] = 0.0
    missing = size - free.size
    known, free = np.pad(known, ((0, 0), (0, missing)), mode="edge"), np.pad(free, (0, missing))
    start = drive.start + drive.ds * low
    return Road(start, drive.ds, known, free, amplitude(prior, size, drive.ds))


def level_of(road: Road, prior: RoadPrior) -> np.ndarray:
    """Density of a road's prior over that of `prior` at each of its lines."""
    return (road.amplitude[0] / amplitude(prior, road.size, road.ds)[0]) ** 2
