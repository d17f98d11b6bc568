"""Distance between an estimated and a true profile: pure functions of heights, each with its band.

Heights are (2, M) [m], the left and right wheel path, `ds` [m] apart. An accelerometer senses
neither drift nor what its low-pass removes, so a pointwise score has a band [n_lo, n_hi]
[cycles/m]:

    NRMSE  = rms(B e) / rms(B y)             e = a - y: estimate a, truth y, band-pass B
    r(lag) = <B y(s), B a(s + lag)> / (|B y| |B a|)
    eq. 12 = (rms(a) - rms(y)) / rms(y)      Ngwangwa et al., whole profile, no band

A flat estimate has NRMSE 1, an unrelated road of the same roughness sqrt(2). Equation 12 compares
two levels and nothing else: the truth with its sign flipped scores 0. Scores relative to a flat
truth are NaN.

Where an estimate has a standard deviation sigma, the in-band error is scored against a normal
distribution (Gneiting & Raftery, J. Am. Stat. Assoc. 102, 2007, eq. 21):

    CRPS = mean of sigma (x (2 Phi(x) - 1) + 2 phi(x) - 1 / sqrt(pi)),       x = B e / sigma

It is the mean absolute error where sigma is 0.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import signal
from scipy.fft import rfft, rfftfreq
from scipy.special import ndtr, ndtri

from road_envs.records.record import scored_band as scored_band
from road_envs.records.roughness import Band as Band
from road_envs.records.roughness import band_pass as band_pass

VERSION = 5  # raised whenever a score of the same two profiles changes: older results are stale
_LAG_MAX = 0.5  # [m]
_SEGMENT_LENGTH = 10.0  # [m] Welch segment of the coherence: resolution 0.1 cycles/m
_NEGLIGIBLE = 1e-9  # an RMS below this share of the truth's is rounding error


class _Sides(NamedTuple):  # a score of each wheel path, and of both pooled
    left: float
    right: float
    pooled: float


class Correlation(NamedTuple):
    """Pearson's r at equal stations, and the largest r with its `lag` [m] (+: estimate late)."""

    r: float
    lag: float
    r_at_lag: float


class _Uncertainty(NamedTuple):  # CRPS [m], shares [-] of errors inside 50 % and 90 % intervals
    crps: float
    coverage_50: float
    coverage_90: float


def nrmse(y: np.ndarray, a: np.ndarray, ds: float, band: Band) -> _Sides:
    """Return RMS error over RMS truth [-], of estimate `a` and truth `y` (2, M), inside `band`."""
    return error_over_truth(*in_band(y, a, ds, band))


def in_band(y: np.ndarray, a: np.ndarray, ds: float, band: Band) -> tuple[np.ndarray, np.ndarray]:
    """Return truth `y` and estimate `a` (2, M) [m] inside `band`, each (2, K). A truth with nothing
    but rounding error there, of a level road or a slope, is flat.
    """
    within, estimated = band_pass(np.stack([y, a]), ds, band)
    is_flat = np.mean(within**2) <= _NEGLIGIBLE**2 * np.mean(y**2)
    return within * (not is_flat), estimated


def error_over_truth(y: np.ndarray, a: np.ndarray) -> _Sides:
    """Return RMS error over RMS truth [-], of `a` and `y` (2, K) as they are."""
    return _ratio(a - y, y)


def correlation(y: np.ndarray, a: np.ndarray, ds: float) -> Correlation:
    """Return the correlation of two band-passed profiles (2, K); lags are within +-_LAG_MAX. An
    estimate without content has r = 0 at lag 0.
    """
    inner, shifted = _shifts(y, a, ds)
    reach = shifted.shape[1] // 2
    # products and energies at every lag k, summed over both paths i and the inner stations j
    product = np.einsum("ij,ikj->k", inner, shifted)
    energy = np.einsum("ikj,ikj->k", shifted, shifted)
    r = _pearson(np.sum(inner * inner), energy, product)
    best = int(np.argmax(r)) if np.nan_to_num(r).any() else reach
    whole = _pearson(np.sum(y * y), np.sum(a * a), np.sum(y * a))
    return Correlation(float(whole), float((best - reach) * ds), float(r[best]))


def error_at_best_lag(y: np.ndarray, a: np.ndarray, ds: float) -> float:
    """Return the least RMS error over RMS truth [-] of `a` shifted within +-_LAG_MAX against `y`,
    both band-passed (2, K), at the stations that every shift covers. NaN over a flat truth.
    """
    inner, shifted = _shifts(y, a, ds)
    # mean over both paths and the inner stations, then the least over the lags
    error = np.mean((shifted - inner[:, None]) ** 2, axis=(0, 2)).min()
    truth = np.mean(inner**2)
    return float(np.sqrt(error / truth)) if truth > 0.0 else np.nan


