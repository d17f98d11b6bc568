"""Vehicle parameters from drives: Newton steps on their marginal likelihood.

Over a measured road its terms are those of `marginal_likelihood`, over an unmeasured one those of
`tangent_likelihood`. After each step of the parameters the road of each drive follows.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimators.map_smoother.gauss_newton import GaussNewton, MapSolution
from estimators.map_smoother.instrument_errors import InstrumentErrors
from estimators.map_smoother.marginal_likelihood import (
    LikelihoodTerms,
    known_road_terms,
    perturbed_cars,
)
from estimators.map_smoother.objective import Objective
from estimators.map_smoother.preconditioner import stationary_hessian
from estimators.map_smoother.tangent_likelihood import tangent_terms
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.wheel_liftoff import unloaded_nodes
from road_envs.sensing.instruments import on_axle
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import ParameterSpace, parameter_space


@dataclass(frozen=True, eq=False)
class CarFit:
    """Fitted parameters: vector `x` (P,) in `space`, and if fitted of the instruments behind it;
    its `covariance` (P, P), and the solutions of the drives with the fitted vehicle.
    `contradiction`: mean square of what a single drive would still change of the vehicle, over its
    expectation, greatest of several drives over unmeasured roads; of fewer 0.
    """

    space: ParameterSpace
    x: np.ndarray
    covariance: np.ndarray
    solutions: tuple[MapSolution, ...]
    contradiction: float

    @property
    def instrument_errors(self) -> InstrumentErrors:
        """Errors of the instruments that may have been fitted."""
        return InstrumentErrors.of(self.solutions[0].linearization.objective.passes[0])

    @property
    def car(self) -> VehicleParameters:
        return self.space.from_vector(self.x[: self.space.size])

    @property
    def std(self) -> np.ndarray:
        """Posterior standard deviations (P,) in units of the tolerances; 1: not determined."""
        return np.sqrt(np.diag(self.covariance))

    def summary(self) -> str:
        """Return the four best determined changes of the vehicle in percent."""
        change = 100.0 * np.expm1(self.space.std * self.x[: self.space.size])
        clear = np.argsort(-np.abs(self.x / self.std)[: self.space.size])[:4]
        return ", ".join(f"{self.space.names[i]} {change[i]:+.0f} %" for i in clear)


def fit_car(
    solutions: Sequence[MapSolution],
    space: ParameterSpace,
    solver: GaussNewton,
    *,
    instruments: bool = False,
    start: np.ndarray | None = None,
    max_steps: int = TUNING.fit_steps,
    renewed_steps: int | None = None,
) -> CarFit:
    """Fit the parameters of `space` to drives, from the solutions with `space.car` on, by road
    steps of the `solver`. With `instruments`, errors of the readings are fitted too, the same in
    all drives; possible only where the road is known. `start` (P,) is where the search begins. The
    terms of second order over unmeasured roads are renewed in the first `renewed_steps`, or in all.
    Raises ArithmeticError if a motion is not finite, or no vehicle has the fitted values.
    """
    errors = InstrumentErrors.of(solutions[0].linearization.objective.passes[0])
    size = space.size + instruments * len(errors.names)
    x = np.zeros(size) if start is None else start
    original, now = [s.linearization.objective for s in solutions], tuple(solutions)
    small = TUNING.small_change if instruments else TUNING.small_on_unmeasured
    terms: list[LikelihoodTerms] = []
    weights = [TUNING.unmeasured_weight if one.road.free.any() else 1.0 for one in original]

    def total(parts: Iterable[np.ndarray]) -> np.ndarray:
        return np.sum([k * part for k, part in zip(weights, parts, strict=True)], axis=0)

    for n in range(max_steps):
        cars = perturbed_cars(space, x[: space.size])
        is_renewed = renewed_steps is None or n < renewed_steps
        known = [None] * len(now) if is_renewed else terms
        terms = [
            tangent_terms(solution, cars, before)
            if objective.road.free.any()
            else known_road_terms(solution, objective.passes[0], cars, x[space.size :])
            for solution, objective, before in zip(now, original, known, strict=True)
        ]
        gradient = total(term.gradient for term in terms) - x
        covariance = np.linalg.inv(total(term.information for term in terms) + np.eye(size))
        step = covariance @ gradient
        step *= min(1.0, TUNING.max_change / np.abs(step).max())
        x = x + step
        car, solved = space.from_vector(x[: space.size]), list[MapSolution]()
        for solution, objective, term in zip(now, original, terms, strict=True):
            one = errors.apply(objective.passes[0].with_car(car), x[space.size :])
            # the unknowns are those of the prior that the road has by now
            changed = replace(solution.linearization.objective, passes=(one,))
            solved.append(resolve(solution, changed, solver, term.change(step)))
        now = tuple(solved)
        if (np.abs(step) < small * np.sqrt(np.diag(covariance))).all():
            break
    score = total(term.score_covariance for term in terms) + np.eye(size)
    return CarFit(space, x, covariance @ score @ covariance, now, _contradiction(terms, step))


def _contradiction(terms: Sequence[LikelihoodTerms], step: np.ndarray) -> float:
    powers = []
    for one in terms:
        if one.change(step) is not None:
            variance, directions = np.linalg.eigh(one.score_covariance)
            told = variance > TUNING.told_share * variance[-1]
            left = directions.T @ (one.gradient - one.information @ step)
            powers.append(float(np.mean(left[told] ** 2 / variance[told])))
    return max(powers) if len(powers) > 1 else 0.0


def adapt_car(
    solutions: Sequence[MapSolution], car: VehicleParameters, solver: GaussNewton
) -> CarFit:
    """Return the fit of a described `car` to its own drives. Raises ArithmeticError."""
    return fit_car(solutions, parameter_space(car), solver, renewed_steps=TUNING.renewed_steps)


def fit_if_due(
    solutions: Sequence[MapSolution], car: VehicleParameters, solver: GaussNewton
) -> CarFit | None:
    """Return the fit of `car` to drives, None where the vehicle is not what stays unexplained in
    any of them, has no tolerances, or leaves the range in which its motion is finite.
    """
    unexplained = [x for x in solutions if np.max(x.noise_scale) >= TUNING.adapt_noise_scale]
    if not (car.tolerances and any(map(can_show_vehicle, unexplained))):
        return None
    try:
        return adapt_car(solutions, car, solver)
    except ArithmeticError:  # a varied vehicle's motion was not finite, or none has its values
        return None


def can_show_vehicle(solution: MapSolution) -> bool:
    """Return whether what a solution leaves unexplained, if anything, may be the vehicle.

    On roads that are rough in places and under wheels in the air it is not the vehicle. Sensors on
    an axle measure waves that are too short for the nodes of the road.
    """
    lin = solution.linearization
    if any(on_axle(one.source.model.locations) for one in lin.passes):
        return False
    flown = unloaded_nodes(lin).mean() > TUNING.max_unloaded_share
    return bool(not flown and not lin.objective.road.is_uneven)


def is_believed(fit: CarFit, solutions: Sequence[MapSolution]) -> bool:
    """Return whether a fit explains the drives so much better than their `solutions` before it. A
    vehicle as described is fitted to what friction and the count of unknowns leave, and a vehicle
    of another kind, such as with a frame that twists, stays unexplained: neither is believed.
    """
    left = noise_left(fit.solutions)
    return left < min(TUNING.believed_gain * noise_left(solutions), TUNING.structure_power)


def noise_left(solutions: Sequence[MapSolution]) -> float:
    """Return the greatest noise scale of the drives of one vehicle."""
    return max(float(np.max(one.noise_scale)) for one in solutions)


def resolve(
    solution: MapSolution,
    objective: Objective,
    solver: GaussNewton,
    change: np.ndarray | None = None,
    steps: int = TUNING.road_steps,
) -> MapSolution:
    """Return the solution of drives with another `objective`, after `steps` from its road on. With
    a `change` of the unknowns that is expected, the prior of the road follows it, too.
    """
    lin = objective.linearize(solution.linearization.x + (0.0 if change is None else change))
    point = MapSolution(lin, stationary_hessian(objective), solution.noise_scale)
    for _ in range(steps):
        point, _ = solver.step(point.with_noise_scale())
        if change is not None:
            point = point.with_prior()
    return point
