"""Gauss-Newton minimization of the objective, with graduated friction and adaptive noise.

Friction changes sign within 0.02 m/s, so a linearization holds for very small steps only. The first
steps therefore use dampers and friction smoothed over the strut rate, by less and less (graduated
optimization), and the noise is inflated to the size of the residual, so that the road does not fit
what the model cannot explain yet. If the residual remains large, the vehicle differs from the
model: then the noise is inflated frequency by frequency.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import rfftfreq
from scipy.signal import welch

from estimators.common.conjugate_gradients import Operator, conjugate_gradients
from estimators.common.misfit import NOISE_SCALE_WARNING
from estimators.map_smoother.objective import Linearization, Objective
from estimators.map_smoother.one_pass import LinearizedPass
from estimators.map_smoother.preconditioner import StationaryHessian
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.wheel_liftoff import passed_nodes, relax_unloaded
from road_envs.vehicle.equations import Plant
from road_envs.vehicle.force_curves import gaussian_smoothed
from road_envs.vehicle.suspension import V_0, V_STEP

Vector = np.ndarray


@dataclass(frozen=True, eq=False)
class MapSolution:
    """Result of the minimization: the final `linearization`, the preconditioner's `stationary`
    Hessian, and the `noise_scale` (P,) on the noise variance of the instruments of each pass.
    """

    linearization: Linearization
    stationary: StationaryHessian
    noise_scale: np.ndarray

    @property
    def noise_variance(self) -> np.ndarray:
        """Variance (P,) [(m/s²)²] of a sample in each pass, by all that stays unexplained."""
        return self.linearization.objective.noise_variance * self.noise_scale

    def of_pass(self, k: int) -> "MapSolution":
        """Return the solution of the pass `k` alone, on the same road."""
        lin, stationary = self.linearization.of_pass(k), self.stationary.of_pass(k)
        return MapSolution(lin, stationary, self.noise_scale[k : k + 1])

    def inverse_hessian(self, max_iterations: int, tolerance: float) -> Operator:
        """Return x(b) (n,), the solution of H x = b by preconditioned conjugate gradients."""
        lin = self.linearization
        M = self.stationary.preconditioner(lin, self.noise_variance)
        H, limits = lin.hessian_product, (max_iterations, tolerance)
        return lambda b: conjugate_gradients(H, b, M, *limits)[0]


def minimize(
    objective: Objective,
    solver: "GaussNewton",
    *,
    change_tolerance: float = TUNING.change_tolerance,
    adapt_prior: bool = True,
    start: Vector | None = None,
    stages: Sequence[tuple[float, int]] = TUNING.friction_stages,
    prior_updates: int = TUNING.prior_updates,
    adapt_car: "Callable[[MapSolution, GaussNewton], MapSolution] | None" = None,
) -> MapSolution:
    """Minimize the objective from a level road or `start` on.

    The prior is updated before each of the `stages` and between steps with the true vehicle, there
    at most `prior_updates` times. Ends when such a step changes the unknowns by less than
    `change_tolerance`. `adapt_car`, if given, then returns the solution with another vehicle.

    What a wrong vehicle leaves is taken for obstacles as well, and a prior that is rough there
    confirms it. Where much is unexplained on a road that is rough in places, it is therefore sought
    on one that is equally rough everywhere, too; always where a road can explain all readings.
    """
    options = change_tolerance, adapt_prior, start, stages, prior_updates
    lin, noise_scale = _descend(objective, solver, *options)
    is_doubtful = objective.is_underdetermined or np.max(noise_scale) > NOISE_SCALE_WARNING
    if lin.objective.road.is_uneven and is_doubtful:
        even = replace(objective, road=replace(objective.road, may_be_uneven=False))
        other, other_scale = _descend(even, solver, *options)
        if _is_likelier(other, lin):
            lin, noise_scale = other, other_scale
    stationary = solver.stationary
    if adapt_car is not None:
        found = adapt_car(MapSolution(lin, stationary, noise_scale), solver)
        lin, stationary, noise_scale = found.linearization, found.stationary, found.noise_scale
        solver = replace(solver, stationary=stationary)
    if np.max(noise_scale) > NOISE_SCALE_WARNING and not objective.is_underdetermined:
        for _ in range(TUNING.reweighting_steps):
            weights = _estimate_frequency_weights(lin, stationary, noise_scale)
            lin = lin.with_frequency_weights(weights)
            solver = replace(solver, stationary=stationary.reweighted(lin.objective, weights))
            lin, _ = solver.step(lin, noise_scale)
    for _ in range(TUNING.max_liftoff_retries):
        better = _retry_after_liftoff(lin, solver, noise_scale)
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
        self, lin: Linearization, noise_scale: np.ndarray, plants: Sequence[Plant] | None = None
    ) -> tuple[Linearization, float]:
        """Return the next point, for the vehicles of the passes or other `plants`, under
        `noise_scale` times the noise; and the root mean square change of the resolved unknowns in
        posterior standard deviations.
        """
        weights = [
            _huber_weights(one.residual, one.source.information / scale, self.huber)
            for one, scale in zip(lin.passes, noise_scale, strict=True)
        ]
        lin = lin.with_inverse_variance(weights)
        noise_variance = lin.objective.noise_variance * noise_scale
        M = self.stationary.preconditioner(lin, noise_variance)
        is_uneven = lin.objective.road.is_uneven
        more = TUNING.uneven_iterations if is_uneven else 1
        limits = more * self.cg_iterations, self.cg_tolerance
        gradient = lin.gradient()
        dx, _ = conjugate_gradients(lin.hessian_product, -gradient, M, *limits)
        slope = float(gradient @ dx)
        road, others = lin.objective.road, lin.objective.size - 2 * lin.objective.road.size
        dof = np.sum(self.stationary.effective_dof(road, noise_variance)) + others
        # conjugate gradients leave dx' H dx = -slope
        return _line_search(lin, dx, slope, plants), float(np.sqrt(-slope / dof))


def _retry_after_liftoff(
    lin: Linearization, solver: GaussNewton, noise_scale: np.ndarray
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
    for _ in range(TUNING.liftoff_steps):
        new, _ = solver.step(new, noise_scale)
    return new if new.with_inverse_variance(lin.inverse_variance).cost < lin.cost else lin


def _descend(
    objective: Objective,
    solver: "GaussNewton",
    change_tolerance: float,
    adapt_prior: bool,
    start: Vector | None,
    stages: Sequence[tuple[float, int]],
    prior_updates: int,
) -> tuple[Linearization, np.ndarray]:
    """Return where the steps of `minimize` end, and the noise scale (P,) of each pass."""
    stationary, noise_scale = solver.stationary, np.full(len(objective.passes), np.inf)
    lin: Linearization | None = None
    best: Linearization | None = None  # where a road can explain all readings
    x = np.zeros(objective.size) if start is None else start
    for std, max_steps in stages:
        if lin is not None:
            lin = update_prior(lin, stationary, noise_scale) if adapt_prior else lin
            objective, x = lin.objective, lin.x
        plants = [_smooth_friction(plant, std) for plant in objective.plants]
        lin = objective.linearize(x, plants)
        noise_scale = update_noise_scale(lin, stationary, noise_scale)
        for n in range(max_steps):
            updates = prior_updates if std == 0.0 and adapt_prior else 0
            if 0 < n <= updates:
                if n in TUNING.lowering_steps and lin.objective.road.is_level_between_obstacles:
                    lowered = relax_unloaded(lin)
                    lin = lin if lowered is None else lin.relinearize(lowered)
                lin = update_prior(lin, stationary, noise_scale)
            lin, change = solver.step(lin, noise_scale, plants)
            before = np.max(noise_scale)
            noise_scale = update_noise_scale(lin, stationary, noise_scale)
            if std == 0.0 and objective.is_underdetermined:
                power = misfit_power(lin)
                least = np.maximum(1.0, TUNING.least_noise * power)
                noise_scale = np.maximum(least, np.minimum(noise_scale, TUNING.noise_fall * before))
                if best is None or power.max() < misfit_power(best).max():
                    best = lin
            to_come = lin.objective.road.is_level_between_obstacles and n < min(
                TUNING.lowering_steps[-1], updates
            )
            is_falling = (
                NOISE_SCALE_WARNING < before and np.max(noise_scale) < TUNING.settled * before
            )
            if change < change_tolerance and not (to_come or is_falling):
                break
    assert lin is not None
    if best is not None:
        lin, noise_scale = best, np.maximum(1.0, misfit_power(best))
    return lin, noise_scale


def update_prior(
    lin: Linearization, stationary: StationaryHessian, noise_scale: np.ndarray
) -> Linearization:
    """Return the linearization under the prior that its own road suggests; the same road.

    The prior stays if the road would be most improbable under the other one: where a road is a
    single wave the prior would allow hardly any other, and the next step would go anywhere.
    """
    objective, x = lin.objective, lin.x
    u = objective.split(x)[0]
    noise_variance = objective.noise_variance * noise_scale
    density = stationary.density_of(objective.road, noise_variance, u)
    road = replace(objective.road, density=density)
    u = road.convert_noise(u, objective.road)
    if not road.may_be_uneven:
        return lin.with_road(road, u)
    local = stationary.local_roughness(road, noise_variance, u, passed_nodes(lin))
    rough = replace(road, local=local)
    new = lin.with_road(rough, rough.convert_noise(u, road))
    most = TUNING.max_noise_power * max(float(x @ x), objective.size)
    return new if float(new.x @ new.x) < most else lin


def _line_search(
    lin: Linearization, dx: Vector, slope: float, plants: Sequence[Plant] | None
) -> Linearization:
    """Return a point along `dx` by backtracking: the step is halved until the cost has fallen.

    `slope` of the cost along `dx`.
    """
    length = 1.0
    for _ in range(TUNING.max_halvings):
        try:
            new = lin.relinearize(lin.x + length * dx, plants)
        except ArithmeticError:
            length *= 0.25  # the motion was not finite
            continue
        if new.cost <= lin.cost + 1e-4 * length * slope:
            return new
        length *= 0.5
    return lin


def update_noise_scale(
    lin: Linearization, stationary: StationaryHessian, noise_scale: np.ndarray
) -> np.ndarray:
    """Power (P,) of the residual over the instruments' noise, for the degrees of freedom left.

    It never rises above `noise_scale`, nor falls below 1.
    """
    noise_variance = lin.objective.noise_variance * noise_scale
    dof = stationary.effective_dof(lin.objective.road, noise_variance)
    scales = [_noise_scale(one, share) for one, share in zip(lin.passes, dof, strict=True)]
    return np.maximum(1.0, np.minimum(noise_scale, scales))


def _is_likelier(even: Linearization, uneven: Linearization) -> bool:
    """Return whether an `even` road is to be preferred: if it leaves much less, or, where a road
    can explain all readings, costs less under the noise that the worse one needs.

    The residual of an uneven road says nothing there: one phone, whose true road leaves the noise,
    got two holes of 0.3 m behind bumps of 50 mm at 60 km/h (5 % more than the noise).
    """
    powers = misfit_power(even), misfit_power(uneven)
    if powers[0].max() < TUNING.even_gain * powers[1].max():
        return True
    if not uneven.objective.is_underdetermined:
        return False
    noise = np.maximum(1.0, np.maximum(*powers))
    costs = [
        lin.with_inverse_variance(
            [one.source.information / k for one, k in zip(lin.passes, noise, strict=True)]
        ).cost
        for lin in (even, uneven)
    ]
    return bool(costs[0] < costs[1])


def misfit_power(lin: Linearization) -> np.ndarray:
    """Power (P,) of the residual over the instruments' noise."""
    return np.array([_noise_scale(one, 0.0) for one in lin.passes])


