"""Gauss-Newton minimization of the objective, with graduated friction and adaptive noise.

Friction changes sign within 0.02 m/s, so a linearization holds for very small steps only. The first
steps therefore use dampers and friction smoothed over the strut rate, by less and less (graduated
optimization), and the noise is inflated to the size of the residual, so that the road does not fit
what the model cannot explain yet. If the residual remains large, the vehicle differs from the
model: then the noise is inflated frequency by frequency.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.fft import rfftfreq
from scipy.signal import welch

from estimators.common.conjugate_gradients import Operator, conjugate_gradients
from estimators.map_smoother.objective import Linearization, Objective
from estimators.map_smoother.preconditioner import StationaryHessian
from estimators.map_smoother.wheel_liftoff import passed_nodes, relax_unloaded
from road_envs.vehicle.equations import Plant
from road_envs.vehicle.force_curves import gaussian_smoothed
from road_envs.vehicle.suspension import V_0, V_STEP

Vector = np.ndarray

FRICTION_STAGES = ((0.3, 2), (0.1, 2), (0.03, 2), (0.0, 12))
"""Standard deviation [m/s] of the smoothing, and the most Gauss-Newton steps with it."""

CHANGE_TOLERANCE = 0.4
"""Root mean square change of the unknowns by a step, in units of their posterior standard
deviations, below which the minimization ends. Smaller ones hardly lower the error any more: it is
that of the posterior itself. On roads with obstacles the steps remain larger for longer."""

UNEVEN_ITERATIONS = 3
"""Factor on the most conjugate gradient iterations of a step where the road is rough in places: the
preconditioner knows it less well there, and over 150 m of potholes a third of this leaves the road
far from its optimum."""

SETTLED = 0.95
"""Share of the noise scale before a step from which on it counts as settled. A noise scale above
NOISE_SCALE_WARNING that still falls is that of an unfinished road, not of another vehicle: of
measurements with a narrow band the road takes most, and what it has not taken yet weighs more."""

MAX_HALVINGS = 6
"""Halvings of a step in the line search, at most."""

NOISE_SCALE_WARNING = 2.0
"""Noise scale above which the vehicle counts as different from the model."""

REWEIGHTING_STEPS, WELCH_SEGMENT = 3, 128
"""Steps under frequency-dependent noise, and blocks in a segment of the residual's periodogram."""

PRIOR_UPDATES = 6
"""Updates of the prior between the steps with the true friction, at most."""

MAX_NOISE_POWER = 50.0
"""Greatest mean square of the road's noise u under a prior that was updated, over that before or
over 1, its expectation: up to 50, once 90, on potholes and growing defects, where a limit of 10
doubles the error; 60 to 400 on the sine sweep, 1e5 on the corrugation (seeds 71 and 72)."""

LOWERING_STEPS = (2, 5)
"""Steps with the true friction before which the road under lifted wheels is lowered if it has
obstacles: their edges are then found by the steps that follow."""

MAX_LIFTOFF_RETRIES, LIFTOFF_STEPS = 2, 5
"""Largest number of times that another road under lifted wheels is tried, and steps after each."""


@dataclass(frozen=True, eq=False)
class MapSolution:
    """Result of the minimization: the final `linearization`, the preconditioner's `stationary`
    Hessian, and the `noise_scale` on the instruments' noise variance.
    """

    linearization: Linearization
    stationary: StationaryHessian
    noise_scale: float

    def inverse_hessian(self, max_iterations: int, tolerance: float) -> Operator:
        """Return x(b) (n,), the solution of H x = b by preconditioned conjugate gradients."""
        objective = self.linearization.objective
        M = self.stationary.preconditioner(objective, objective.noise_variance * self.noise_scale)
        H, limits = self.linearization.hessian_product, (max_iterations, tolerance)
        return lambda b: conjugate_gradients(H, b, M, *limits)[0]


