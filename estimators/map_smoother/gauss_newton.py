"""From no road to the most probable one: Gauss-Newton steps by conjugate gradients, from an easy
problem to the true one.

Friction turns its sign in 0.02 m/s, and a linearisation there holds for no useful step. So the
first roads are sought for a car whose dampers and friction are blurred over the rate of the strut,
as if it trembled, and less and less so; and the readings count as noisy as their misfit is large,
so that no road is made to explain what the model cannot yet. If much is left over in the end, the
car is not the one believed in: then each frequency counts as noisy as it was badly explained.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import rfftfreq
from scipy.signal import welch

from estimators.map_smoother.objective import Point, Problem, point
from estimators.map_smoother.preconditioner import Stationary
from estimators.map_smoother.wheel_liftoff import released
from road_envs.vehicle.equations import Plant
from road_envs.vehicle.force_curves import blurred
from road_envs.vehicle.suspension import V_0, V_STEP

Vector = np.ndarray
Operator = Callable[[Vector], Vector]

STAGES = ((0.3, 2), (0.1, 2), (0.03, 3), (0.0, 12))
"""Widths [m/s] of the blur, and Gauss-Newton steps at most with each."""

HALVINGS = 6

UNEXPLAINED = 2.0
"""Times the instruments' noise power from which the car is not the one believed in."""

COLOURINGS, SMOOTH = 3, 128
"""Steps under noise of the leftovers' colour, and blocks of the stretches it is taken from."""

RELEASES, RELEASED_STEPS = 2, 5
"""How often the road below wheels that fly is let down at most, and steps after each time."""


def conjugate_gradients(
    A: Operator, b: Vector, M: Operator, most: int, tolerance: float
) -> tuple[Vector, int]:
    """An approximate solution of A x = b, preconditioned by M, and the iterations it took.

    It ends after `most` iterations, or once sqrt(r' M r) has fallen to `tolerance` of the first.
    """
    x, r = np.zeros_like(b), b.copy()
    z = M(r)
    p, rz = z.copy(), float(r @ z)
    enough = tolerance**2 * rz
    for k in range(most):
        if rz <= enough:
            return x, k
        Ap = A(p)
        alpha = rz / float(p @ Ap)
        x += alpha * p
        r -= alpha * Ap
        z = M(r)
        rz, before = float(r @ z), rz
        p = z + (rz / before) * p
    return x, most


@dataclass(frozen=True, eq=False)
class Found:
    """Where the search ended: the `point`, how many times the instruments' noise the misfit makes
    of it (`excess`), and the `steps` and `iterations` it took.
    """

    point: Point
    picture: Stationary
    excess: float
    steps: int
    iterations: int


def most_probable(
    problem: Problem,
    picture: Stationary,
    *,
    iterations: int = 40,
    tolerance: float = 0.1,
    huber: float = np.inf,
    settled: float = 1e-2,
    relevel: bool = True,
    report: Callable[[str, Point], None] = lambda text, at: None,
) -> Found:
    """The most probable road, sought from none.

    `huber`: standard deviations from which a block of readings counts less. It ends when a step
    with the true car lowers the cost by less than the share `settled`.
    """
    inner = Inner(picture, huber, iterations, tolerance)
    steps, total, x = 0, 0, np.zeros(problem.size)
    information = problem.information
    excess = np.inf
    for width, most in STAGES:
        if steps > 0 and relevel:
            problem, x = releveled(problem, picture, x, excess)
        plant = problem.belief.plant if width == 0.0 else softened(problem.belief.plant, width)
        at = point(problem, x, information, plant)
        for _ in range(most):
            excess = max(1.0, min(excess, noise_level(at, picture, excess)))
            new, k = inner.step(at, plant, excess)
            steps, total = steps + 1, total + k
            gained = 1.0 - new.cost / at.weighing(new.inverse).cost
            report(f"{width} {excess:.1f} {k} {new.cost:.1f}", new)
            at = new
            if gained < settled:
                break
        x = at.x
    if excess > UNEXPLAINED:
        for _ in range(COLOURINGS):
            gain = heard(at, picture, excess)
            at = replace(at, gain=gain)
            inner = replace(inner, picture=picture.hearing(problem, gain))
            at, k = inner.step(at, plant, excess)
            steps, total = steps + 1, total + k
            report("coloured", at)
    for _ in range(RELEASES):
        better = fallen(at, inner, excess)
        if better is at:
            break
        report("released", better)
        at = better
    return Found(at, inner.picture, excess, steps, total)


