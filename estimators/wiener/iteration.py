"""Smoothing of a segment by iterated statistical linearisation.

On a segment the signals a are a Gaussian process of known spectrum, observed at the valid samples.
With C the covariance that the spectrum defines on a circle and M the selection of valid samples,

    z^ = C_za M' (M C_aa M')^-1 a

handles ends and gaps exactly (`spectral_model.solve_circulant`).

Each further pass linearises about the estimate: z^ gives the motion of the struts and its
uncertainty, hence the expected nonlinear force residual q and its variance. q is subtracted from
the signals, part of its variance remains as noise, and the noise scale is fitted again. The passes
may diverge where wheels leave the ground; a diverging pass is discarded.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, rfft

from estimators.wiener.segments import Segment
from estimators.wiener.spectral_model import (
    SpectralModel,
    active_sensors,
    apply_response,
    run_em,
    signal_psd,
    solve_circulant,
    windowed_spectrum,
)
from estimators.wiener.tuning import TUNING
from road_envs.analysis.information_bound import posterior
from road_envs.analysis.statistical_linearization import NonlinearResidual, hermitian
from road_envs.records.record import F_C, PROFILE_SPACING, scored_band


class Iterate(NamedTuple):
    """Result of a pass: spectral lines of the wheel paths `z` (2, F) and of the struts' extension
    rates `w` (4, F), and the spectral density `error` (F, 2, 2) [m³] of the paths' errors; beside
    them its `model`, signals `y` (S, M) [m/s²] and spectrum `noise` (F, S, S).
    """

    z: np.ndarray
    w: np.ndarray
    error: np.ndarray
    model: SpectralModel
    y: np.ndarray
    noise: np.ndarray


def smooth_segment(model: SpectralModel, segment: Segment, passes: int) -> Iterate:
    """Return the result of the last pass, when `passes` are done or the iteration ends, or of the
    one before which it diverges.
    """
    M, size, measured = segment.a.shape[1], model.size, max(int(segment.valid.sum()), 1)
    q, share = np.zeros((4, size)), np.ones(4)
    change = 1.0
    start: np.ndarray | None = None  # the previous solution warm-starts the next solve
    first: float | None = None
    iterate: Iterate | None = None
    for remaining in reversed(range(passes)):
        residual_lines = apply_response(model.H_force, rfft(q))
        y = np.where(segment.valid, segment.a - irfft(residual_lines, size)[:, :M], 0.0)
        if start is not None:
            lines = windowed_spectrum(model, replace(segment, a=y))
            _, noise_scale = run_em(model, lines, active_sensors(segment), share)
            model = replace(model, noise_scale=noise_scale)
        noise = model.noise_psd(share)
        spectrum = signal_psd(model, noise)
        start = solve_circulant(spectrum / (2.0 * segment.spacing), y, segment.valid, size, start)
        log_det = np.mean(np.linalg.slogdet(spectrum)[1]) / len(y)
        neg_log_likelihood = float(np.vdot(y, start)) / measured + log_det
        first = neg_log_likelihood if first is None else first
        # less likely than the first pass while q still changes much: keep the previous pass
        if change > TUNING.divergence_threshold and not neg_log_likelihood <= first:
            break
        z = apply_response(model.S @ hermitian(model.H), rfft(start, size))
        z = z / (2.0 * segment.spacing) * (model.f > TUNING.f_datum)
        w = apply_response(model.X, z) + apply_response(model.X_force, rfft(q))
        error = posterior(model.n, model.H, model.S, noise).error
        iterate = Iterate(z, w, error, model, y, noise)
        if not remaining:
            break
        expected, unknown = _residual_forces(iterate)
        change = float(np.linalg.norm(expected - q)) / max(float(np.linalg.norm(expected)), 1e-9)
        if change < TUNING.converged:
            break
        q += TUNING.relaxation * (expected - q)
        unresolved = unknown / np.maximum(model.residual_power, 1e-9)
        share = np.clip(TUNING.residual_noise_share * unresolved, 0.01, 1.0)
    assert iterate is not None
    return iterate


def to_grid(segment: Segment, iterate: Iterate) -> tuple[np.ndarray, np.ndarray]:
    """Return heights and standard deviations (2, N) [m] at profile stations of the segment."""
    model = iterate.model
    size = model.size * segment.stride
    lines = np.zeros((2, size // 2 + 1), dtype=complex)
    lines[:, : model.n.size] = iterate.z * (model.f < F_C)
    z = irfft(lines, size) * segment.stride
    low, high = scored_band(segment.v)
    band = (model.n >= low) & (model.n <= high)

    def std(spectrum: np.ndarray) -> np.ndarray:
        return np.sqrt(np.trapezoid(np.real(np.einsum("fii->if", spectrum[band])), model.n[band]))

    # valid samples within 1.5 m of each profile station
    measured = np.repeat(segment.valid.mean(axis=0), segment.stride)
    window = np.ones(2 * round(1.5 / PROFILE_SPACING) + 1)
    share = np.zeros(size)
    share[: measured.size] = np.convolve(measured, window / window.size, "same").clip(0.0, 1.0)
    known, prior = std(iterate.error)[:, None] ** 2, std(model.S)[:, None] ** 2
    return z, np.sqrt(share * known + (1.0 - share) * prior)


def _residual_forces(iterate: Iterate) -> tuple[np.ndarray, np.ndarray]:
    """Return expected force residuals (4, size) [N] and their mean variances (4,) [N²]."""
    model = iterate.model
    slow = model.f > TUNING.f_datum
    per_rate = np.where(slow, 1.0 / (2j * np.pi * model.f), 0.0)
    w, e = irfft(iterate.w, model.size), irfft(iterate.w * per_rate, model.size)
    P = np.real(np.einsum("fwa,fab,fwb->wf", model.X, iterate.error, model.X.conj()))
    use = slow & (model.f < F_C)
    std_w = np.sqrt(np.trapezoid(P[:, use], model.n[use]))
    std_e = np.sqrt(np.trapezoid((P * np.abs(per_rate) ** 2)[:, use], model.n[use]))
    return _gaussian_expectation(model.residual_law, e, w, std_e, std_w)


def _gaussian_expectation(
    law: NonlinearResidual, e: np.ndarray, w: np.ndarray, std_e: np.ndarray, std_w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected force (4, N) [N] and its variance (4,) [N²], averaged over N.

    The extensions `e` [m] and rates `w` [m/s] (4, N) have Gaussian errors of standard deviation
    `std_e` and `std_w` (4,).
    """
    mean, variance = np.zeros(e.shape), np.zeros(4)
    for x, *rows in (law.e, law.over_extension, e, std_e), (law.e_dot, law.over_rate, w, std_w):
        for i, (table, at, std) in enumerate(zip(*rows, strict=True)):
            first, second = (_gaussian_average(x, y, std) for y in (table, table**2))
            mean[i] += np.interp(at, x, first)
            variance[i] += float(np.mean(np.interp(at, x, second - first**2)))
    return mean, variance


def _gaussian_average(at: np.ndarray, table: np.ndarray, std: float) -> np.ndarray:
    """Return E[table(at + std x)] for a standard normal x, by a 13-point sum."""
    x = np.linspace(-3.0, 3.0, 13)
    weight = np.exp(-0.5 * x**2)
    weight /= weight.sum()
    return weight @ np.array([np.interp(at + std * each, at, table) for each in x])
