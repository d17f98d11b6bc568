"""Frequency-domain measurement model of the linearised vehicle on a segment.

    a = H z + H_F q + e     z wheel paths, q nonlinear residuals of the strut forces, e sensor noise

Estimated per segment: the level G_d(n0) of the road prior, its shape (the deviation of each octave
from a waviness of 2) and a noise scale per octave, by empirical Bayes with expectation
maximisation (Dempster, Laird & Rubin, J. R. Stat. Soc. B 39, 1977), alternating with the equivalent
dampers, which depend on the road. Noise and road are separable because three sensors observe two
wheel paths: one combination of the sensors contains noise alone. A vehicle that differs from the
model appears in this combination too and raises the noise scale.
"""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.ndimage import binary_opening, find_objects, label

from estimators.common.bending import BODY, SensedBending, sensed_bending
from estimators.common.conjugate_gradients import conjugate_gradients
from estimators.wiener.segments import Segment
from estimators.wiener.tuning import TUNING
from road_envs.analysis.information_bound import F_C, RoadPrior, equivalent_damping, posterior
from road_envs.analysis.statistical_linearization import (
    NonlinearResidual,
    hermitian,
    nonlinear_residual,
    residual_force_psd,
)
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle import linear_model
from road_envs.vehicle.equations import Plant, build_plant
from road_envs.vehicle.parameters import VehicleParameters

# Band centres of the noise scale [Hz] and of the road's shape [cycles/m], interpolated over the log
_NOISE_OCTAVES = np.array([0.7, 1.4, 2.8, 5.6, 11.0, 20.0])
_ROAD_OCTAVES = 0.125 * 2.0 ** np.arange(6)


@dataclass(frozen=True, kw_only=True)
class _ShapedRoadPrior(RoadPrior):
    """Road prior with a factor `shape` at _ROAD_OCTAVES on its power law."""

    shape: tuple[float, ...] = (1.0,) * _ROAD_OCTAVES.size

    def density(self, n: np.ndarray) -> np.ndarray:
        """Return the one-sided displacement PSD [m³] of a wheel path at `n` [cycles/m] > 0."""
        log_shape = np.interp(np.log(n), np.log(_ROAD_OCTAVES), np.log(self.shape))
        return super().density(n) * np.exp(log_shape)


@dataclass(frozen=True, eq=False)
class SensedVehicle:
    """A vehicle as its `instruments` read it: `points` (x, y) [m] whose accelerations they need,
    `track` [m] of its wheel paths, `contact_length` [m] of its tyres, `bending` of its body.
    """

    plant: Plant
    points: dict[str, tuple[Any, ...]]
    instruments: Instruments
    track: float
    contact_length: float
    bending: SensedBending | None

    @classmethod
    def of(cls, car: VehicleParameters, instruments: Instruments) -> Self:
        """Return a vehicle with its instruments. Raises ConfigError."""
        locations, track = instruments.locations(car), car.front.y_t + car.rear.y_t
        bending, contact = sensed_bending(car, locations), car.variation.contact_length
        points = {**locations, **({} if bending is None else BODY)}
        return cls(build_plant(car), points, instruments, track, contact, bending)

    def readings(self, response: np.ndarray, f: np.ndarray) -> np.ndarray:
        """Return responses (F, S, K) of the sensors, from those of the `points` at `f` [Hz]."""
        sensed = response if self.bending is None else self.bending.response(response, f)
        return sensed * self.instruments.response(f)[:, None, None]

    def response(self, unbent: np.ndarray, f: np.ndarray, n: np.ndarray) -> np.ndarray:
        """Return the responses (F, S, 2) of the sensors to the wheel paths, from those of the
        `points` to the road under the tyres.
        """
        return self.readings(unbent, f) * self.envelope(n)[:, None, None]

    def envelope(self, n: np.ndarray) -> np.ndarray:
        """Return by how much the tyres envelop waves of `n` [cycles/m]."""
        return np.sinc(n * self.contact_length)


