"""A drive of any length, window by window.

A window begins in the state and on the road that the one before found an `overlap` before its own
end, where all that follows has long been heard; both are kept as they are. So the windows' roads
join in height and slope, the car moves on without a jolt, and memory is that of one window.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimators.common.block_means import block_means
from estimators.common.model_inputs import Course
from estimators.map_smoother.gauss_newton import Found
from estimators.map_smoother.objective import Belief, Problem
from estimators.map_smoother.road_prior import Road, likely, nodes
from road_envs.analysis.information_bound import RoadPrior
from road_envs.vehicle.equations import N_DOF
from road_envs.vehicle.suspension import memory_at_rest

MARGIN = 4
"""Nodes before the first and behind the last that carries a wheel."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A whole drive as it is to be explained: samples `a` (S, T) [m/s²], which of them are `used`
    (S, T), in blocks of `block`; the `course` of the car, its state at `rest` (14,) and its prior
    deviation `reach` (14,) from it at the beginning; and the nodes of the road: the station of the
    first (`start` [m]), `ds` [m] apart, and which may rise or fall (`free` (K,), 0 or 1).
    """

    a: np.ndarray
    used: np.ndarray
    block: int
    course: Course
    rest: np.ndarray
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
class Known:
    """What the windows so far have settled: coefficients `c` (2, K) [m] of the road before the node
    `first`, level from there on, and the `spread` (K,) [m] of their error; `state` (14,) of the car
    and `memory` (4, 3) of its struts where the next window begins, the state known to within
    `reach` (14,); the `level` [-] of the road's prior at `n` [cycles/m].
    """

    c: np.ndarray
    spread: np.ndarray
    first: int
    state: np.ndarray
    reach: np.ndarray
    memory: np.ndarray
    n: np.ndarray
    level: np.ndarray


def nothing_known(drive: Drive) -> Known:
    """Before the first window."""
    size = drive.free.size
    rest = drive.rest + 1e-7  # at rest to the bit friction has a kink
    memory = memory_at_rest(int(drive.course.commands[0]))
    flat = np.array([0.0, 1.0]), np.ones(2)
    return Known(np.zeros((2, size)), np.zeros(size), 0, rest, drive.reach, memory, *flat)


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
) -> tuple[Known, list[float]]:
    """What is known after all windows, and how many times the instruments' noise was left over in
    each; `solve` finds the road of one window and its spread (K,).
    """
    known, excess = nothing_known(drive), []
    for begin, after, end in windows:
        problem = problem_of(belief, drive, prior, known, begin, end)
        found, std = solve(problem)
        excess.append(found.excess)
        steps = (after - begin) * drive.unit if after < end else None
        known = _learnt(drive, prior, known, found, std, steps)
    return known, excess


def problem_of(
    belief: Belief, drive: Drive, prior: RoadPrior, known: Known, begin: int, end: int
) -> Problem:
    """The drive from the block `begin` to before the block `end`, after all that is `known`."""
    course = drive.course.part(begin * drive.unit, end * drive.unit)
    samples = slice(begin * drive.block, end * drive.block)
    heard = block_means(drive.a[:, samples], drive.used[:, samples], drive.block)
    low = drive.node(course.s[0] - belief.wheelbase) - MARGIN
    size = nodes(drive.node(course.s[-1]) + MARGIN + 1 - low)
    c, free = known.c[:, low : low + size], drive.free[low : low + size].copy()
    free[: max(known.first - low, 0)] = 0.0
    missing = size - free.size
    c, free = np.pad(c, ((0, 0), (0, missing)), mode="edge"), np.pad(free, (0, missing))
    start = drive.start + drive.ds * low
    road = Road(start, drive.ds, c, free, likely(prior, size, drive.ds))
    road = road.as_likely(np.interp(road.n, known.n, known.level))
    return Problem(belief, known.memory, known.state, known.reach, road, course, heard)


def _learnt(
    drive: Drive,
    prior: RoadPrior,
    known: Known,
    found: Found,
    std: np.ndarray,
    steps: int | None,
) -> Known:
    """What is known with a window more, of which the first `steps` are settled; None: all."""
    problem, x = found.point.problem, found.point.x
    road, size = problem.road, known.spread.size
    low = round((road.start - drive.start) / drive.ds)
    first, last = max(known.first, low), min(low + road.size, size)
    state, memory = known.state, known.memory
    if steps is not None:
        state, memory = problem.until(x, steps)
        last = drive.node(problem.course.s[2 * steps]) + 3  # those that carry the front axle now
    c, spread, here = known.c.copy(), known.spread.copy(), slice(first - low, last - low)
    c[:, first:last], spread[first:last] = (
        road.coefficients(problem.split(x)[0])[:, here],
        std[here],
    )
    c[:, last:], spread[last:] = c[:, last - 1 : last], spread[last - 1]
    level = (road.amplitude[0] / likely(prior, road.size, road.ds)[0]) ** 2
    return Known(c, spread, last, state, np.zeros(2 * N_DOF), memory, road.n, level)
