"""Vehicle parameters by the marginal likelihood of a drive over a road that was measured.

Only the error of its profile is unknown; it is small, and noise of the covariance H S H*, with the
response H of the stationary linear vehicle and the spectrum S of the error. With the parameters p
in units of their tolerances (`road_envs.vehicle.tolerances`), r the residual and G = d a / d p, by
drives of varied vehicles, LANES at a time, gradient and information are

    sum over f of G(f)* (R + H S H*)^-1 r(f),     sum over f of G(f)* (R + H S H*)^-1 G(f)

What then stays unexplained is an error of the model: it adds to the noise of its band, and to the
covariance of the gradient by all lines of the band at once, since it does not average out. (Ljung,
"System Identification", 1999, section 7.4.) A road that nobody measured is integrated out in
`tangent_likelihood.py`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.fft import rfft, rfftfreq

from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.instrument_errors import InstrumentErrors
from estimators.map_smoother.one_pass import LinearizedPass, Pass
from estimators.map_smoother.preconditioner import linear_responses
from estimators.map_smoother.road_prior import RoadTransform
from estimators.map_smoother.tuning import TUNING
from road_envs.analysis.statistical_linearization import hermitian
from road_envs.simulation.lanes import SharedInputs, drive_variants
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import ParameterSpace, varied_car

NO_ERRORS = np.zeros(0)


class LikelihoodTerms(NamedTuple):
    """Terms of the marginal likelihood of one drive: `gradient` (P,), `information` (P, P), and the
    covariance of the gradient `score_covariance` (P, P), which is the information if the model is
    right. Empty where the road was measured: the derivatives `log_det_gradient` (P,) of 1/2 log det
    A, and the change of the solution's unknowns `to_optimum` (n,) and `by_parameter` (P, n).
    """

    gradient: np.ndarray
    information: np.ndarray
    score_covariance: np.ndarray
    log_det_gradient: np.ndarray = np.zeros(0)
    to_optimum: np.ndarray = np.zeros(0)
    by_parameter: np.ndarray = np.zeros(0)

    def change(self, step: np.ndarray) -> np.ndarray | None:
        """Return the expected change (n,) of the unknowns with a `step` (P,) of the parameters;
        None if the road was measured.
        """
        return self.to_optimum + step @ self.by_parameter if self.by_parameter.size else None


def perturbed_cars(space: ParameterSpace, x: np.ndarray) -> list[VehicleParameters]:
    """Return the vehicle at `x` (P,), and for each parameter that with it changed by a little."""
    car = space.from_vector(x)
    factors = zip(space.names, np.exp(TUNING.difference * space.std).tolist(), strict=True)
    return [car, *(varied_car(car, {name: factor}) for name, factor in factors)]


def perturbed_passes(
    original: Pass, cars: Sequence[VehicleParameters], errors: np.ndarray = NO_ERRORS
) -> list[Pass]:
    """Return the `original` pass, whose instruments have no errors, with each of the `cars`, as of
    `perturbed_cars`, and with instruments that have these `errors` (0 or R,).
    """
    instruments = InstrumentErrors.of(original)
    return [instruments.apply(original.with_car(car), errors) for car in cars]


def sensitivities(lin: LinearizedPass, varied: Sequence[Pass]) -> np.ndarray:
    """Return the derivatives (P, S, J) of the block means by the parameters, at a fixed road.

    `varied` as of `perturbed_passes`. Raises ArithmeticError if a motion is not finite.
    """
    left = varied_residuals(lin, varied)
    return (left[0] - left[1:]) / TUNING.difference


def varied_residuals(lin: LinearizedPass, varied: Sequence[Pass]) -> np.ndarray:
    """Return the residuals (V, S, J) of other vehicles on the road of `lin`. Raises ArithmeticError
    if a motion is not finite.
    """
    source = lin.source
    start, bias = source.split(lin.own)
    road = source.road_under_wheels(lin.c, source.wheelbase(lin.own))
    inputs, state, lag = source.inputs, source.strut_state, source.model.valve_lag
    shared = SharedInputs(road, inputs.commands, state, lag, inputs.h, inputs.v[1::2])
    starts = [one.initial_state + start for one in varied]
    motions = drive_variants([one.model.plant for one in varied], starts, shared)
    left = np.array([one.residual(a, bias) for one, a in zip(varied, motions, strict=True)])
    for k, one in enumerate(varied):  # the road under longer tyres is another
        if one.model.contact_length != source.model.contact_length:
            left[k] = one.linearize(lin.c, lin.own).residual
    if not np.isfinite(left).all():
        raise ArithmeticError("the motion of a varied vehicle was not finite")
    return left


def reading_sensitivities(lin: LinearizedPass, base: Pass, errors: np.ndarray) -> np.ndarray:
    """Return the derivatives (R, S, J) of the block means by errors of the instruments, at
    `errors` (R,); `base` is the pass of the vehicle of `lin` with instruments without errors.
    """
    instruments = InstrumentErrors.of(base)
    _, bias = base.split(lin.own)
    found = []
    for k, unit in enumerate(np.eye(errors.size)):
        varied = instruments.apply(base, errors + TUNING.difference * unit)
        if k < instruments.n_fixed:  # the vehicle moves as before
            found.append(varied.residual(lin.tape.acceleration, bias))
        else:
            found.append(varied.linearize(lin.c, lin.own).residual)
    return (lin.residual - np.array(found)) / TUNING.difference


def known_road_terms(
    solution: MapSolution, original: Pass, cars: Sequence[VehicleParameters], errors: np.ndarray
) -> LikelihoodTerms:
    """Return the terms of a drive over a measured road; arguments as of `perturbed_passes`. Raises
    ArithmeticError if a motion is not finite.
    """
    (lin,), road = solution.linearization.passes, solution.linearization.objective.road
    G = sensitivities(lin, perturbed_passes(original, cars, errors))
    if errors.size > 0:
        read = reading_sensitivities(lin, original.with_car(cars[0]), errors)
        G = np.concatenate([G, read])
    blocks = lin.source.measurements.y.shape[1]
    f = rfftfreq(blocks, lin.source.block_duration)[1:]
    # lines of the two-sided spectrum that each stands for: none above the bandwidth
    lines = np.where(2 * np.arange(1, f.size + 1) == blocks, 1.0, 2.0)
    lines *= f <= lin.source.model.bandwidth
    A, r = _spectrum(lin.source, G), _spectrum(lin.source, lin.residual[None])
    covariance = _covariance(road, lin.source, f)
    # the error of the profile is noise; what the model cannot explain adds to it, band by band
    root = np.linalg.cholesky(covariance)
    A, r = np.linalg.solve(root, A), np.linalg.solve(root, r)
    band = (f / TUNING.error_bandwidth).astype(int)
    count = np.maximum(np.bincount(band), 1)
    power = np.zeros((count.size, *root.shape[1:]), dtype=complex)
    np.add.at(power, band, r @ hermitian(r))
    values, axes = np.linalg.eigh(power / count[:, None, None])
    excess = (np.maximum(values, 1.0) - 1.0)[band, :, None]
    A, r = hermitian(axes)[band] @ A, hermitian(axes)[band] @ r
    weighted = lines[:, None, None] * A / (1.0 + excess)
    fit = np.real(np.einsum("fsp,fsq->p", weighted.conj(), r))
    information = np.real(np.einsum("fsp,fsq->pq", A.conj(), weighted))
    spread = (1.0 + count[band, None, None] * excess) / (1.0 + excess)
    score = np.real(np.einsum("fsp,fsq->pq", A.conj(), spread * weighted))
    return LikelihoodTerms(fit, information, score)


def _spectrum(one: Pass, means: np.ndarray) -> np.ndarray:
    """Return the spectra (F, S, P) of block means (P, S, J), without their means."""
    return rfft(means * one.is_used, axis=2)[:, :, 1:].transpose(2, 1, 0) / np.sqrt(means.shape[2])


def _covariance(road: RoadTransform, one: Pass, f: np.ndarray) -> np.ndarray:
    """Return the covariance (F, S, S) [(m/s²)²] of the spectrum of the block means at `f` (F,)
    [Hz], in units in which that of unit white noise of the block means is 1.
    """
    v, dt = float(one.inputs.v.mean()), one.block_duration
    density = np.abs(road.transfer_function()) ** 2 * road.ds / (v * dt)
    response = np.sinc(f * dt) ** 2
    S = np.array([np.interp(f / v, road.n, path) * response for path in density]).T[:, None, :]
    noise = one.model.noise_variance / one.measurements.sample_weight.shape[2]
    parts = ((share * H * S, H) for share, H in linear_responses(one, f))
    eye = np.eye(len(one.model.sensor_rows))
    return noise * eye + np.sum([HS @ hermitian(H) for HS, H in parts], axis=0)