@dataclass(frozen=True, eq=False)
class SpectralModel:
    """Model on the frequencies `n` [cycles/m], `f` [Hz] (F,) of a circle of `size` stations.

    - `H` (F, S, 2) [m/s² per m], `X` (F, 4, 2) [m/s per m]: responses of the sensors and of the
      struts' rates of extension to the wheel paths; `H_force` (F, S, 4), `X_force` (F, 4, 4): to
      strut forces
    - `residual_law`: nonlinear part of the strut forces; `residual_power` (4,) [N²]: its power;
      `residual_psd` (F, 4, 4) [N² m]: its spectrum over n
    - `sensor_psd` [(m/s²)² m]: noise of a sensor; `model_error` (F, S, S): what an uncertain
      vehicle adds; `noise_scale` (F,): factor on all noise
    - `prior`: road prior; `S` (F, 2, 2) [m³]: its spectrum
    """

    size: int
    n: np.ndarray
    f: np.ndarray
    H: np.ndarray
    X: np.ndarray
    H_force: np.ndarray
    X_force: np.ndarray
    residual_law: NonlinearResidual
    residual_power: np.ndarray
    residual_psd: np.ndarray
    sensor_psd: float
    model_error: np.ndarray | float
    prior: _ShapedRoadPrior
    S: np.ndarray
    noise_scale: np.ndarray

    def noise_psd(self, share: np.ndarray | None = None) -> np.ndarray:
        """Return the spectrum (F, S, S) of all noise; `share` (4,) scales the residuals' power."""
        residual = self.residual_psd
        if share is not None:
            residual = residual * np.sqrt(np.outer(share, share))
        forces = self.H_force @ residual @ hermitian(self.H_force)
        noise = forces + self.sensor_psd * np.eye(self.H.shape[1]) + self.model_error
        return self.noise_scale[:, None, None] * noise


