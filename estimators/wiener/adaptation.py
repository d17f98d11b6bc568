"""Adaptation of a described vehicle to its own drive, in the frequency domain.

The signals of a segment are a Gaussian process of the spectrum C(x) = H(x) S H(x)* + R, with H the
response of the vehicle with the parameters x in units of their tolerances. Whittle's approximation
of the posterior of x, the road integrated out, is

    log p(x) = -kappa sum over f of (log det C + y* C^-1 y) - |x|² / 2

with kappa the independent share of the lines. Fisher scoring finds its maximum: with the whitened
derivatives D_p = L^-1 (dC / dx_p) L^-*, C = L L*, the information is kappa sum tr(D_p D_q) + I
(Whittle 1953, Ark. Mat. 2, 423-434; Kay 1993, "Fundamentals of Statistical Signal Processing:
Estimation Theory", section 3.9). Its inverse is the covariance of what remains unknown of
the vehicle, which adds to the noise (`_model_error_psd`). Of a vehicle that is not adapted as much
is unknown as its tolerances say.
"""

from dataclasses import dataclass, replace

import numpy as np

from estimators.wiener.drive_check import obstacle_samples
from estimators.wiener.iteration import Iterate, smooth_segment
from estimators.wiener.segments import Segment
from estimators.wiener.spectral_model import (
    SensedVehicle,
    SpectralModel,
    active_sensors,
    fit_hyperparameters,
    windowed_spectrum,
)
from estimators.wiener.tuning import TUNING
from road_envs.analysis.information_bound import equivalent_damping, strut_rate_std
from road_envs.analysis.statistical_linearization import hermitian
from road_envs.records.record import F_C, Record
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle import linear_model
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import ParameterSpace, has_absent_elements, parameter_space


@dataclass(frozen=True, eq=False)
class _UncertainVehicle:
    """A vehicle `x` (P,) of a `space`, the `covariance` (P, P) of what is unknown of it, the noise
    scale that it leaves `unexplained`, and its adaptation in words, if there was one, as `notes` of
    an estimate.
    """

    space: ParameterSpace
    instruments: Instruments
    x: np.ndarray
    covariance: np.ndarray
    unexplained: float
    notes: tuple[str, ...] = ()

    @property
    def car(self) -> VehicleParameters:
        """The most probable vehicle."""
        return self.space.from_vector(self.x)

    def model(self, segment: Segment, fitted: SpectralModel | None = None) -> SpectralModel:
        """Return the model of a segment with the noise of an uncertain vehicle: the one `fitted` to
        it with this vehicle, if there is one, or a new one.
        """
        vehicle = SensedVehicle.of(self.car, self.instruments)
        model = fitted or fit_hyperparameters(vehicle, segment)
        _, dH = _responses(self.space, self.x, self.instruments, segment, model)
        return replace(model, model_error=_model_error_psd(dH, self.covariance, model.S))


def adapt_vehicle(
    record: Record,
    segment: Segment,
    model: SpectralModel,
    car: VehicleParameters,
    instruments: Instruments,
    passes: int,
) -> _UncertainVehicle | None:
    """Return the most probable vehicle on a `segment` of a `record`: `car` with its tolerances, if
    it may well be that or no other explains more; None if its file gives no tolerances. `model` is
    that of the segment for `car`, `passes` those of the estimate.

    A vehicle is never adapted if the record has fewer than `least_channels` channels, or much of it
    is obstacles, which are no part of a Gaussian process.
    """
    if not car.tolerances:
        return None
    before = after = float(np.mean(model.noise_scale))
    rigid = parameter_space(car, structure=False)
    nominal = np.zeros(rigid.size)
    described = _UncertainVehicle(rigid, instruments, nominal, np.eye(rigid.size), before)
    if (
        before < TUNING.adapted_scale
        or active_sensors(segment).size < TUNING.least_channels
        or obstacle_samples(record).mean() > TUNING.max_obstacles
    ):
        return described
    flexible = before > TUNING.structure_scale and has_absent_elements(car)
    space = parameter_space(car, structure=flexible)
    x, covariance = np.zeros(space.size), np.eye(space.size)
    try:
        for k, (most, steps) in enumerate(TUNING.flexible_rounds if flexible else TUNING.rounds):
            if k > 0 or flexible:
                vehicle = SensedVehicle.of(space.from_vector(x), instruments)
                model = fit_hyperparameters(vehicle, segment)
                after = float(np.mean(model.noise_scale))
            last = smooth_segment(model, segment, min(most, passes))
            x, covariance, gain = _fisher_scoring(space, x, instruments, segment, last, steps)
            if k == 0 and not flexible and gain < TUNING.adaptation_gain:
                return described
    except ArithmeticError:  # a fitted vehicle is none
        return described
    if not after < before:
        return described
    note = (
        f"the vehicle was adapted to the drive: {before:.1f} times the noise power of the "
        f"instruments and the friction was unexplained, now {after:.1f} times"
    )
    return _UncertainVehicle(space, instruments, x, covariance, after, (note,))