def _shifts(y: np.ndarray, a: np.ndarray, ds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the inner stations of `y` (2, L), and `a` there at every lag (2, lags, L)."""
    reach = min(int(_LAG_MAX / ds), y.shape[-1] // 4)
    inner = y[:, reach : y.shape[-1] - reach]
    return inner, sliding_window_view(a, inner.shape[-1], axis=-1)


def coherence(y: np.ndarray, a: np.ndarray, ds: float, band: Band) -> float:
    """Return the mean of gamma2(n) [-] over `band` and paths (Welch, Hann, 10 m, 50 % overlap): of
    unrelated profiles not 0, but 1 / (independent segments), about 0.1 at 100 m.
    """
    size = min(round(_SEGMENT_LENGTH / ds), y.shape[-1] // 4)
    Y, A = _segments(y, size), _segments(a, size)
    n = rfftfreq(size, ds)
    inside = (n >= band[0]) & (n <= band[1])
    P_yy, P_aa = ((x.real**2 + x.imag**2).sum(axis=1)[:, inside] for x in (Y, A))
    P_ya = (Y.conj() * A).sum(axis=1)[:, inside]
    product = P_yy * P_aa
    gamma2 = np.divide(np.abs(P_ya) ** 2, product, out=np.zeros_like(product), where=product > 0)
    return float(gamma2.mean()) if P_yy.any() else np.nan


def uncertainty(y: np.ndarray, a: np.ndarray, sigma: np.ndarray) -> _Uncertainty:
    """Score the deviation `sigma` (2, M) [m] against the error of `a` from `y`, both (2, K), band-
    passed, K < M: the drift outside the band cannot be observed. With a `sigma` of 0, only an error
    of 0 lies inside the intervals.
    """
    e = np.abs(a - y)
    trim = (sigma.shape[-1] - e.shape[-1]) // 2
    sigma = sigma[:, trim : trim + e.shape[-1]]
    shares = [float(np.mean(e <= ndtri(0.5 + 0.5 * p) * sigma)) for p in (0.5, 0.9)]
    x = np.divide(e, sigma, out=np.full_like(e, np.inf), where=sigma > 0)
    density = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    spread = sigma * (2.0 * density - 1.0 / np.sqrt(np.pi))
    return _Uncertainty(float(np.mean(e * (2.0 * ndtr(x) - 1.0) + spread)), *shares)


def level_error(y: np.ndarray, a: np.ndarray) -> _Sides:
    """Return equation 12 with its sign [-]: the relative excess of the RMS of `a` over that of `y`,
    heights (2, M) as given, from any datum. The paper prints one number for two wheel paths and
    does not say how it was formed; `pooled` takes the RMS over both.
    """
    return _Sides(*(level - 1.0 for level in _ratio(a, y)))


def remove_mean(z: np.ndarray) -> np.ndarray:
    """Return the heights (2, M) [m] about the mean of each wheel path."""
    return z - z.mean(axis=-1, keepdims=True)


def _ratio(above: np.ndarray, below: np.ndarray) -> _Sides:
    """Return RMS of `above` over RMS of `below`, both (2, M); NaN over a flat wheel path."""
    a, b = np.mean(above**2, axis=-1), np.mean(below**2, axis=-1)
    a, b = np.append(a, a.mean()), np.append(b, b.mean())
    ratio = np.divide(a, b, out=np.full(3, np.nan), where=b > _NEGLIGIBLE**2 * b[2])
    return _Sides(*np.sqrt(ratio).tolist())


def _pearson(yy: np.ndarray, aa: np.ndarray, ya: np.ndarray) -> np.ndarray:
    """Return the correlation from sums of squares and products of zero-mean profiles."""
    if yy == 0.0:
        return np.full_like(ya, np.nan)
    has_content = aa > _NEGLIGIBLE**2 * yy
    return np.where(has_content, ya / np.sqrt(yy * np.where(has_content, aa, 1.0)), 0.0)


def _segments(z: np.ndarray, size: int) -> np.ndarray:
    """Return spectra (2, segments, K) of half-overlapping Hann-windowed segments of `z` (2, M)."""
    parts = sliding_window_view(z, size, axis=-1)[:, :: size - size // 2]
    window = signal.windows.hann(size, sym=False)
    return rfft((parts - parts.mean(axis=-1, keepdims=True)) * window)