def _noise_scale(one: LinearizedPass, dof: float) -> float:
    squares, used = one.source.information * one.residual**2, one.source.is_used
    share = one.source.band_share
    return float(squares[used].mean() / (share * max(1.0 - dof / (share * used.sum()), 0.1)))


def _estimate_frequency_weights(
    lin: Linearization, stationary: StationaryHessian, noise_scale: np.ndarray
) -> list[np.ndarray]:
    """Weight (J // 2 + 1,) of each frequency in each pass: noise as large as the residual is there,
    but never less than that of the instruments.
    """
    noise_variance = lin.objective.noise_variance * noise_scale
    dofs, weights = stationary.effective_dof(lin.objective.road, noise_variance), []
    for one, dof, scale in zip(lin.passes, dofs, noise_scale, strict=True):
        r = np.sqrt(one.source.information) * one.residual
        left = 1.0 - dof / (one.source.band_share * one.source.is_used.sum())
        f, S = welch(r, fs=1.0, nperseg=min(TUNING.welch_segment, r.shape[1]))
        level = np.maximum(0.5 * S.mean(axis=0) / max(left, 0.1), 1.0)
        weights.append(scale / np.interp(rfftfreq(r.shape[1]), f, level))
    return weights


def _huber_weights(residual: np.ndarray, inverse_variance: np.ndarray, huber: float) -> np.ndarray:
    """Return `inverse_variance`, reduced where residuals exceed `huber` standard deviations."""
    deviation = np.sqrt(inverse_variance) * np.abs(residual)
    return inverse_variance * np.minimum(1.0, huber / np.maximum(deviation, 1e-12))


def _smooth_friction(plant: Plant, std: float) -> Plant:
    """Return the plant with its rate laws averaged over a Gaussian of deviation `std` [m/s]."""
    if std == 0.0:
        return plant
    velocity = gaussian_smoothed(plant.velocity, V_0, V_STEP, std)
    return Plant(plant.constants, velocity, plant.displacement)
