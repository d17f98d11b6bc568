"""Vehicle parameters by marginal likelihood: the road, which nobody measured, is integrated out.

With the parameters p in units of their tolerances (`road_envs.vehicle.tolerances`), the most
probable road x(p) of each drive and its Gauss-Newton Hessian A(p) = I + J' R^-1 J, Laplace's
approximation is

    -log p(y, p) = sum over drives [cost(x(p), p) + 1/2 log det A(p)] + 1/2 |p|²

The log-determinant is needed: the road's prior alone rewards vehicles that need less road. It is
that of the stationary linear vehicle (`preconditioner.py`). Where x is optimal, the gradient of the
cost is that at a fixed road,

    g = G' R^-1 r - p,      G = d a / d p, by drives of varied vehicles, LANES at a time,

with r the residual. For the Hessian the road is eliminated from the linear problem r = J dx + G dp
+ e by the matrix inversion lemma, frequency by frequency in the stationary linear vehicle:

    I + sum over f of G(f)* (R + H S H*)^-1 G(f),     H: response, S: spectrum of the road's prior

Its inverse is the posterior covariance of the parameters. Over a road that was measured, only the
error of its profile is unknown; it is small, and noise of the covariance H S H*, so that g = G(f)*
(R + H S H*)^-1 r summed over f. (Ljung, "System Identification", 1999, section 7.4;
MacKay 2003, "Information Theory", chapter 27, for Laplace's approximation.)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import rfft, rfftfreq

from estimators.map_smoother.gauss_newton import GaussNewton, MapSolution, estimate_noise_scale
from estimators.map_smoother.objective import Linearization, Objective, linearize
from estimators.map_smoother.preconditioner import (
    linear_responses,
    prior_spectrum,
    stationary_hessian,
)
from estimators.map_smoother.wheel_liftoff import unloaded_nodes
from road_envs.sensing.instruments import on_axle
from road_envs.simulation.lanes import SharedInputs, drive_variants
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import ParameterSpace

DIFFERENCE = 0.1
"""Difference of a parameter for its derivative, in units of its tolerance."""

MAX_STEPS, ROAD_STEPS = 6, 2
"""Steps of the parameters at most, and Gauss-Newton steps of the road after each."""

DAMPING = 0.5
"""Share of each step after the first that is taken where the road is unknown."""

MAX_CHANGE, SMALL_CHANGE = 1.5, 0.2
"""Largest change of a parameter in one step, and the change of all below which the steps end, in
units of the tolerance and of the posterior standard deviation."""

MAX_UNLOADED_SHARE = 0.02
"""Share of the road that no wheel pressed on, above which the vehicle is not adapted."""

ADAPT_NOISE_SCALE = 1.15
"""Unexplained noise from which on the vehicle is adapted to the drive."""

BELIEVED_GAIN, STRUCTURE_POWER = 0.85, 10.0
"""Share of the unexplained noise that a fit leaves at most to be believed (a vehicle as described
0.95, of grade S1 0.33 to 0.72); and the power, over that of the instruments' noise, from which on
the vehicle has elements that its description leaves out."""

MAX_LINES = 500
"""Frequencies at which a log-determinant is evaluated, about."""


@dataclass(frozen=True)
class Readings:
    """Errors of the instruments as parameters: gains of the accelerometers `sensors`, displacement
    of the odometer [m], relative error of the speed, each in units of its standard deviation `std`.
    """

    sensors: tuple[str, ...]

    @classmethod
    def of(cls, objective: Objective) -> "Readings":
        """Return those of the sensors of an `objective`."""
        return cls(tuple(objective.model.locations))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters (R,)."""
        return (*(f"gain.{name}" for name in self.sensors), "odometer", "speed")

    @property
    def std(self) -> np.ndarray:
        """Prior standard deviations (R,)."""
        return np.array([*(0.02,) * len(self.sensors), 0.3, 0.01])

    def apply(self, objective: Objective, x: np.ndarray) -> Objective:
        """Return the objective for instruments with the errors `x` (0 or R,)."""
        if x.size == 0:
            return objective
        *gain, displacement, speed = (self.std * x).tolist()
        model, inputs = objective.model, objective.inputs
        factor = np.exp(gain)
        rows, bending = model.sensor_rows * factor[:, None], model.bending
        if bending is not None:
            bending = replace(bending, shape=factor * bending.shape)
        s = inputs.s + displacement + speed * (inputs.s - inputs.s[0])
        inputs = replace(inputs, s=s, v=inputs.v * (1.0 + speed))
        model = replace(model, sensor_rows=rows, bending=bending)
        return replace(objective, model=model, inputs=inputs)


