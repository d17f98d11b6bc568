"""The Wiener smoother of a whole record: stretch by stretch, with gaps, and again with what of the
struts' forces is not linear taken out.

On a stretch the signals are a Gaussian process of known spectrum, measured where they can be
trusted. With C the covariance that this spectrum makes on a circle and M the selection of what is
measured, the estimate is

    z^ = C_za M' (M C_aa M')^-1 a

so ends and gaps are nothing in particular (`build_model.solve`).

A `pass` beyond the first is statistical linearisation about the estimate itself: from z^ follow the
struts' motion and its uncertainty, from these the expected remainder q of their forces and what is
left unknown of it; q is taken out of the signals, what is left stays as noise, and the level of all
noise is fitted again. Where wheels leave the ground the passes may not converge: one that makes the
signals less likely than the first did, after a remainder that was still another one than before, is
refused, and the one before it stands.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, rfft

from estimators.wiener.segments import Segment, split_segments
from estimators.wiener.spectral_model import (
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
from road_envs.analysis.information_bound import F_C
from road_envs.analysis.statistical_linearization import NonlinearResidual
from road_envs.data.record import PROFILE_SPACING, Estimate, Record, profile_stations, scored_band
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.parameters import VehicleParameters

SEGMENT_LENGTH, SEGMENT_MARGIN = 150.0, 40.0
"""Stretches [m], and the record around them that they also see."""

F_DATUM = 0.1
"""Slower than this [Hz] nothing is claimed."""

RELAXATION = 0.7
"""Share of the way to a new remainder that a pass goes."""

RESIDUAL_NOISE_SHARE = 0.5
"""Of the power that a pass cannot know of the remainder, the share that counts as noise in the
next. Less than all, since errors of neighbouring moments cancel; tuned on training drives."""

DIVERGENCE_THRESHOLD = 0.8
"""Change of the remainder from pass to pass, relative to itself."""


class Iterate(NamedTuple):
    """Lines of wheel paths `z` (2, F) and of struts' rates `w` (4, F) on a circle, and the
    densities `error` (F, 2, 2) [m³] of the paths' errors.
    """

    z: np.ndarray
    w: np.ndarray
    error: np.ndarray


def smooth_record(
    record: Record, car: VehicleParameters, instruments: str, passes: int, std_factor: float
) -> Estimate:
    """Both wheel paths, with standard deviations in the judged band times `std_factor`.

    Raises ConfigError on unknown instruments, ValueError on a record that says nothing.
    """
    sensors, plant = load_instruments(instruments), build_plant(car)
    locations, track = sensors.locations(car), car.front.y_t + car.rear.y_t
    stations = profile_stations(record.length)
    total, square, weights = (np.zeros((2, stations.size)) for _ in range(3))
    notes: list[str] = []
    segments = list(split_segments(record, sensors, SEGMENT_LENGTH, SEGMENT_MARGIN))
    for segment in segments:
        model = fit_hyperparameters(plant, locations, sensors, segment, track)
        last = list(smooth_segment(model, segment, passes))[-1]
        z, std = to_grid(model, segment, last)
        at = np.round(stations / PROFILE_SPACING).astype(int) - segment.first * segment.stride
        weight = _blend_weights(stations, segment.core, record.length)
        inside = (at >= 0) & (at < z.shape[1]) & (weight > 0.0)
        total[:, inside] += weight[inside] * z[:, at[inside]]
        square[:, inside] += weight[inside] * std[:, at[inside]]
        weights[:, inside] += weight[inside]
        notes += segment.notes
    weights = np.maximum(weights, 1e-12)
    return Estimate(stations, total / weights, std_factor * square / weights, tuple(notes))


def smooth_segment(model: SpectralModel, segment: Segment, passes: int) -> Iterator[Iterate]:
    """The estimate after each pass that counts."""
    M, size, measured = segment.a.shape[1], model.size, max(int(segment.valid.sum()), 1)
    q, share = np.zeros((4, size)), np.ones(4)
    start: np.ndarray | None = None
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
        neg_log_likelihood = (
            float(np.vdot(y, start)) / measured + np.mean(np.linalg.slogdet(spectrum)[1]) / 3
        )
        first = neg_log_likelihood if first is None else first
        if change > DIVERGENCE_THRESHOLD and not neg_log_likelihood <= first:
            return
        SH = model.S @ hermitian(model.H)
        z = apply_response(SH, rfft(start, size)) / (2.0 * segment.spacing) * (model.f > F_DATUM)
        w = apply_response(model.X, z) + apply_response(model.X_force, rfft(q))
        iterate = Iterate(z, w, model.posterior(share).error)
        yield iterate
        expected, unknown = _residual_forces(model, iterate)
        change = float(np.linalg.norm(expected - q)) / max(float(np.linalg.norm(expected)), 1e-9)
        q += RELAXATION * (expected - q)
        share = np.clip(
            RESIDUAL_NOISE_SHARE * unknown / np.maximum(model.residual_power, 1e-9), 0.01, 1.0
        )


def to_grid(
    model: SpectralModel, segment: Segment, iterate: Iterate
) -> tuple[np.ndarray, np.ndarray]:
    """Heights and their standard deviations (2, N) [m], in steps of GRID from the first station."""
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
    """Share (size,) of the samples about each station that were measured, 1.5 m to either side."""
    measured = np.repeat(segment.valid.mean(axis=0), segment.stride)
    window = np.ones(2 * round(1.5 / PROFILE_SPACING) + 1)
    share = np.zeros(size)
    share[: measured.size] = np.convolve(measured, window / window.size, "same")
    return np.clip(share, 0.0, 1.0)


def _blend_weights(stations: np.ndarray, core: tuple[float, float], length: float) -> np.ndarray:
    """How much a stretch says at each station: all in its core, fading over half the margin into
    its neighbours.
    """
    fade = 0.5 * SEGMENT_MARGIN
    up = np.clip((stations - core[0]) / fade + 0.5, 0.0, 1.0) if core[0] > 0.0 else 1.0
    down = np.clip((core[1] - stations) / fade + 0.5, 0.0, 1.0) if core[1] < length else 1.0
    return np.minimum(up, down) * np.ones(stations.size)


def _residual_forces(model: SpectralModel, iterate: Iterate) -> tuple[np.ndarray, np.ndarray]:
    """Expected remainders (4, size) [N] of the struts' forces, and the power (4,) [N²] unknown."""
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
    """Mean force (4, N) [N] at extensions `e` and rates `w` (4, N) that are known but for normal
    errors of `std_e` [m], `std_w` [m/s] (4,), and its mean variance (4,) [N²].
    """
    mean, variance = np.zeros(e.shape), np.zeros(4)
    for i in range(4):
        tables = (
            (law.e, law.over_extension[i], e[i], std_e[i]),
            (law.e_dot, law.over_rate[i], w[i], std_w[i]),
        )
        for grid_, table, at, std in tables:
            first, second = (
                _gaussian_average(grid_, table, std),
                _gaussian_average(grid_, table**2, std),
            )
            mean[i] += np.interp(at, grid_, first)
            variance[i] += float(np.mean(np.interp(at, grid_, second - first**2)))
    return mean, variance


def _gaussian_average(at: np.ndarray, table: np.ndarray, std: float) -> np.ndarray:
    """E[table(at + std x)] for a normal x, by 13 points."""
    x = np.linspace(-3.0, 3.0, 13)
    weight = np.exp(-0.5 * x**2)
    weight /= weight.sum()
    return weight @ np.array([np.interp(at + std * each, at, table) for each in x])
