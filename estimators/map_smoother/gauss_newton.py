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

from estimators.map_smoother.objective import Linearization, Objective, linearize
from estimators.map_smoother.preconditioner import StationaryHessian
from estimators.map_smoother.wheel_liftoff import relax_unloaded
from road_envs.vehicle.equations import Plant
from road_envs.vehicle.force_curves import gaussian_smoothed
from road_envs.vehicle.suspension import V_0, V_STEP

Vector = np.ndarray
Operator = Callable[[Vector], Vector]

FRICTION_STAGES = ((0.3, 2), (0.1, 2), (0.03, 3), (0.0, 12))
"""Widths [m/s] of the blur, and Gauss-Newton steps at most with each."""

MAX_HALVINGS = 6

NOISE_SCALE_WARNING = 2.0
"""Times the instruments' noise power from which the car is not the one believed in."""

REWEIGHTING_STEPS, WELCH_SEGMENT = 3, 128
"""Steps under noise of the leftovers' colour, and blocks of the stretches it is taken from."""

MAX_LIFTOFF_RETRIES, LIFTOFF_STEPS = 2, 5
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
class Solution:
    """Where the search ended: the `linearization`, how many times the instruments' noise the misfit
    makes of it (`noise_scale`), and the `steps` and `cg_iterations` it took.
    """

    linearization: Linearization
    stationary: StationaryHessian
    noise_scale: float
    steps: int
    cg_iterations: int


def minimize(
    objective: Objective,
    stationary: StationaryHessian,
    *,
    cg_iterations: int = 40,
    cg_tolerance: float = 0.1,
    huber: float = np.inf,
    cost_tolerance: float = 1e-2,
    adapt_prior: bool = True,
    report: Callable[[str, Linearization], None] = lambda text, lin: None,
) -> Solution:
    """The most probable road, sought from none.

    `huber`: standard deviations from which a block of readings counts less. It ends when a step
    with the true car lowers the cost by less than the share `cost_tolerance`.
    """
    solver = GaussNewton(stationary, huber, cg_iterations, cg_tolerance)
    steps, total, x = 0, 0, np.zeros(objective.size)
    information = objective.information
    noise_scale = np.inf
    for width, most in FRICTION_STAGES:
        if steps > 0 and adapt_prior:
            objective, x = update_prior(objective, stationary, x, noise_scale)
        plant = (
            objective.model.plant if width == 0.0 else smooth_friction(objective.model.plant, width)
        )
        lin = linearize(objective, x, information, plant)
        for _ in range(most):
            noise_scale = max(
                1.0, min(noise_scale, estimate_noise_scale(lin, stationary, noise_scale))
            )
            new, k = solver.step(lin, plant, noise_scale)
            steps, total = steps + 1, total + k
            gained = 1.0 - new.cost / lin.with_inverse_variance(new.inverse_variance).cost
            report(f"{width} {noise_scale:.1f} {k} {new.cost:.1f}", new)
            lin = new
            if gained < cost_tolerance:
                break
        x = lin.x
    if noise_scale > NOISE_SCALE_WARNING:
        for _ in range(REWEIGHTING_STEPS):
            frequency_weights = estimate_frequency_weights(lin, stationary, noise_scale)
            lin = replace(lin, frequency_weights=frequency_weights)
            solver = replace(solver, stationary=stationary.reweighted(objective, frequency_weights))
            lin, k = solver.step(lin, plant, noise_scale)
            steps, total = steps + 1, total + k
            report("coloured", lin)
    for _ in range(MAX_LIFTOFF_RETRIES):
        better = retry_after_liftoff(lin, solver, noise_scale)
        if better is lin:
            break
        report("released", better)
        lin = better
    return Solution(lin, solver.stationary, noise_scale, steps, total)