@dataclass(frozen=True, eq=False)
class CarFit:
    """Fitted parameters: vector `x` (P,) in `space`, and if fitted of the instruments behind it;
    its `covariance` (P, P), and the solutions of the drives with the fitted vehicle.
    """

    space: ParameterSpace
    x: np.ndarray
    covariance: np.ndarray
    solutions: tuple[MapSolution, ...]

    @property
    def readings(self) -> Readings:
        """Errors of the instruments that may have been fitted."""
        return Readings.of(self.solutions[0].linearization.objective)

    @property
    def car(self) -> VehicleParameters:
        """The fitted vehicle."""
        return self.space.from_vector(self.x[: self.space.size])

    @property
    def std(self) -> np.ndarray:
        """Posterior standard deviations (P,) in units of the tolerances; 1: not determined."""
        return np.sqrt(np.diag(self.covariance))

    def summary(self, most: int = 4) -> str:
        """Return the best determined changes of the vehicle in percent."""
        change = 100.0 * np.expm1(self.space.std * self.x[: self.space.size])
        clear = np.argsort(-np.abs(self.x / self.std)[: self.space.size])[:most]
        return ", ".join(f"{self.space.names[i]} {change[i]:+.0f} %" for i in clear)


def fit_car(
    solutions: Sequence[MapSolution],
    space: ParameterSpace,
    solver: GaussNewton,
    *,
    instruments: bool = False,
    start: np.ndarray | None = None,
) -> CarFit:
    """Fit the parameters of `space` to drives, from the solutions with `space.car` on.

    `solver`: settings of the road's steps. With `instruments`, errors of the readings are fitted
    too, the same in all drives; possible only where the road is known. `start` (P,) is where the
    search begins.
    """
    readings = Readings.of(solutions[0].linearization.objective)
    size = space.size + instruments * len(readings.names)
    x = np.zeros(size) if start is None else start
    original, now = [s.linearization.objective for s in solutions], tuple(solutions)
    covariance = np.eye(size)
    for k in range(MAX_STEPS):
        cars = perturbed_cars(space, x[: space.size])
        terms = [
            _drive_terms(solution, objective, cars, x[space.size :])
            for solution, objective in zip(now, original, strict=True)
        ]
        gradient = np.sum([slope for slope, _ in terms], axis=0) - x
        hessian = np.sum([information for _, information in terms], axis=0) + np.eye(size)
        covariance = _invert(hessian)
        step = covariance @ gradient
        # an unknown road follows in a few steps only, so that whole steps would go too far
        share = 1.0 if instruments or k == 0 else DAMPING
        step *= min(share, MAX_CHANGE / np.abs(step).max())
        x = x + step
        car = space.from_vector(x[: space.size])
        now = tuple(
            _resolve(solution, readings.apply(o.with_car(car), x[space.size :]), solver)
            for solution, o in zip(now, original, strict=True)
        )
        if (np.abs(step) < SMALL_CHANGE * np.sqrt(np.diag(covariance))).all():
            break
    return CarFit(space, x, covariance, now)


def is_vehicle_unexplained(solution: MapSolution) -> bool:
    """Return whether what a solution leaves unexplained may be the vehicle, so that a fit is due.

    On roads that are rough in places and under wheels in the air it is not the vehicle. Sensors on
    an axle measure waves that are too short for the nodes of the road.
    """
    lin = solution.linearization
    if on_axle(lin.objective.model.locations):
        return False
    flown = unloaded_nodes(lin).mean() > MAX_UNLOADED_SHARE
    uneven = np.ptp(lin.objective.road.local) > 0.0
    return bool(not flown and not uneven and np.max(solution.noise_scale) >= ADAPT_NOISE_SCALE)


