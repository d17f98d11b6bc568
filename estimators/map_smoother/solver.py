"""The most probable road of one or several drives over it, each with its own vehicle and speed.

The minimization of a single drive begins at a level road, that of several at the mean of their
single estimates, so that few steps are needed. The noise of each pass has a scale of its own, so
that a vehicle that differs from its description counts for less. Passes whose vehicles are
described alike are those of one vehicle: if it is adapted, its parameters are fitted to all.

The relative error of the speed of a single drive is found together with the road. Its posterior
standard deviation is about 0.01 % after 100 m: the bound of the linear vehicle, whose parameters
are uncertain too.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from estimators.map_smoother.car_fit import (
    CarFit,
    adapt_car,
    can_show_vehicle,
    fit_if_due,
    is_believed,
    noise_left,
    resolve,
)
from estimators.map_smoother.gauss_newton import GaussNewton, MapSolution, minimize, misfit_power
from estimators.map_smoother.objective import Objective
from estimators.map_smoother.one_pass import MeasurementModel
from estimators.map_smoother.posterior_sampling import RoadPosterior, posterior_mean_and_std
from estimators.map_smoother.preparation import SolverSettings
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.vehicle_uncertainty import VehicleUncertainty
from estimators.map_smoother.wheel_liftoff import distance_in_air
from estimators.map_smoother.windows import PreparedDrive, RoadSoFar, common_windows, reconstruct
from road_envs.records.record import DistanceScale, Profile, scored_band


@dataclass(eq=False)
class RoadSolver:
    """Solver of the windows of `drives` on common nodes, from the road `start` on, if there is one.

    `adapt`: vehicles that stay unexplained are fitted; `draws`: posterior samples for the standard
    deviation in the `band` [cycles/m]; `uncertainty` is that of the vehicle of a single drive if it
    was identified. What it has found in all windows so far, in the order of the fields:

    greatest noise scale of each pass (P,); distance in the air of each pass (P,) [m]; fits of
    vehicles, with the numbers of their passes; fit in the present window that is not believed, and
    the noise scale that such fits left; greatest share of the vehicle in the variance of the
    heights; relative error of the speed of a single drive in each window, with its variance.
    """

    settings: SolverSettings
    drives: Sequence[PreparedDrive]
    adapt: bool
    draws: int
    uncertainty: VehicleUncertainty | None = None
    start: Profile | None = None

    noise_scale: np.ndarray = field(init=False)
    in_air: np.ndarray = field(init=False)
    fits: list[tuple[CarFit, list[int]]] = field(default_factory=list, init=False)
    doubted: CarFit | None = field(default=None, init=False)
    left_by_fit: float = field(default=0.0, init=False)
    vehicle_share: float = field(default=0.0, init=False)
    speed_errors: list[tuple[float, float]] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self.noise_scale, self.in_air = np.ones(len(self.drives)), np.zeros(len(self.drives))

    def fit_of(self, number: int) -> CarFit | None:
        return next((fit for fit, members in self.fits if number in members), None)

    def doubt(self, fit: CarFit) -> None:
        """Keep a fit that is not believed, of a vehicle whose elements are not all described."""
        self.doubted = fit
        self.left_by_fit = max(self.left_by_fit, noise_left(fit.solutions))

    @property
    def band(self) -> tuple[float, float]:
        """The scored band [cycles/m] of the slowest drive."""
        return scored_band(min(float(drive.inputs.v.mean()) for drive in self.drives))

    def solve(self) -> RoadSoFar:
        """Return the road of all windows. Raises ArithmeticError."""
        settings = self.settings
        windows = common_windows(self.drives, settings.window, settings.overlap)
        return reconstruct(self.drives, settings.road_prior, windows, self._solve_window)

    def _solve_window(self, objective: Objective, members: list[int]) -> RoadPosterior:
        settings, start, self.doubted = self.settings, self.start, None
        # vehicles that were fitted in a window are those of the whole drives
        fits = [self.fit_of(number) for number in members]
        pairs = zip(objective.passes, fits, strict=True)
        passes = (replace(one, model=one.with_car(x.car).model) if x else one for one, x in pairs)
        objective = replace(objective, passes=tuple(passes))
        solver = GaussNewton(
            settings.huber, adapt_prior=settings.adapt_prior, prior_updates=settings.prior_updates
        )
        x = None
        if start is not None:
            x = objective.from_noise(objective.road.noise_of(start))
            updates = TUNING.joint_prior_updates
            solver = replace(solver, stages=TUNING.joint_stages, prior_updates=updates)
        adapt = partial(self._adapt, members) if self.adapt and not self.fits else None
        solution = minimize(objective, solver, x, adapt)
        self.in_air[members] += [distance_in_air(one) for one in solution.linearization.passes]
        if len(self.drives) > 1:
            posterior = posterior_mean_and_std(solution, self.band, self.draws)
        else:
            posterior = self._with_vehicle(solution, solver)
        scale = np.maximum(self.noise_scale[members], posterior.solution.noise_scale)
        self.noise_scale[members] = scale
        return posterior

    def _with_vehicle(self, solution: MapSolution, solver: GaussNewton) -> RoadPosterior:
        """Return the posterior of a single drive with errors of its vehicle, which is fitted to the
        drive if they show.
        """
        drive, fit, uncertain = self.drives[0], self.fit_of(0), self.uncertainty
        sensors = tuple(drive.model.locations)
        if drive.model.speed_std > 0.0:
            self.speed_errors.append(_estimate_speed_error(solution))
        if fit:
            uncertain = replace(VehicleUncertainty.of_fit(fit), inflation=TUNING.fit_inflation)
        elif self.adapt and uncertain is None and drive.car.tolerances:
            uncertain = VehicleUncertainty.of_tolerances(drive.car, sensors)
        posterior = posterior_mean_and_std(solution, self.band, self.draws, uncertain)
        is_seen = posterior.evidence > TUNING.evidence_due and can_show_vehicle(solution)
        if is_seen and posterior.vehicle_share > TUNING.vehicle_share_due:
            with suppress(ArithmeticError):  # a varied vehicle's motion was not finite
                fit = self.doubted or adapt_car([solution], drive.car, solver)
                (fitted,) = fit.solutions
                if noise_left(fit.solutions) >= TUNING.structure_power:
                    self.doubt(fit)
                elif _explains_more(fitted, solution):
                    self.fits = [(fit, [0])]
                    uncertain = VehicleUncertainty.of_tolerances(fit.car, sensors)
                    uncertain = replace(uncertain, is_prior=False, inflation=TUNING.fit_inflation)
                    posterior = posterior_mean_and_std(fitted, self.band, self.draws, uncertain)
        self.vehicle_share = max(self.vehicle_share, posterior.vehicle_share)
        return posterior

    def _adapt(self, members: list[int], solution: MapSolution, solver: GaussNewton) -> MapSolution:
        cars = [self.drives[number].car for number in members]
        described = [car for k, car in enumerate(cars) if car not in cars[:k]]
        for car in described:
            same = [k for k, other in enumerate(cars) if other == car]
            own = [solution.of_pass(k) for k in same]
            fit = fit_if_due(own, car, solver)
            if fit and is_believed(fit, own):
                self.fits.append((fit, [members[k] for k in same]))
            elif fit:
                self.doubt(fit)
        if not self.fits:
            return solution
        if len(members) == 1:
            return self.fits[0][0].solutions[0]
        objective, fits = solution.linearization.objective, map(self.fit_of, members)
        pairs = zip(objective.passes, fits, strict=True)
        passes = tuple(one.with_car(fit.car) if fit else one for one, fit in pairs)
        objective = replace(objective, passes=passes)
        return resolve(solution, objective, solver, steps=TUNING.adapted_steps)


def _explains_more(fitted: MapSolution, described: MapSolution) -> bool:
    """Return whether a fitted vehicle leaves no more than the described one, or than the noise. The
    noise scales do not tell, as they never rise in a minimization.
    """
    left = [misfit_power(one.linearization).max() for one in (fitted, described)]
    return bool(left[0] <= max(1.0, left[1]))


def _estimate_speed_error(solution: MapSolution) -> tuple[float, float]:
    """The relative error of the speed of a single pass, an unknown, and its variance."""
    (one,) = solution.linearization.passes
    unit = np.zeros(solution.linearization.x.size)
    unit[-1] = 1.0
    column = solution.inverse_hessian(*TUNING.speed_cg)(unit)
    variance = one.source.model.speed_std**2 * float(column[-1])
    return one.source.speed_error(one.own), variance


def distance_scale(
    errors: Sequence[tuple[float, float]], model: MeasurementModel
) -> tuple[DistanceScale | None, tuple[str, ...]]:
    """Return the scale of the odometer by the `errors` of the speed in the windows of a drive, with
    their variances: None if they tell hardly more than the speed itself, or, with a note, doubt it.
    """
    if not errors:
        return None, ()
    values, variances = np.array(errors).T
    information = np.sum(1.0 / variances)
    error = float(np.sum(values / variances) / information)
    std = float(np.hypot(TUNING.speed_std_inflation / np.sqrt(information), TUNING.least_speed_std))
    if not std < TUNING.max_speed_std * model.speed_std:
        return None, ()
    if abs(error) > TUNING.max_speed_error * model.speed_std:
        note = (
            f"the time from axle to axle fits a speed that differs by {100.0 * error:+.1f} %, or a "
            f"wheelbase of {model.wheelbase / (1.0 + error):.2f} m instead of "
            f"{model.wheelbase:.2f} m: check both; distances are those of the given speed"
        )
        return None, (note,)
    return DistanceScale(1.0 + error, std), ()