@dataclass(frozen=True)
class Inner:
    """How a Gauss-Newton step is found; settings as `most_probable` has them."""

    picture: Stationary
    huber: float
    iterations: int
    tolerance: float

    def step(self, at: Point, plant: Plant, excess: float) -> tuple[Point, int]:
        """The next point under `excess` times the noise, and the iterations it took."""
        problem = at.problem
        at = at.weighing(robust(at.over, problem.information / excess, self.huber))
        M = self.picture.preconditioner(problem, problem.belief.noise * excess)
        dx, k = conjugate_gradients(at.hessian, -at.gradient(), M, self.iterations, self.tolerance)
        return line_search(at, dx, plant), k


def fallen(at: Point, inner: Inner, excess: float) -> Point:
    """Where the search ends from the road of `at` let down where no wheel pressed on it, unless
    that explains the readings worse.
    """
    x, plant = released(at), at.problem.belief.plant
    if x is None:
        return at
    try:
        new = at.at(x, plant)
    except ArithmeticError:
        return at
    for _ in range(RELEASED_STEPS):
        new, _ = inner.step(new, plant, excess)
    return new if new.weighing(at.inverse).cost < at.cost else at


def releveled(
    problem: Problem, picture: Stationary, x: Vector, excess: float
) -> tuple[Problem, Vector]:
    """The problem under the prior that its own road suggests, and `x` there, the road unchanged."""
    u, _, _ = problem.split(x)
    level = picture.levels(problem.road, problem.belief.noise * excess, u)
    road = problem.road.as_likely(level)
    u = road.whitened(u, problem.road)
    return replace(problem, road=road), np.concatenate([u.ravel(), x[u.size :]])


def line_search(at: Point, dx: Vector, plant: Plant) -> Point:
    """A point towards `dx`, half-way again and again until the cost has fallen."""
    slope, length = float(at.gradient() @ dx), 1.0
    for _ in range(HALVINGS):
        try:
            new = at.at(at.x + length * dx, plant)
        except ArithmeticError:
            length *= 0.25
            continue
        if new.cost <= at.cost + 1e-4 * length * slope:
            return new
        length *= 0.5
    return at


def noise_level(at: Point, picture: Stationary, excess: float) -> float:
    """How many times the instruments' noise is left over, for what the road could not take up."""
    problem = at.problem
    squares, used = problem.information * at.over**2, problem.readings.count > 0
    taken = (
        picture.decided(problem.road, problem.belief.noise * excess) if np.isfinite(excess) else 0.0
    )
    return float(squares[used].mean() / max(1.0 - taken / used.sum(), 0.1))


def heard(at: Point, picture: Stationary, excess: float) -> np.ndarray:
    """Gain (J // 2 + 1,) of each frequency: as little as is left over there, but never less noise
    than the instruments'.
    """
    problem = at.problem
    r, used = np.sqrt(problem.information) * at.over, problem.readings.count > 0
    left = 1.0 - picture.decided(problem.road, problem.belief.noise * excess) / used.sum()
    size = min(SMOOTH, r.shape[1])
    f, S = welch(r, fs=1.0, nperseg=size)
    level = np.maximum(0.5 * S.mean(axis=0) / max(left, 0.1), 1.0)
    return excess / np.interp(rfftfreq(r.shape[1]), f, level)


def robust(over: np.ndarray, inverse: np.ndarray, huber: float) -> np.ndarray:
    """The inverse of the noise, less for readings further off than `huber` standard deviations."""
    far = np.sqrt(inverse) * np.abs(over)
    return inverse * np.minimum(1.0, huber / np.maximum(far, 1e-12))


def softened(plant: Plant, width: float) -> Plant:
    """The car with dampers and friction as they are on average if the rate trembles by `width`."""
    return Plant(plant.numbers, blurred(plant.velocity, V_0, V_STEP, width), plant.displacement)