def minimize(
    objective: Objective,
    solver: "GaussNewton",
    *,
    change_tolerance: float = CHANGE_TOLERANCE,
    adapt_prior: bool = True,
    start: Vector | None = None,
    stages: Sequence[tuple[float, int]] = FRICTION_STAGES,
    prior_updates: int = PRIOR_UPDATES,
    adapt_car: "Callable[[MapSolution, GaussNewton], MapSolution] | None" = None,
) -> MapSolution:
    """Minimize the objective, of one pass or of several, from a level road or `start` on.

    The prior is updated before each of the `stages` and between steps with the true vehicle, there
    at most `prior_updates` times. Ends when such a step changes the unknowns by less than
    `change_tolerance`. `adapt_car`, if given, then returns the solution with another vehicle.
    """
    stationary, noise_scale = solver.stationary, np.inf
    lin: Any = None
    x = np.zeros(objective.size) if start is None else start
    for std, max_steps in stages:
        if lin is not None:
            lin = update_prior(lin, stationary, noise_scale) if adapt_prior else lin
            objective, x = lin.objective, lin.x
        plant = objective.plant if std == 0.0 else smooth_friction(objective.plant, std)
        lin = objective.linearize(x, plant)
        noise_scale = update_noise_scale(lin, stationary, noise_scale)
        for n in range(max_steps):
            updates = prior_updates if std == 0.0 and adapt_prior else 0
            if 0 < n <= updates:
                if n in LOWERING_STEPS and lin.objective.road.is_level_between_obstacles:
                    lin = lower_under_lifted_wheels(lin)
                lin = update_prior(lin, stationary, noise_scale)
            lin, change = solver.step(lin, noise_scale, plant)
            before = np.max(noise_scale)
            noise_scale = update_noise_scale(lin, stationary, noise_scale)
            to_come = lin.objective.road.is_level_between_obstacles and n < min(
                LOWERING_STEPS[-1], updates
            )
            is_falling = NOISE_SCALE_WARNING < before and np.max(noise_scale) < SETTLED * before
            if change < change_tolerance and not (to_come or is_falling):
                break
    if adapt_car is not None:
        found = adapt_car(MapSolution(lin, stationary, noise_scale), solver)
        lin, stationary, noise_scale = found.linearization, found.stationary, found.noise_scale
        solver = replace(solver, stationary=stationary)
    if np.max(noise_scale) > NOISE_SCALE_WARNING:
        for _ in range(REWEIGHTING_STEPS):
            weights = estimate_frequency_weights(lin, stationary, noise_scale)
            lin = lin.with_frequency_weights(weights)
            solver = replace(solver, stationary=stationary.reweighted(lin.objective, weights))
            lin, _ = solver.step(lin, noise_scale)
    for _ in range(MAX_LIFTOFF_RETRIES):
        better = retry_after_liftoff(lin, solver, noise_scale)
        if better is lin:
            break
        lin = better
    return MapSolution(lin, solver.stationary, noise_scale)


@dataclass(frozen=True)
class GaussNewton:
    """Gauss-Newton steps, by conjugate gradients that `stationary` preconditions.

    `huber`: standard deviations beyond which a block mean is down-weighted.
    """

    stationary: StationaryHessian
    huber: float = np.inf
    cg_iterations: int = 40
    cg_tolerance: float = 0.1

    def step(
        self, lin: Linearization, noise_scale: float, plant: Plant | None = None
    ) -> tuple[Linearization, float]:
        """Return the next point, for the objective's `plant` or another, under `noise_scale` times
        the noise; and the root mean square change of the resolved unknowns in posterior standard
        deviations.
        """
        lin = lin.with_inverse_variance(lin.per_pass(self._weights, noise_scale))
        noise_variance = lin.objective.noise_variance * noise_scale
        M = self.stationary.preconditioner(lin.objective, noise_variance)
        is_uneven = lin.objective.road.is_uneven
        limits = self.cg_iterations * (UNEVEN_ITERATIONS if is_uneven else 1), self.cg_tolerance
        gradient = lin.gradient()
        dx, _ = conjugate_gradients(lin.hessian_product, -gradient, M, *limits)
        slope = float(gradient @ dx)
        road, others = lin.objective.road, lin.objective.size - 2 * lin.objective.road.size
        dof = np.sum(self.stationary.effective_dof(road, noise_variance)) + others
        # conjugate gradients leave dx' H dx = -slope
        return line_search(lin, dx, slope, plant), float(np.sqrt(-slope / dof))

    def _weights(self, lin: Linearization, noise_scale: float) -> np.ndarray:
        return huber_weights(lin.residual, lin.objective.information / noise_scale, self.huber)


def lower_under_lifted_wheels(lin: Linearization) -> Linearization:
    """Return the linearization on the road lowered where no wheel pressed on it."""
    x = relax_unloaded(lin)
    return lin if x is None else lin.relinearize(x)