def is_believed(fit: CarFit, solutions: Sequence[MapSolution]) -> bool:
    """Return whether a fit explains the drives so much better than their `solutions` before it.

    A vehicle as described is fitted to what friction and the count of unknowns leave, and a vehicle
    of another kind, such as with a frame that twists, stays unexplained: neither is believed.
    """
    before, after = (
        max(float(np.max(s.noise_scale)) for s in part) for part in (solutions, fit.solutions)
    )
    return after < min(BELIEVED_GAIN * before, STRUCTURE_POWER)


def _invert(hessian: np.ndarray) -> np.ndarray:
    """Return the inverse of a Hessian (P, P) that is at least the prior's, which is 1."""
    values, vectors = np.linalg.eigh(hessian)
    return (vectors / np.maximum(values, 1.0)) @ vectors.T


def perturbed_cars(space: ParameterSpace, x: np.ndarray) -> list[VehicleParameters]:
    """Return the vehicle at `x` (P,), and for each parameter that with it changed by DIFFERENCE."""
    points = [x, *(x + DIFFERENCE * unit for unit in np.eye(space.size))]
    return [space.from_vector(point) for point in points]


def sensitivities(
    lin: Linearization, original: Objective, cars: Sequence[VehicleParameters], errors: np.ndarray
) -> np.ndarray:
    """Return the derivatives (P, S, J) of the block means by the parameters, at a fixed road.

    `cars` as of `perturbed_cars`; `original` is the objective for instruments without the `errors`
    (0 or 5,). Raises ArithmeticError if a motion is not finite.
    """
    objective = lin.objective
    u, start, bias = objective.split(lin.x)
    road = objective.road_under_wheels(objective.road.coefficients(u))
    inputs, strut_state = objective.inputs, objective.strut_state
    shared = SharedInputs(road, inputs.commands, strut_state, objective.model.valve_lag, inputs.h)
    readings = Readings.of(original)
    varied = [readings.apply(original.with_car(car), errors) for car in cars]
    starts = [one.initial_state + start for one in varied]
    motions = drive_variants([one.model.plant for one in varied], starts, shared)
    left = [one.residual(a, bias) for one, a in zip(varied, motions, strict=True)]
    found = (left[0] - np.array(left[1:])) / DIFFERENCE
    if not np.isfinite(found).all():
        raise ArithmeticError("the motion of a varied vehicle was not finite")
    return found


def _reading_sensitivities(lin: Linearization, base: Objective, errors: np.ndarray) -> np.ndarray:
    """Return the derivatives (R, S, J) by errors of the instruments, at `errors` (R,) of them.

    `base` is the objective for the vehicle of `lin` and instruments without errors.
    """
    readings = Readings.of(base)
    points = [errors + DIFFERENCE * unit for unit in np.eye(errors.size)]
    found = [readings.apply(base, point).residual_at(lin.x)[0] for point in points]
    return (lin.residual - np.array(found)) / DIFFERENCE