def fit_hyperparameters(vehicle: SensedVehicle, segment: Segment) -> SpectralModel:
    """Return the model of a `segment` with fitted road prior and noise scale."""
    padding = round(TUNING.circle_padding / segment.spacing)
    size = next_fast_len(segment.a.shape[1] + padding, real=True)
    prior = _ShapedRoadPrior(track=vehicle.track)
    noise_scale = np.ones(size // 2 + 1)
    for k in range(TUNING.damping_iterations):
        model = _build_model(vehicle, segment, prior, size, noise_scale)
        lines = windowed_spectrum(model, segment)
        prior, noise_scale = run_em(model, lines, active_sensors(segment))
        if k > 0 and abs(prior.G_d0 / model.prior.G_d0 - 1.0) < TUNING.level_tolerance:
            break
    return replace(model, noise_scale=noise_scale, prior=prior, S=prior.spectrum(model.n))


def _build_model(
    vehicle: SensedVehicle, segment: Segment, prior: _ShapedRoadPrior, size: int, scale: np.ndarray
) -> SpectralModel:
    """Return the model of a `segment` for this road `prior` on a circle of `size` stations."""
    v, plant = segment.v, vehicle.plant
    n = rfftfreq(size, segment.spacing)
    n[0] = 0.5 * n[1]  # at 0 the responses vanish and the prior is infinite
    f = n * v
    damping = equivalent_damping(plant, segment.mode, v, prior)
    linear = linear_model.linearise(plant, segment.mode, vehicle.points, damping=damping, speed=v)
    H_force, X_force = linear_model.force_response(linear, f)
    X = linear_model.combine_wheel_paths(linear, v, f, linear_model.strut_rate_response(linear, f))
    law = nonlinear_residual(plant, segment.mode, damping)

    def under_tyres(n: np.ndarray) -> np.ndarray:
        return prior.spectrum(n) * vehicle.envelope(n)[:, None, None] ** 2

    D = residual_force_psd(linear, law, v, under_tyres, f)
    return SpectralModel(
        size=size,
        n=n,
        f=f,
        H=vehicle.response(linear_model.frequency_response(linear, v, f=f), f, n),
        X=X * vehicle.envelope(n)[:, None, None],
        H_force=vehicle.readings(H_force, f),
        X_force=X_force,
        residual_law=law,
        residual_power=np.trapezoid(np.real(np.einsum("fww->wf", D)), f),
        residual_psd=D * v,
        sensor_psd=max(vehicle.instruments.noise_density, 1e-6) ** 2 * v,
        model_error=0.0,
        prior=prior,
        S=prior.spectrum(n),
        noise_scale=scale,
    )


def windowed_spectrum(model: SpectralModel, segment: Segment) -> np.ndarray:
    """Return a segment's lines (F, S, 1) [m/s² sqrt(m)]; gaps hold their conditional mean."""
    measured = np.flatnonzero(segment.valid[active_sensors(segment)].any(axis=0))
    span = np.zeros(segment.a.shape[1], dtype=bool)
    if measured.size:
        span[measured[0] : measured[-1] + 1] = True
    a, holed = segment.a, span & ~segment.valid[active_sensors(segment)].all(axis=0)
    if holed.any():
        C = signal_psd(model, model.noise_psd()) / (2.0 * segment.spacing)
        x = solve_circulant(C, a, segment.valid, model.size)
        a = np.where(segment.valid, a, _circulant_product(C, x, model.size))
    # Hann windows between long gaps: without them the body's resonances leak to frequencies of low
    # power, and what a gap holds has less than the road
    window = np.zeros(span.size)
    long = binary_opening(holed, np.ones(round(TUNING.longest_filled * span.sum()) + 1))
    for part in find_objects(label(span & ~long)[0]):
        size = part[0].stop - part[0].start
        window[part] = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
    power = max(float(window @ window), 1e-9)
    return rfft(a * window * np.sqrt(2.0 * segment.spacing / power), model.size).T[:, :, None]


def active_sensors(segment: Segment) -> np.ndarray:
    """Return the sensors with at least half as many valid samples as the best one."""
    share = segment.valid.mean(axis=1)
    return np.flatnonzero(share > 0.5 * share.max())


def run_em(
    model: SpectralModel, lines: np.ndarray, sensors: np.ndarray, share: np.ndarray | None = None
) -> tuple[_ShapedRoadPrior, np.ndarray]:
    """Return updated road prior and noise scale (F,), given `lines` (F, S, 1) of the `sensors`.

    With fewer than three sensors the noise scale is kept: noise and road are not separable.
    """
    in_band = (model.f > TUNING.f_low) & (model.f < F_C)
    n, y, H = model.n[in_band], lines[in_band][:, sensors], model.H[in_band][:, sensors]
    base = model.noise_psd(share) / model.noise_scale[:, None, None]
    base = base[in_band][:, sensors][:, :, sensors]
    band = np.argmin(np.abs(np.log(model.f[in_band, None] / _NOISE_OCTAVES)), axis=1)
    factor = np.interp(np.log(_NOISE_OCTAVES), np.log(model.f), model.noise_scale)
    octave = np.argmin(np.abs(np.log(n[:, None] / _ROAD_OCTAVES)), axis=1)
    level = model.prior.G_d0
    unit = replace(model.prior, G_d0=1.0, shape=_ShapedRoadPrior.shape).spectrum(n)
    shape = np.array(model.prior.shape)
    for _ in range(TUNING.em_iterations):
        S, R = unit * (level * shape[octave, None, None]), base * factor[band, None, None]
        road_posterior = posterior(n, H, S, R)
        z = road_posterior.gain @ y
        e = y - H @ z
        road = z @ hermitian(z) + road_posterior.error
        noise = e @ hermitian(e) + H @ road_posterior.error @ hermitian(H)
        level_per_line = np.trace(np.linalg.solve(unit, road), axis1=1, axis2=2).real / 2.0
        level = float(np.mean(level_per_line / shape[octave]))
        shape = _shrunk_band_means(level_per_line / level, octave, _ROAD_OCTAVES.size)
        if sensors.size >= 3:
            ratio = np.linalg.solve(base, noise)
            scale_per_line = np.trace(ratio, axis1=1, axis2=2).real / sensors.size
            factor = _shrunk_band_means(scale_per_line, band, _NOISE_OCTAVES.size)
    prior = replace(model.prior, G_d0=level, shape=tuple(shape.tolist()))
    return prior, np.exp(np.interp(np.log(model.f), np.log(_NOISE_OCTAVES), np.log(factor)))


def _shrunk_band_means(values: np.ndarray, band: np.ndarray, bands: int) -> np.ndarray:
    """Return means (bands,) of the lines' values by `band`, shrunk to 1 by `pseudo_count`."""
    count = np.bincount(band, minlength=bands) + TUNING.pseudo_count
    return (np.bincount(band, values, bands) + TUNING.pseudo_count) / count


def signal_psd(model: SpectralModel, noise: np.ndarray) -> np.ndarray:
    """Return the spectrum (F, S, S) over n of the signals, given that of the noise."""
    return model.H @ model.S @ hermitian(model.H) + noise


def apply_response(responses: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Return the lines (a, F) of responses (F, a, b) to lines (b, F)."""
    return np.einsum("fab,bf->af", responses, lines)


def _circulant_product(spectrum: np.ndarray, x: np.ndarray, size: int) -> np.ndarray:
    """Return the circulant matrix of a spectrum (F, a, a) times signals `x` (a, M)."""
    return irfft(apply_response(spectrum, rfft(x, size)), size)[:, : x.shape[1]]


def solve_circulant(
    C: np.ndarray, y: np.ndarray, valid: np.ndarray, size: int, start: np.ndarray | None = None
) -> np.ndarray:
    """Return x (S, M), zero where not `valid`, with C x = y (S, M) where `valid`.

    Conjugate gradients with FFT products; the preconditioner is C^-1 of the circle.
    """
    inverse = np.linalg.inv(C)
    x, _ = conjugate_gradients(
        lambda x: valid * _circulant_product(C, x, size),
        valid * y,
        lambda r: valid * _circulant_product(inverse, r, size),
        TUNING.cg_steps_max,
        TUNING.cg_tolerance,
        start,
    )
    return x
