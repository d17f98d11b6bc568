"""Adaptation of a described vehicle to its own drive, in the frequency domain.

The signals of a segment are a Gaussian process of the spectrum C(x) = H(x) S H(x)* + R, with H the
response of the vehicle with the parameters x in units of their tolerances. Whittle's approximation
of the posterior of x, the road integrated out, is

    log p(x) = -kappa sum over f of (log det C + y* C^-1 y) - |x|² / 2

with kappa the independent share of the lines. Fisher scoring finds its maximum: with the whitened
derivatives D_p = L^-1 (dC / dx_p) L^-*, C = L L*, the information is kappa sum tr(D_p D_q) + I
(Whittle 1953, Ark. Mat. 2, 423-434; Kay 1993, "Fundamentals of Statistical Signal Processing:
Estimation Theory", section 3.9). Its inverse is the covariance of what remains unknown of
the vehicle, which adds to the noise (`model_error_psd`).
"""

from dataclasses import dataclass, replace

import numpy as np

from estimators.wiener.drive_check import LEAST_CHANNELS, obstacle_samples
from estimators.wiener.iteration import Iterate, smooth_segment
from estimators.wiener.segments import Segment
from estimators.wiener.spectral_model import (
    F_LOW,
    SensedVehicle,
    SpectralModel,
    active_sensors,
    fit_hyperparameters,
    windowed_spectrum,
)
from road_envs.analysis.information_bound import equivalent_damping, strut_rate_std
from road_envs.analysis.statistical_linearization import hermitian
from road_envs.records.record import F_C, Record
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle.linear_model import (
    frequency_response,
    gaussian_damping,
    linearise,
    response_changes,
)
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import ParameterSpace, has_absent_elements, parameter_space

DIFFERENCE = 0.02
"""Step of the differences of parameters, in units of their tolerances."""

INDEPENDENT_SHARE = 0.5
"""Independent share of the lines of a segment under a Hann window."""

MAX_STEP, MAX_DEVIATION = 1.5, 4.0
"""Greatest change of a parameter in a step, and greatest deviation, in units of its tolerance."""

DOUBTED_SCALE, STRUCTURE_SCALE = 1.2, 4.0
"""Noise scale of the description above which the vehicle is doubted, and above which it may twist
and bend. It is 0.9 to 1.4 for the vehicle described, 1.3 to 1.9 for vehicles of grade S1 and above
18 for those of grade S2.
"""

MIN_GAIN = 12.0
"""Least gain of the log posterior that the first step promises. It is 3 to 10 for the vehicle
described, 10 to 160 for those of grade S1.
"""

MAX_OBSTACLES = 0.4
"""Largest share of samples about obstacles. It is up to 0.3 on ISO and Belgian roads, above 0.4
with potholes or bumps."""

ROUNDS, FLEXIBLE_ROUNDS = ((1, 2), (15, 1)), ((1, 2), (1, 2), (15, 1))
"""Passes of the smoother, at most those of the estimate, and steps of scoring in each round; for a
rigid vehicle and for one that may twist and bend."""


@dataclass(frozen=True, eq=False)
class AdaptedVehicle:
    """A vehicle `x` (P,) of a `space`, the `covariance` (P, P) of what is unknown of it, and the
    noise scale that is left unexplained `before` and `after`.
    """

    space: ParameterSpace
    instruments: Instruments
    x: np.ndarray
    covariance: np.ndarray
    before: float
    after: float

    @property
    def car(self) -> VehicleParameters:
        """The adapted vehicle."""
        return self.space.from_vector(self.x)

    @property
    def note(self) -> str:
        """The adaptation in words, for the notes of an estimate."""
        return (
            f"the vehicle was adapted to the drive: {self.before:.1f} times the noise power of the "
            f"instruments and the friction was unexplained, now {self.after:.1f} times"
        )

    def model(self, segment: Segment) -> SpectralModel:
        """Return the model of a segment with the noise of an uncertain vehicle."""
        model = fit_hyperparameters(SensedVehicle.of(self.car, self.instruments), segment)
        _, dH = responses(self.space, self.x, self.instruments, segment, model)
        return replace(model, model_error=model_error_psd(dH, self.covariance, model.S))