def _drive_terms(
    solution: MapSolution,
    original: Objective,
    cars: Sequence[VehicleParameters],
    errors: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return gradient (P,) and information (P, P) of one drive's marginal likelihood."""
    lin = solution.linearization
    objective = lin.objective
    G = sensitivities(lin, original, cars, errors)
    if errors.size > 0:
        read = _reading_sensitivities(lin, original.with_car(cars[0]), errors)
        G = np.concatenate([G, read])
    f, lines = _lines(objective)
    is_known = not objective.road.free.any()
    noise = objective.model.noise_variance * (1.0 if is_known else solution.noise_scale)
    covariance = _covariance(objective, f, noise)
    A, r = _spectrum(objective, G), _spectrum(objective, lin.residual[None])
    weighted = np.linalg.solve(covariance, lines[:, None, None] * A)
    information = np.real(np.einsum("fsp,fsq->pq", A.conj(), weighted))
    if not is_known:
        log_det, curvature = _log_det_terms(objective, cars, noise)
        fit = np.einsum("psj,sj->p", G, lin.apply_inverse_covariance(lin.residual))
        return fit - log_det, information + curvature
    # the error of the profile is noise; what the model cannot explain inflates all of it
    fit = np.real(np.einsum("fsp,fsq->p", weighted.conj(), r))
    power = np.real(np.einsum("fsq,fsq->fs", r.conj(), np.linalg.solve(covariance, r)))
    scale = max(1.0, float(lines @ power.mean(axis=1) / lines.sum()))
    return fit / scale, information / scale


def _spectrum(objective: Objective, means: np.ndarray) -> np.ndarray:
    """Return the spectra (F, S, P) of block means (P, S, J), without their means."""
    used = objective.measurements.sample_count > 0
    return rfft(means * used, axis=2)[:, :, 1:].transpose(2, 1, 0) / np.sqrt(means.shape[2])


def _lines(objective: Objective) -> tuple[np.ndarray, np.ndarray]:
    """Return the frequencies (F,) [Hz] of the block means' spectrum, without the mean, and how many
    lines of the two-sided spectrum each stands for.
    """
    blocks, dt = objective.measurements.y.shape[1], objective.block_duration
    lines = np.full(blocks // 2, 2.0)
    lines[-1] = 1.0 if blocks % 2 == 0 else 2.0
    return rfftfreq(blocks, dt)[1:], lines


def _covariance(objective: Objective, f: np.ndarray, noise: float) -> np.ndarray:
    """Return the covariance (F, S, S) [(m/s²)²] of the block means' spectrum at `f` (F,) [Hz]."""
    S = prior_spectrum(objective, f)[:, None, :]
    noise_part = (
        noise
        / objective.measurements.sample_weight.shape[2]
        * np.eye(len(objective.model.sensor_rows))
    )
    parts = ((share * H * S, H) for share, H in linear_responses(objective, f))
    return noise_part + np.sum([HS @ np.conj(H.swapaxes(1, 2)) for HS, H in parts], axis=0)


def _log_det_terms(
    objective: Objective, cars: Sequence[VehicleParameters], noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradient (P,) of 1/2 log det by the parameters, and its part of the Hessian.

    With C = R + H S H* and M_i = C^-1 dH_i S H*, summed over frequencies, they are Re tr M_i and
    Re tr M_i M_j; together with the information at a fixed road the latter is Whittle's.
    """
    f, lines = _lines(objective)
    stride = max(1, f.size // MAX_LINES)
    f, lines = f[::stride], stride * lines[::stride]
    base = list(linear_responses(objective, f))
    S = prior_spectrum(objective, f)[:, None, :]
    inverse = np.linalg.inv(_covariance(objective, f, noise))
    dual = [share * (S * H).conj().swapaxes(1, 2) @ inverse for share, H in base]
    M = []
    for car in cars[1:]:
        varied = linear_responses(objective.with_car(car), f)
        pairs = zip(varied, base, dual, strict=True)
        M.append(np.sum([(new - old) @ d for (_, new), (_, old), d in pairs], axis=0) / DIFFERENCE)
    flat = np.array(M) * np.sqrt(lines)[:, None, None]
    gradient = np.real(np.einsum("pfss,f->p", flat, np.sqrt(lines)))
    return gradient, np.real(np.einsum("pfst,qfts->pq", flat, flat, optimize=True))


def _resolve(solution: MapSolution, objective: Objective, solver: GaussNewton) -> MapSolution:
    """Return the solution of a drive with another `objective`, from its road on."""
    stationary = stationary_hessian(objective)
    solver = replace(solver, stationary=stationary)
    lin = linearize(objective, solution.linearization.x, objective.information)
    noise_scale, iterations = solution.noise_scale, solution.cg_iterations
    for _ in range(ROAD_STEPS):
        estimate = estimate_noise_scale(lin, stationary, noise_scale)
        noise_scale = max(1.0, min(noise_scale, estimate))
        lin, k = solver.step(lin, objective.model.plant, noise_scale)
        iterations += k
    return MapSolution(lin, stationary, noise_scale, solution.steps + ROAD_STEPS, iterations)
