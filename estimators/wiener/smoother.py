"""Wiener smoother of a record by segments, with gaps and iterated statistical linearisation.

On a segment the signals a are a Gaussian process of known spectrum, observed at the valid samples.
With C the covariance that the spectrum defines on a circle and M the selection of valid samples,

    z^ = C_za M' (M C_aa M')^-1 a

handles ends and gaps exactly (`spectral_model.solve_circulant`).

Each further pass linearises about the estimate: z^ gives the motion of the struts and its
uncertainty, hence the expected nonlinear force residual q and its variance. q is subtracted from
the signals, part of its variance remains as noise, and the noise scale is fitted again. The passes
may diverge where wheels leave the ground; a diverging pass is discarded (`smooth_segment`).
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, rfft

from estimators.common.explained import trusted_share, untrusted_note
from estimators.common.fallback import reduce_unexplained
from estimators.common.odometer import calibrate_odometer
from estimators.preprocessing import mask_record
from estimators.wiener.segments import Segment, split_segments
from estimators.wiener.spectral_model import (
    SensedVehicle,
    SpectralModel,
    active_sensors,
    apply_response,
    fit_hyperparameters,
    hermitian,
    run_em,
    signal_psd,
    solve_circulant,
    windowed_spectrum,
)
from road_envs.analysis.statistical_linearization import NonlinearResidual
from road_envs.data.record import (
    F_C,
    PROFILE_SPACING,
    Estimate,
    Record,
    profile_stations,
    scored_band,
)
from road_envs.sensing.instruments import instruments_of
from road_envs.vehicle.parameters import VehicleParameters

SEGMENT_LENGTH, SEGMENT_MARGIN = 150.0, 40.0
"""Length [m] of a segment, and of the record used on either side of it."""

F_DATUM = 0.1
"""Lowest frequency [Hz] that is estimated."""

RELAXATION = 0.7
"""Relaxation factor of the update of the force residual."""

RESIDUAL_NOISE_SHARE = 0.5
"""Fraction of the residual's unresolved power that counts as noise in the next pass. Less than 1,
since errors of neighbouring samples cancel; tuned on training drives.
"""

DIVERGENCE_THRESHOLD = 0.8
"""Relative change of the residual between passes that may indicate divergence."""

CONVERGED = 0.02
"""Relative change of the residual below which further passes change the error by half a percent."""

NOISE_SCALE_WARNING = 2.0
"""Mean scale of the noise on a segment above which a note says so. With the paper's instruments it
is 0.85 to 1.3 for the vehicle and mode described, 1.7 to 2.4 in ride if handling was driven, and
above 40 for a vehicle of grade S2; a drive in ride that is described as handling stays below.
"""


class Iterate(NamedTuple):
    """Result of a pass: spectral lines of the wheel paths `z` (2, F) and of the struts' extension
    rates `w` (4, F), and the spectral density `error` (F, 2, 2) [m³] of the paths' errors.
    """

    z: np.ndarray
    w: np.ndarray
    error: np.ndarray


def smooth_record(
    record: Record, car: VehicleParameters, instruments: str, passes: int, std_factor: float
) -> Estimate:
    """Estimate both wheel paths; `std_factor` scales the standard deviations in the scored band.

    Raises ConfigError on unknown instruments, RecordError.
    """
    record, odometer = calibrate_odometer(record)
    sensors = instruments_of(record, instruments)
    vehicle = SensedVehicle.of(car, sensors)
    stations = profile_stations(record.length)
    total, total_std, weights = (np.zeros((2, stations.size)) for _ in range(3))
    masked = mask_record(record, sensors)
    notes, unexplained = [*masked.notes, *odometer], 0.0
    for segment in split_segments(masked, SEGMENT_LENGTH, SEGMENT_MARGIN):
        model = fit_hyperparameters(vehicle, segment)
        unexplained = max(unexplained, float(np.mean(model.noise_scale)))
        last = list(smooth_segment(model, segment, passes))[-1]
        z, std = to_grid(model, segment, last)
        at = np.round(stations / PROFILE_SPACING).astype(int) - segment.first * segment.stride
        weight = _blend_weights(stations, segment.core, record.length)
        inside = (at >= 0) & (at < z.shape[1]) & (weight > 0.0)
        total[:, inside] += weight[inside] * z[:, at[inside]]
        total_std[:, inside] += weight[inside] * std[:, at[inside]]
        weights[:, inside] += weight[inside]
        notes += segment.notes
    if unexplained > NOISE_SCALE_WARNING:
        notes.append(
            f"{unexplained:.1f} times the noise power of the instruments and the friction is left "
            "unexplained: the vehicle or the state of its struts may differ from the one described"
        )
    weights = np.maximum(weights, 1e-12)
    z, std = total / weights, std_factor * total_std / weights
    share = trusted_share(masked.record, masked.valid, car, sensors, z)
    z, z_std = reduce_unexplained(z, std, share)
    return Estimate(stations, z, z_std, (*notes, *untrusted_note(share)))


def smooth_segment(model: SpectralModel, segment: Segment, passes: int) -> Iterator[Iterate]:
    """Yield the result of each pass until `passes` are done, or the iteration ends or diverges."""
    M, size, measured = segment.a.shape[1], model.size, max(int(segment.valid.sum()), 1)
    q, share = np.zeros((4, size)), np.ones(4)
    start: np.ndarray | None = None  # the previous solution warm-starts the next solve
    first: float | None = None
    change = 1.0
    for _ in range(passes):
        residual_lines = apply_response(model.H_force, rfft(q))
        y = np.where(segment.valid, segment.a - irfft(residual_lines, size)[:, :M], 0.0)
        if start is not None:
            lines = windowed_spectrum(model, replace(segment, a=y))
            _, noise_scale = run_em(model, lines, active_sensors(segment), share)
            model = replace(model, noise_scale=noise_scale)
        spectrum = signal_psd(model, model.noise_psd(share))
        start = solve_circulant(spectrum / (2.0 * segment.spacing), y, segment.valid, size, start)
        neg_log_likelihood = float(np.vdot(y, start)) / measured + np.mean(
            np.linalg.slogdet(spectrum)[1]
        ) / len(y)
        first = neg_log_likelihood if first is None else first
        # less likely than the first pass while q still changes much: keep the previous pass
        if change > DIVERGENCE_THRESHOLD and not neg_log_likelihood <= first:
            return
        SH = model.S @ hermitian(model.H)
        z = apply_response(SH, rfft(start, size)) / (2.0 * segment.spacing) * (model.f > F_DATUM)
        w = apply_response(model.X, z) + apply_response(model.X_force, rfft(q))
        iterate = Iterate(z, w, model.posterior(share).error)
        yield iterate
        expected, unknown = _residual_forces(model, iterate)
        change = float(np.linalg.norm(expected - q)) / max(float(np.linalg.norm(expected)), 1e-9)
        if change < CONVERGED:
            return
        q += RELAXATION * (expected - q)
        share = np.clip(
            RESIDUAL_NOISE_SHARE * unknown / np.maximum(model.residual_power, 1e-9), 0.01, 1.0
        )


def to_grid(
    model: SpectralModel, segment: Segment, iterate: Iterate
) -> tuple[np.ndarray, np.ndarray]:
    """Return heights and standard deviations (2, N) [m] at profile stations of the segment."""
    size = model.size * segment.stride
    lines = np.zeros((2, size // 2 + 1), dtype=complex)
    lines[:, : model.n.size] = iterate.z * (model.f < F_C)
    z = irfft(lines, size) * segment.stride
    low, high = scored_band(segment.v)
    band = (model.n >= low) & (model.n <= high)

    def std(spectrum: np.ndarray) -> np.ndarray:
        return np.sqrt(np.trapezoid(np.real(np.einsum("fii->if", spectrum[band])), model.n[band]))

    share = _coverage(segment, size)
    known, prior = std(iterate.error)[:, None] ** 2, std(model.S)[:, None] ** 2
    return z, np.sqrt(share * known + (1.0 - share) * prior)


def _coverage(segment: Segment, size: int) -> np.ndarray:
    """Return the fraction (size,) of valid samples within 1.5 m of each profile station."""
    measured = np.repeat(segment.valid.mean(axis=0), segment.stride)
    window = np.ones(2 * round(1.5 / PROFILE_SPACING) + 1)
    share = np.zeros(size)
    share[: measured.size] = np.convolve(measured, window / window.size, "same")
    return np.clip(share, 0.0, 1.0)


def _blend_weights(stations: np.ndarray, core: tuple[float, float], length: float) -> np.ndarray:
    """Return a segment's weight at each station: 1 in its core, with a linear transition of half
    the margin to its neighbours.
    """
    fade = 0.5 * SEGMENT_MARGIN
    up = np.clip((stations - core[0]) / fade + 0.5, 0.0, 1.0) if core[0] > 0.0 else 1.0
    down = np.clip((core[1] - stations) / fade + 0.5, 0.0, 1.0) if core[1] < length else 1.0
    return np.minimum(up, down) * np.ones(stations.size)


def _residual_forces(model: SpectralModel, iterate: Iterate) -> tuple[np.ndarray, np.ndarray]:
    """Return expected force residuals (4, size) [N] and their mean variances (4,) [N²]."""
    slow = model.f > F_DATUM
    per_rate = np.where(slow, 1.0 / (2j * np.pi * model.f), 0.0)
    w, e = irfft(iterate.w, model.size), irfft(iterate.w * per_rate, model.size)
    P = np.real(np.einsum("fwa,fab,fwb->wf", model.X, iterate.error, model.X.conj()))
    use = slow & (model.f < F_C)
    std_w = np.sqrt(np.trapezoid(P[:, use], model.n[use]))
    std_e = np.sqrt(np.trapezoid((P * np.abs(per_rate) ** 2)[:, use], model.n[use]))
    return gaussian_expectation(model.residual_law, e, w, std_e, std_w)


def gaussian_expectation(
    law: NonlinearResidual, e: np.ndarray, w: np.ndarray, std_e: np.ndarray, std_w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected force (4, N) [N] and its variance (4,) [N²], averaged over N.

    The extensions `e` [m] and rates `w` [m/s] (4, N) have Gaussian errors of standard deviation
    `std_e` and `std_w` (4,).
    """
    mean, variance = np.zeros(e.shape), np.zeros(4)
    for i in range(4):
        tables = (
            (law.e, law.over_extension[i], e[i], std_e[i]),
            (law.e_dot, law.over_rate[i], w[i], std_w[i]),
        )
        for grid_, table, at, std in tables:
            first = _gaussian_average(grid_, table, std)
            second = _gaussian_average(grid_, table**2, std)
            mean[i] += np.interp(at, grid_, first)
            variance[i] += float(np.mean(np.interp(at, grid_, second - first**2)))
    return mean, variance


def _gaussian_average(at: np.ndarray, table: np.ndarray, std: float) -> np.ndarray:
    """Return E[table(at + std x)] for a standard normal x, by a 13-point sum."""
    x = np.linspace(-3.0, 3.0, 13)
    weight = np.exp(-0.5 * x**2)
    weight /= weight.sum()
    return weight @ np.array([np.interp(at + std * each, at, table) for each in x])