def adapt_vehicle(
    record: Record,
    segment: Segment,
    model: SpectralModel,
    car: VehicleParameters,
    instruments: Instruments,
    passes: int,
) -> AdaptedVehicle | None:
    """Return the most probable vehicle on a `segment` of a `record`; None if it may well be `car`,
    or if no other explains more.

    `model` is that of the segment for `car`, `passes` those of the estimate. A vehicle is never
    adapted if its file gives no tolerances, the record has fewer than LEAST_CHANNELS channels, or
    much of it is obstacles, which are no part of a Gaussian process.
    """
    before = after = float(np.mean(model.noise_scale))
    if (
        before < DOUBTED_SCALE
        or not car.tolerances
        or active_sensors(segment).size < LEAST_CHANNELS
        or obstacle_samples(record).mean() > MAX_OBSTACLES
    ):
        return None
    flexible = before > STRUCTURE_SCALE and has_absent_elements(car)
    space = parameter_space(car, structure=flexible)
    x, covariance = np.zeros(space.size), np.eye(space.size)
    try:
        for k, (most, steps) in enumerate(FLEXIBLE_ROUNDS if flexible else ROUNDS):
            if k > 0 or flexible:
                vehicle = SensedVehicle.of(space.from_vector(x), instruments)
                model = fit_hyperparameters(vehicle, segment)
                after = float(np.mean(model.noise_scale))
            last = list(smooth_segment(model, segment, min(most, passes)))[-1]
            x, covariance, gain = fisher_scoring(space, x, instruments, segment, last, steps)
            if k == 0 and not flexible and gain < MIN_GAIN:
                return None
    except ArithmeticError:  # a fitted vehicle is none
        return None
    return (
        AdaptedVehicle(space, instruments, x, covariance, before, after) if after < before else None
    )


def responses(
    space: ParameterSpace,
    x: np.ndarray,
    instruments: Instruments,
    segment: Segment,
    model: SpectralModel,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the response H (F, S, 2) of the vehicle `x` (P,) at the lines of `model`, and its
    derivatives (P, F, S, 2).
    """
    v, mode, f, n = segment.v, segment.mode, model.f, model.n
    vehicle = SensedVehicle.of(space.from_vector(x), instruments)
    damping = equivalent_damping(vehicle.plant, mode, v, model.prior)
    linear = linearise(vehicle.plant, mode, vehicle.points, damping=damping, speed=v)
    rate = strut_rate_std(linear, v, f, model.S / v)
    from_rate = gaussian_damping(vehicle.plant, mode, rate)
    shifted = DIFFERENCE * np.eye(space.size)
    others = [SensedVehicle.of(space.from_vector(x + d), instruments) for d in shifted]
    models = [
        linearise(
            one.plant,
            mode,
            one.points,
            damping=damping * gaussian_damping(one.plant, mode, rate) / from_rate,
            speed=v,
        )
        for one in others
    ]
    unbent = frequency_response(linear, v, f=f)
    changes = response_changes(linear, models, v, f)
    H = vehicle.response(unbent, f, n)
    dH = [one.response(unbent + d, f, n) - H for one, d in zip(others, changes, strict=True)]
    return H, np.array(dH) / DIFFERENCE


def model_error_psd(dH: np.ndarray, covariance: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return the spectrum (F, S, S) that uncertain parameters add to S signals, to first order:
    sum over p, q of P_pq dH_p S dH_q*. It neglects that they depart equally at all frequencies.

    `dH` (P, F, S, 2): derivatives of the response; `covariance` (P, P) of the parameters; `S`
    (F, 2, 2): spectrum of the road.
    """
    root = np.linalg.cholesky(covariance)
    parts = np.tensordot(root.T, dH, axes=1)
    return np.sum(parts @ S @ hermitian(parts), axis=0)


def fisher_scoring(
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
    used = (model.f > F_LOW) & (model.f < F_C)
    sensors = active_sensors(segment)
    y = windowed_spectrum(model, replace(segment, a=iterate.y))[used][:, sensors]
    R = iterate.noise[used][:, sensors][:, :, sensors]
    part = replace(model, n=model.n[used], f=model.f[used], S=model.S[used])
    kappa = INDEPENDENT_SHARE * segment.a.shape[1] / model.size
    for _ in range(steps):
        H, dH = responses(space, x, instruments, segment, part)
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
        x = x - step * min(1.0, MAX_STEP / max(np.abs(step).max(), 1e-12))
        x = np.clip(x, -MAX_DEVIATION, MAX_DEVIATION)
    return x, np.linalg.inv(information), gain