def retry_after_liftoff(
    lin: Linearization, solver: GaussNewton, noise_scale: float
) -> Linearization:
    """Return the optimum from the road lowered where no wheel pressed on it, if it costs less.

    A road with obstacles has been lowered before.
    """
    if lin.objective.road.is_level_between_obstacles:
        return lin
    x = relax_unloaded(lin)
    if x is None:
        return lin
    try:
        new = lin.relinearize(x)
    except ArithmeticError:
        return lin
    for _ in range(LIFTOFF_STEPS):
        new, _ = solver.step(new, noise_scale)
    return new if new.with_inverse_variance(lin.inverse_variance).cost < lin.cost else lin


def update_prior(
    lin: Linearization, stationary: StationaryHessian, noise_scale: float
) -> Linearization:
    """Return the linearization under the prior that its own road suggests; the same road.

    The prior stays if the road would be most improbable under the other one: where a road is a
    single wave the prior would allow hardly any other, and the next step would go anywhere.
    """
    objective, x = lin.objective, lin.x
    u, _, _ = objective.split(x)
    noise_variance = objective.noise_variance * noise_scale
    scale = stationary.density_scale(objective.road, noise_variance, u)
    road = objective.road.scale_density(scale)
    u = road.convert_noise(u, objective.road)
    local = stationary.local_roughness(road, noise_variance, u, passed_nodes(lin))
    rough = replace(road, local=local)
    new = lin.with_road(rough, rough.convert_noise(u, road))
    most = MAX_NOISE_POWER * max(float(x @ x), objective.size)
    return new if float(new.x @ new.x) < most else lin


def line_search(lin: Linearization, dx: Vector, slope: float, plant: Plant | None) -> Linearization:
    """Return a point along `dx` by backtracking: the step is halved until the cost has fallen.

    `slope` of the cost along `dx`.
    """
    length = 1.0
    for _ in range(MAX_HALVINGS):
        try:
            new = lin.relinearize(lin.x + length * dx, plant)
        except ArithmeticError:
            length *= 0.25  # the motion was not finite
            continue
        if new.cost <= lin.cost + 1e-4 * length * slope:
            return new
        length *= 0.5
    return lin


def update_noise_scale(
    lin: Linearization, stationary: StationaryHessian, noise_scale: float
) -> float:
    """Return the residual's power over the instruments' noise, for the degrees of freedom left.

    It never rises above `noise_scale`, nor falls below 1.
    """
    noise_variance = lin.objective.noise_variance * noise_scale
    dof = stationary.effective_dof(lin.objective.road, noise_variance)
    return np.maximum(1.0, np.minimum(noise_scale, lin.per_pass(_noise_scale, dof)))


def _noise_scale(lin: Linearization, dof: float) -> float:
    objective = lin.objective
    squares, used = objective.information * lin.residual**2, objective.measurements.sample_count > 0
    share = objective.band_share
    return float(squares[used].mean() / (share * max(1.0 - dof / (share * used.sum()), 0.1)))


def estimate_frequency_weights(
    lin: Linearization, stationary: StationaryHessian, noise_scale: float
) -> np.ndarray:
    """Return the weight (J // 2 + 1,) of each frequency: noise as large as the residual is there,
    but never less than that of the instruments.
    """
    noise_variance = lin.objective.noise_variance * noise_scale
    dof = stationary.effective_dof(lin.objective.road, noise_variance)
    return lin.per_pass(_frequency_weights, dof, noise_scale)


def _frequency_weights(lin: Linearization, dof: float, noise_scale: float) -> np.ndarray:
    objective = lin.objective
    r, used = np.sqrt(objective.information) * lin.residual, objective.measurements.sample_count > 0
    left = 1.0 - dof / (objective.band_share * used.sum())
    size = min(WELCH_SEGMENT, r.shape[1])
    f, S = welch(r, fs=1.0, nperseg=size)
    level = np.maximum(0.5 * S.mean(axis=0) / max(left, 0.1), 1.0)
    return noise_scale / np.interp(rfftfreq(r.shape[1]), f, level)


def huber_weights(residual: np.ndarray, inverse_variance: np.ndarray, huber: float) -> np.ndarray:
    """Return `inverse_variance`, reduced where residuals exceed `huber` standard deviations."""
    deviation = np.sqrt(inverse_variance) * np.abs(residual)
    return inverse_variance * np.minimum(1.0, huber / np.maximum(deviation, 1e-12))


def smooth_friction(plant: Any, std: float) -> Any:
    """Return the plant, or a list of several, with its rate laws averaged over a Gaussian of
    deviation `std` [m/s].
    """
    if isinstance(plant, list):
        return [smooth_friction(one, std) for one in plant]
    velocity = gaussian_smoothed(plant.velocity, V_0, V_STEP, std)
    return Plant(plant.constants, velocity, plant.displacement)
