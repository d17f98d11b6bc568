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
from estimators.map_smoother.preconditioner import StationaryHessian, stationary_hessian
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.wheel_liftoff import passed_nodes, relax_unloaded
from road_envs.vehicle.equations import Plant
from road_envs.vehicle.force_curves import gaussian_smoothed
from road_envs.vehicle.suspension import V_0, V_STEP


@dataclass(frozen=True, eq=False)
class MapSolution:
    """A point of the minimization, and its result: the `linearization` there, the preconditioner's
    `stationary` Hessian, and the `noise_scale` (P,) on the noise variance of each pass.
    """

    linearization: Linearization
    stationary: StationaryHessian
    noise_scale: np.ndarray

    @property
    def noise_variance(self) -> np.ndarray:
        """Variance (P,) [(m/s²)²] of a sample in each pass, by all that stays unexplained."""
        return self.linearization.objective.noise_variance * self.noise_scale

    @property
    def effective_dof(self) -> np.ndarray:
        """Number (P,) of the road's unknowns that each pass determines."""
        road = self.linearization.objective.road
        return self.stationary.effective_dof(road, self.noise_variance)

    def of_pass(self, k: int) -> "MapSolution":
        lin, stationary = self.linearization.of_pass(k), self.stationary.of_pass(k)
        return MapSolution(lin, stationary, self.noise_scale[k : k + 1])

    def inverse_hessian(self, max_iterations: int, tolerance: float) -> Operator:
        """Return x(b) (n,), the solution of H x = b by preconditioned conjugate gradients."""
        lin = self.linearization
        M = self.stationary.preconditioner(lin, self.noise_variance)
        H, limits = lin.hessian_product, (max_iterations, tolerance)
        return lambda b: conjugate_gradients(H, b, M, *limits)[0]

    def with_noise_scale(self) -> "MapSolution":
        """Return the point under the power of the residual over the instruments' noise, for the
        degrees of freedom left. It never rises above the noise scale so far, nor falls below 1.
        """
        pairs = zip(self.linearization.passes, self.effective_dof, strict=True)
        scales = [_noise_scale(one, share) for one, share in pairs]
        return replace(self, noise_scale=np.maximum(1.0, np.minimum(self.noise_scale, scales)))

    def with_prior(self) -> "MapSolution":
        """Return the point under the prior that its own road suggests; the same road. The prior
        stays if the road would be most improbable under the other one: where a road is a single
        wave the prior would allow hardly any other, and the next step would go anywhere.
        """
        lin, x, before = self.linearization, self.linearization.x, self.linearization.objective.road
        u = lin.objective.split(x)[0]
        density = self.stationary.density_of(before, self.noise_variance, u)
        road = replace(before, density=density)
        u = road.convert_noise(u, before)
        if not road.may_be_uneven:
            return replace(self, linearization=lin.with_road(road, u))
        passed = passed_nodes(lin)
        local = self.stationary.local_roughness(road, self.noise_variance, u, passed)
        rough = replace(road, local=local)
        new = lin.with_road(rough, rough.convert_noise(u, road))
        most = TUNING.max_noise_power * max(float(x @ x), lin.objective.size)
        return replace(self, linearization=new) if float(new.x @ new.x) < most else self


def minimize(
    objective: Objective,
    solver: "GaussNewton",
    start: np.ndarray | None = None,
    adapt_car: "Callable[[MapSolution, GaussNewton], MapSolution] | None" = None,
) -> MapSolution:
    """Minimize the objective from a level road or `start` on.

    `adapt_car`, if given, returns the solution with another vehicle where the descent has ended.

    What a wrong vehicle leaves is taken for obstacles as well, and a prior that is rough there
    confirms it. Where much is unexplained on a road that is rough in places, it is therefore sought
    on one that is equally rough everywhere, too; always where a road can explain all readings.
    """
    stationary = stationary_hessian(objective)
    found = _descend(objective, stationary, solver, start)
    is_doubtful = objective.is_underdetermined or np.max(found.noise_scale) > NOISE_SCALE_WARNING
    if found.linearization.objective.road.is_uneven and is_doubtful:
        even = replace(objective, road=replace(objective.road, may_be_uneven=False))
        other = _descend(even, stationary, solver, start)
        if _is_likelier(other.linearization, found.linearization):
            found = other
    if adapt_car is not None:
        found = adapt_car(found, solver)
    if np.max(found.noise_scale) > NOISE_SCALE_WARNING and not objective.is_underdetermined:
        white = found.stationary
        for _ in range(TUNING.reweighting_steps):
            weights = _estimate_frequency_weights(replace(found, stationary=white))
            lin = found.linearization
            lin = lin.with_noise(lin.inverse_variance, weights)
            colored = white.reweighted(lin.objective, weights)
            found, _ = solver.step(MapSolution(lin, colored, found.noise_scale))
    return _retry_after_liftoff(found, solver)