def _responses(
    space: ParameterSpace,
    x: np.ndarray,
    instruments: Instruments,
    segment: Segment,
    model: SpectralModel,
) -> tuple[np.ndarray, np.ndarray]:
    """Return H (F, S, 2) of the vehicle `x` (P,) at a model's lines, and derivatives by x."""
    v, mode, f, n = segment.v, segment.mode, model.f, model.n
    vehicle = SensedVehicle.of(space.from_vector(x), instruments)
    damping = equivalent_damping(vehicle.plant, mode, v, model.prior)
    linear = linear_model.linearise(vehicle.plant, mode, vehicle.points, damping=damping, speed=v)
    rate = strut_rate_std(linear, v, f, model.S / v)
    from_rate = linear_model.gaussian_damping(vehicle.plant, mode, rate)
    shifted = TUNING.difference * np.eye(space.size)
    others = [SensedVehicle.of(space.from_vector(x + d), instruments) for d in shifted]
    models = []
    for one in others:
        own = damping * linear_model.gaussian_damping(one.plant, mode, rate) / from_rate
        models.append(linear_model.linearise(one.plant, mode, one.points, damping=own, speed=v))
    unbent = linear_model.frequency_response(linear, v, f=f)
    changes = linear_model.response_changes(linear, models, v, f)
    H = vehicle.response(unbent, f, n)
    dH = [one.response(unbent + d, f, n) - H for one, d in zip(others, changes, strict=True)]
    return H, np.array(dH) / TUNING.difference


def _model_error_psd(dH: np.ndarray, covariance: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return the spectrum (F, S, S) that uncertain parameters add to S signals, to first order:
    sum over p, q of P_pq dH_p S dH_q*. It neglects that they depart equally at all frequencies.

    `dH` (P, F, S, 2): derivatives of the response; `covariance` (P, P) of the parameters; `S`
    (F, 2, 2): spectrum of the road.
    """
    root = np.linalg.cholesky(covariance)
    parts = np.tensordot(root.T, dH, axes=1)
    return np.sum(parts @ S @ hermitian(parts), axis=0)


def _fisher_scoring(
    space: ParameterSpace,
    x: np.ndarray,
    instruments: Instruments,
    segment: Segment,
    iterate: Iterate,
    steps: int,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the parameters (P,) after `steps` from `x` (P,), the covariance (P, P) of what is
    unknown of them, and the gain of the log posterior that the first step promises.

    The signals are those of an `iterate`, without nonlinear force residuals.
    """
    model, gain = iterate.model, np.nan
    used = (model.f > TUNING.f_low) & (model.f < F_C)
    sensors = active_sensors(segment)
    y = windowed_spectrum(model, replace(segment, a=iterate.y))[used][:, sensors]
    R = iterate.noise[used][:, sensors][:, :, sensors]
    part = replace(model, n=model.n[used], f=model.f[used], S=model.S[used])
    kappa = TUNING.independent_share * segment.a.shape[1] / model.size
    for _ in range(steps):
        H, dH = _responses(space, x, instruments, segment, part)
        H, dH = H[:, sensors], dH[:, :, sensors]
        half = dH @ (part.S @ hermitian(H))
        whitening = np.linalg.inv(np.linalg.cholesky(H @ part.S @ hermitian(H) + R))
        D = whitening @ (half + hermitian(half)) @ hermitian(whitening)
        w = whitening @ y
        excess = np.eye(sensors.size) - w @ hermitian(w)
        gradient = kappa * np.real(np.einsum("pfij,fji->p", D, excess)) + x
        flat = D.reshape(space.size, -1)
        information = kappa * np.real(flat @ flat.conj().T) + np.eye(space.size)
        step = np.linalg.solve(information, gradient)
        gain = 0.5 * float(gradient @ step) if np.isnan(gain) else gain
        x = x - step * min(1.0, TUNING.max_step / max(np.abs(step).max(), 1e-12))
        x = np.clip(x, -TUNING.max_deviation, TUNING.max_deviation)
    return x, np.linalg.inv(information), gain
