"""How far the most probable road may be off: roads drawn from the posterior.

With e_1, e_2 standard normal, the solution of (I + J' R^-1 J) x = J' R^-1/2 e_1 + e_2 is a draw
from the posterior of the linearised problem (Papandreou & Yuille 2010, "Gaussian sampling by local
perturbations"); what such roads do inside a band is what the estimate's error does there.
"""

import numpy as np
from scipy.fft import irfft, rfft

from estimators.common.model_inputs import Course
from estimators.map_smoother.gauss_newton import Found, conjugate_gradients
from estimators.map_smoother.objective import Point, coloured
from estimators.map_smoother.road_prior import Road

ITERATIONS = 40
SMALLEST = 10.0
"""Metres of road in one state of the struts from which it has a spread of its own."""

UNDERSTATED = 1.1
"""What the curvature left out and the last digits of the search add, on training roads."""


def error_spread(found: Found, band: tuple[float, float], draws: int, seed: int) -> np.ndarray:
    """Standard deviation (K,) [m] of the error inside `band` [cycles/m] at each node of the road,
    one for both wheel paths and for each state of the struts.
    """
    at, rng = found.point, np.random.default_rng(seed)
    problem, road = at.problem, at.problem.road
    precondition = found.picture.preconditioner(problem, problem.belief.noise * found.excess)
    inside = (road.n >= band[0]) & (road.n <= band[1])
    middle = _middle(road.free, round(1.0 / (band[0] * road.ds)))  # waves cut off there leak
    square = np.zeros(road.size)
    for _ in range(draws):
        b = at.transposed(noise_heard(at, rng)) + rng.standard_normal(problem.size)
        x, _ = conjugate_gradients(at.hessian, b, precondition, ITERATIONS, 1e-2)
        u, _, _ = problem.split(x)
        part = road.change(irfft(inside * rfft(road.free * u, axis=1), road.size, axis=1))
        part -= part[:, middle].mean(axis=1, keepdims=True)
        square += np.mean(part**2, axis=0) / draws
    return UNDERSTATED * np.sqrt(_by_state(square, middle, road, problem.course))


def noise_heard(at: Point, rng: np.random.Generator) -> np.ndarray:
    """R^-1/2 times white noise (S, J)."""
    white = rng.standard_normal(at.over.shape)
    return np.sqrt(at.inverse) * (white if at.gain is None else coloured(np.sqrt(at.gain), white))


def _middle(free: np.ndarray, most: int) -> np.ndarray:
    """Which nodes (K,) are free, at most `most` of them at either end left out."""
    where = np.flatnonzero(free)
    off = min(most, where.size // 4)
    inner = np.zeros(free.size, dtype=bool)
    inner[where[off : where.size - off]] = True
    return inner


def _by_state(square: np.ndarray, free: np.ndarray, road: Road, course: Course) -> np.ndarray:
    """The mean of `square` (K,) over the `free` nodes (K,) passed in the same state."""
    station = road.start + road.ds * np.arange(road.size)
    passed = np.clip(np.searchsorted(course.s[::2], station), 0, course.steps - 1)
    state = course.commands[passed]
    found = np.full(road.size, square[free].mean() if free.any() else 0.0)
    for byte in np.unique(state):
        here = state == byte
        if (here & free).sum() * road.ds >= SMALLEST:
            found[here] = square[here & free].mean()
    return found