@dataclass(frozen=True)
class GaussNewton:
    """Gauss-Newton steps, by conjugate gradients, and when they end. `huber`: standard deviations
    beyond which a block mean is down-weighted. With `adapt_prior` the prior is updated before each
    of the `stages` and between steps with the true vehicle, there at most `prior_updates` times. A
    stage ends when such a step changes the unknowns by less than `change_tolerance`.
    """

    huber: float = np.inf
    cg_iterations: int = 40
    cg_tolerance: float = 0.1
    change_tolerance: float = TUNING.change_tolerance
    adapt_prior: bool = True
    stages: Sequence[tuple[float, int]] = TUNING.friction_stages
    prior_updates: int = TUNING.prior_updates

    def step(
        self, point: MapSolution, plants: Sequence[Plant] | None = None
    ) -> tuple[MapSolution, float]:
        """Return the next point, for the vehicles of the passes or other `plants`; and the root
        mean square change of the resolved unknowns in posterior standard deviations.
        """
        weights = [
            _huber_weights(one.residual, one.source.information / scale, self.huber)
            for one, scale in zip(point.linearization.passes, point.noise_scale, strict=True)
        ]
        lin = point.linearization.with_noise(weights)
        point, road = replace(point, linearization=lin), lin.objective.road
        more = TUNING.uneven_iterations if road.is_uneven else 1
        gradient = lin.gradient()
        dx = point.inverse_hessian(more * self.cg_iterations, self.cg_tolerance)(-gradient)
        slope = float(gradient @ dx)
        dof = np.sum(point.effective_dof) + (lin.objective.size - 2 * road.size)
        lin = _line_search(lin, dx, slope, plants)
        # conjugate gradients leave dx' H dx = -slope
        return replace(point, linearization=lin), float(np.sqrt(-slope / dof))


def _retry_after_liftoff(found: MapSolution, solver: GaussNewton) -> MapSolution:
    """Return the optimum from the road lowered where no wheel pressed on it, as often as it then
    costs less; a road with obstacles has been lowered before.
    """
    for _ in range(TUNING.max_liftoff_retries):
        lin = found.linearization
        if lin.objective.road.is_level_between_obstacles or (x := relax_unloaded(lin)) is None:
            break
        try:
            new = replace(found, linearization=lin.relinearize(x))
        except ArithmeticError:
            break
        for _ in range(TUNING.liftoff_steps):
            new, _ = solver.step(new)
        if not new.linearization.with_noise(lin.inverse_variance).cost < lin.cost:
            break
        found = new
    return found


def _descend(
    objective: Objective, stationary: StationaryHessian, solver: GaussNewton, x: np.ndarray | None
) -> MapSolution:
    noise_scale = np.full(len(objective.passes), np.inf)
    point: MapSolution | None = None
    best: Linearization | None = None  # where a road can explain all readings
    x = np.zeros(objective.size) if x is None else x
    for std, max_steps in solver.stages:
        if point is not None:
            point = point.with_prior() if solver.adapt_prior else point
            lin, noise_scale = point.linearization, point.noise_scale
            objective, x = lin.objective, lin.x
        plants = [_smooth_friction(one.model.plant, std) for one in objective.passes]
        lin = objective.linearize(x, plants)
        point = MapSolution(lin, stationary, noise_scale).with_noise_scale()
        for n in range(max_steps):
            updates = solver.prior_updates if std == 0.0 and solver.adapt_prior else 0
            if 0 < n <= updates:
                lin = point.linearization
                if n in TUNING.lowering_steps and lin.objective.road.is_level_between_obstacles:
                    lowered = relax_unloaded(lin)
                    lin = lin if lowered is None else lin.relinearize(lowered)
                point = replace(point, linearization=lin).with_prior()
            before = np.max(point.noise_scale)
            point, change = solver.step(point, plants)
            point, lin = point.with_noise_scale(), point.linearization
            if std == 0.0 and objective.is_underdetermined:
                power = misfit_power(lin)
                least = np.maximum(1.0, TUNING.least_noise * power)
                noise_scale = np.minimum(point.noise_scale, TUNING.noise_fall * before)
                point = replace(point, noise_scale=np.maximum(least, noise_scale))
                if best is None or power.max() < misfit_power(best).max():
                    best = lin
            last_lowering = min(TUNING.lowering_steps[-1], updates)
            to_come = n < last_lowering and lin.objective.road.is_level_between_obstacles
            now = np.max(point.noise_scale)
            is_falling = NOISE_SCALE_WARNING < before and now < TUNING.settled * before
            if change < solver.change_tolerance and not (to_come or is_falling):
                break
    assert point is not None
    if best is not None:
        return MapSolution(best, stationary, np.maximum(1.0, misfit_power(best)))
    return point


def _line_search(
    lin: Linearization, dx: np.ndarray, slope: float, plants: Sequence[Plant] | None
) -> Linearization:
    """Return a point along `dx`: the step is halved until the cost, of that `slope`, falls."""
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


def _is_likelier(even: Linearization, uneven: Linearization) -> bool:
    """Return whether an `even` road is to be preferred: if it leaves much less, or, where a road
    can explain all readings, costs less under the noise that the worse one needs. The residual of
    an uneven road says nothing there: one phone, whose true road leaves the noise, got two holes of
    0.3 m behind bumps of 50 mm at 60 km/h (5 % more than the noise).
    """
    powers = misfit_power(even), misfit_power(uneven)
    if powers[0].max() < TUNING.even_gain * powers[1].max():
        return True
    if not uneven.objective.is_underdetermined:
        return False
    noise = np.maximum(1.0, np.maximum(*powers))
    return even.cost_under(noise) < uneven.cost_under(noise)


def misfit_power(lin: Linearization) -> np.ndarray:
    """Power (P,) of the residual over the instruments' noise."""
    return np.array([_noise_scale(one, 0.0) for one in lin.passes])


def _noise_scale(one: LinearizedPass, dof: float) -> float:
    squares, used = one.source.information * one.residual**2, one.source.is_used
    share = one.source.band_share
    return float(squares[used].mean() / (share * max(1.0 - dof / (share * used.sum()), 0.1)))


def _estimate_frequency_weights(point: MapSolution) -> list[np.ndarray]:
    """Weight (J // 2 + 1,) of each frequency in each pass: noise as large as the residual is there,
    but never less than that of the instruments.
    """
    weights, lin = [], point.linearization
    for one, dof, scale in zip(lin.passes, point.effective_dof, point.noise_scale, strict=True):
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