@dataclass(frozen=True)
class GaussNewton:
    """How a Gauss-Newton step is found; settings as `minimize` has them."""

    stationary: StationaryHessian
    huber: float
    cg_iterations: int
    cg_tolerance: float

    def step(
        self, lin: Linearization, plant: Plant, noise_scale: float
    ) -> tuple[Linearization, int]:
        """The next point under `noise_scale` times the noise, and the iterations it took."""
        objective = lin.objective
        lin = lin.with_inverse_variance(
            huber_weights(lin.residual, objective.information / noise_scale, self.huber)
        )
        M = self.stationary.preconditioner(objective, objective.model.noise_variance * noise_scale)
        dx, k = conjugate_gradients(
            lin.hessian_product, -lin.gradient(), M, self.cg_iterations, self.cg_tolerance
        )
        return line_search(lin, dx, plant), k


def retry_after_liftoff(
    lin: Linearization, solver: GaussNewton, noise_scale: float
) -> Linearization:
    """Where the search ends from the road of `lin` let down where no wheel pressed on it, unless
    that explains the readings worse.
    """
    x, plant = relax_unloaded(lin), lin.objective.model.plant
    if x is None:
        return lin
    try:
        new = lin.relinearize(x, plant)
    except ArithmeticError:
        return lin
    for _ in range(LIFTOFF_STEPS):
        new, _ = solver.step(new, plant, noise_scale)
    return new if new.with_inverse_variance(lin.inverse_variance).cost < lin.cost else lin


def update_prior(
    objective: Objective, stationary: StationaryHessian, x: Vector, noise_scale: float
) -> tuple[Objective, Vector]:
    """The problem under the prior that its own road suggests, and `x` there, the road unchanged."""
    u, _, _ = objective.split(x)
    level = stationary.density_scale(
        objective.road, objective.model.noise_variance * noise_scale, u
    )
    road = objective.road.scale_density(level)
    u = road.convert_noise(u, objective.road)
    return replace(objective, road=road), np.concatenate([u.ravel(), x[u.size :]])


def line_search(lin: Linearization, dx: Vector, plant: Plant) -> Linearization:
    """A point towards `dx`, half-way again and again until the cost has fallen."""
    slope, length = float(lin.gradient() @ dx), 1.0
    for _ in range(MAX_HALVINGS):
        try:
            new = lin.relinearize(lin.x + length * dx, plant)
        except ArithmeticError:
            length *= 0.25
            continue
        if new.cost <= lin.cost + 1e-4 * length * slope:
            return new
        length *= 0.5
    return lin


def estimate_noise_scale(
    lin: Linearization, stationary: StationaryHessian, noise_scale: float
) -> float:
    """How many times the instruments' noise is left over, for what the road could not take up."""
    objective = lin.objective
    squares, used = objective.information * lin.residual**2, objective.measurements.sample_count > 0
    taken = (
        stationary.effective_dof(objective.road, objective.model.noise_variance * noise_scale)
        if np.isfinite(noise_scale)
        else 0.0
    )
    return float(squares[used].mean() / max(1.0 - taken / used.sum(), 0.1))


def estimate_frequency_weights(
    lin: Linearization, stationary: StationaryHessian, noise_scale: float
) -> np.ndarray:
    """Gain (J // 2 + 1,) of each frequency: as little as is left over there, but never less noise
    than the instruments'.
    """
    objective = lin.objective
    r, used = np.sqrt(objective.information) * lin.residual, objective.measurements.sample_count > 0
    left = (
        1.0
        - stationary.effective_dof(objective.road, objective.model.noise_variance * noise_scale)
        / used.sum()
    )
    size = min(WELCH_SEGMENT, r.shape[1])
    f, S = welch(r, fs=1.0, nperseg=size)
    level = np.maximum(0.5 * S.mean(axis=0) / max(left, 0.1), 1.0)
    return noise_scale / np.interp(rfftfreq(r.shape[1]), f, level)


def huber_weights(residual: np.ndarray, inverse_variance: np.ndarray, huber: float) -> np.ndarray:
    """The inverse of the noise, less for readings further off than `huber` standard deviations."""
    far = np.sqrt(inverse_variance) * np.abs(residual)
    return inverse_variance * np.minimum(1.0, huber / np.maximum(far, 1e-12))


def smooth_friction(plant: Plant, width: float) -> Plant:
    """The car with dampers and friction as they are on average if the rate trembles by `width`."""
    return Plant(
        plant.constants, gaussian_smoothed(plant.velocity, V_0, V_STEP, width), plant.displacement
    )
