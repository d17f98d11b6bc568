"""How near an estimated profile is to the true one: pure functions of heights, each in its band.

Heights are (2, M) [m], the left and right wheel path, `ds` [m] apart. An accelerometer sees neither
drift nor what its low-pass takes away, so a pointwise score has a band [n_lo, n_hi] [cycles/m]:

    NRMSE  = rms(B e) / rms(B y)             e = a - y: estimate a, truth y, band-pass B
    r(lag) = <B y(s), B a(s + lag)> / (|B y| |B a|)
    eq. 12 = (rms(a) - rms(y)) / rms(y)      Ngwangwa et al., whole profile, no band

A flat estimate has NRMSE 1, an unrelated road of the same roughness sqrt(2). Equation 12 compares
two levels and nothing else: a road turned upside down scores 0. A score whose truth is flat is NaN.

Where an estimate comes with a standard deviation, the error inside the band is held against it:

    CRPS = mean of sigma (x (2 Phi(x) - 1) + 2 phi(x) - 1 / sqrt(pi)),       x = B e / sigma

for a normal distribution (Gneiting & Raftery, J. Am. Stat. Assoc. 102, 2007, eq. 21): the mean
absolute error, if sigma is 0.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import signal
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.special import ndtr, ndtri

from road_envs.analysis.roughness import detrend_linear
from road_envs.data.record import SCORED_F_MAX as SCORED_F_MAX
from road_envs.data.record import SCORED_N_MAX as SCORED_N_MAX
from road_envs.data.record import SCORED_N_MIN as SCORED_N_MIN
from road_envs.data.record import scored_band as scored_band

VERSION = 2
"""Goes up whenever a score of the same two profiles changes; older results are then stale."""

Band = tuple[float, float]
FULL_BAND: Band = (0.05, 3.0)
LAG_MAX = 0.5  # [m]
SEGMENT_LENGTH = 10.0  # [m] of the coherence's Welch segments: 0.1 cycles/m apart
NEGLIGIBLE = 1e-9  # an rms below this share of the truth's is rounding, not content


class Sides(NamedTuple):
    """One score for each wheel path, and for both together."""

    left: float
    right: float
    pooled: float


class Correlation(NamedTuple):
    """Pearson's r at equal stations; the best r, at a `lag` [m] (+: the estimate comes late)."""

    r: float
    lag: float
    r_at_lag: float


class Uncertainty(NamedTuple):
    """CRPS [m], and the shares [-] of errors inside the intervals that should hold 50 and 90 %."""

    crps: float
    coverage_50: float
    coverage_90: float


def band_pass(z: np.ndarray, ds: float, band: Band) -> np.ndarray:
    """The part of `z` (..., M) [m] inside `band`, without phase shift; (..., K) with K < M.

    The profile loses its straight line, is continued by odd reflection (height and slope go on)
    and faded to nothing over 20 m, so neither drift nor ends leak into the band; then every
    frequency outside is set to zero. One longest wavelength, at most a tenth, is cut from each end.
    """
    M = z.shape[-1]
    pad = min(M - 1, round(20.0 / ds))
    ends = [(0, 0)] * (z.ndim - 1) + [(pad, pad)]
    z = np.pad(detrend_linear(z), ends, mode="reflect", reflect_type="odd")
    z = z * signal.windows.tukey(z.shape[-1], 2 * pad / z.shape[-1])
    size = next_fast_len(z.shape[-1], real=True)
    n = rfftfreq(size, ds)
    spectrum = np.where((n >= band[0]) & (n <= band[1]), rfft(z, size), 0.0)
    trim = round(min(1.0 / band[0], 0.1 * M * ds) / ds)
    return irfft(spectrum, size)[..., pad + trim : pad + M - trim]


def nrmse(y: np.ndarray, a: np.ndarray, ds: float, band: Band) -> Sides:
    """RMS [-] of the error of estimate `a` over RMS of truth `y`, both (2, M), inside `band`."""
    return error_over_truth(*band_pass(np.stack([y, a]), ds, band))


def error_over_truth(y: np.ndarray, a: np.ndarray) -> Sides:
    """RMS [-] of the error of estimate `a` over that of truth `y`, both (2, K) as they are."""
    return _ratio(a - y, y)


def correlation(y: np.ndarray, a: np.ndarray, ds: float) -> Correlation:
    """Pearson's r of two band-passed profiles (2, K); lags are searched within +-0.5 m.

    An estimate without any content has r = 0 at lag 0.
    """
    reach = min(int(LAG_MAX / ds), y.shape[-1] // 4)
    inner = y[:, reach : y.shape[-1] - reach]
    late = sliding_window_view(a, inner.shape[-1], axis=-1)  # (2, 2 reach + 1, inner)
    product = np.einsum("ij,ikj->k", inner, late)
    level = np.einsum("ikj,ikj->k", late, late)
    r = _pearson(np.sum(inner * inner), level, product)
    best = int(np.argmax(r)) if np.nan_to_num(r).any() else reach
    whole = _pearson(np.sum(y * y), np.sum(a * a), np.sum(y * a))
    return Correlation(float(whole), float((best - reach) * ds), float(r[best]))


def coherence(y: np.ndarray, a: np.ndarray, ds: float, band: Band) -> float:
    """Mean of gamma2(n) [-] over `band` and both wheel paths (Welch, Hann, 10 m, 50 % overlap).

    Two unrelated profiles have 1 / (independent segments), not 0: about 0.1 at 100 m.
    """
    size = min(round(SEGMENT_LENGTH / ds), y.shape[-1] // 4)
    Y, A = _segments(y, size), _segments(a, size)
    n = rfftfreq(size, ds)
    inside = (n >= band[0]) & (n <= band[1])
    P_yy, P_aa = ((x.real**2 + x.imag**2).sum(axis=1)[:, inside] for x in (Y, A))
    P_ya = (Y.conj() * A).sum(axis=1)[:, inside]
    product = P_yy * P_aa
    gamma2 = np.divide(np.abs(P_ya) ** 2, product, out=np.zeros_like(product), where=product > 0)
    return float(gamma2.mean()) if P_yy.any() else np.nan


def uncertainty(y: np.ndarray, a: np.ndarray, sigma: np.ndarray) -> Uncertainty:
    """How honest the standard deviation `sigma` (2, M) [m] is about the error of `a` from `y`.

    Both are (2, K), band-passed, K < M: of the drift outside nobody can be sure. A `sigma` of 0
    claims to know, and only an error of 0 lies inside its intervals.
    """
    e = a - y
    trim = (sigma.shape[-1] - e.shape[-1]) // 2
    sigma = sigma[:, trim : trim + e.shape[-1]]
    shares = [float(np.mean(np.abs(e) <= ndtri(0.5 + 0.5 * p) * sigma)) for p in (0.5, 0.9)]
    return Uncertainty(crps(e, sigma), *shares)


def crps(e: np.ndarray, sigma: np.ndarray) -> float:
    """Mean CRPS [m] of normal forecasts that err by `e` and claim `sigma`, both (...) [m]."""
    e = np.abs(e)
    x = np.divide(e, sigma, out=np.full_like(e, np.inf), where=sigma > 0)
    density = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    spread = sigma * (2.0 * density - 1.0 / np.sqrt(np.pi))
    return float(np.mean(e * (2.0 * ndtr(x) - 1.0) + spread))


def level_error(y: np.ndarray, a: np.ndarray) -> Sides:
    """Equation 12 with its sign [-]: how much the RMS of `a` exceeds that of `y`, both (2, M).

    Heights are taken as given, from whatever datum. The paper prints one number for a drive of two
    wheel paths and does not say how it was formed; `pooled` takes the RMS over both.
    """
    return Sides(*(level - 1.0 for level in _ratio(a, y)))


def remove_mean(z: np.ndarray) -> np.ndarray:
    """Heights (2, M) [m] about the mean of each wheel path."""
    return z - z.mean(axis=-1, keepdims=True)


def _ratio(above: np.ndarray, below: np.ndarray) -> Sides:
    """RMS of `above` over RMS of `below`, both (2, M); NaN over a wheel path that is flat."""
    a, b = np.mean(above**2, axis=-1), np.mean(below**2, axis=-1)
    a, b = np.append(a, a.mean()), np.append(b, b.mean())
    ratio = np.divide(a, b, out=np.full(3, np.nan), where=b > NEGLIGIBLE**2 * b[2])
    return Sides(*np.sqrt(ratio).tolist())


def _pearson(yy: np.ndarray, aa: np.ndarray, ya: np.ndarray) -> np.ndarray:
    """Correlation from sums of squares and products of band-passed (hence mean-free) profiles."""
    if yy == 0.0:
        return np.full_like(ya, np.nan)
    heard = aa > NEGLIGIBLE**2 * yy
    return np.where(heard, ya / np.sqrt(yy * np.where(heard, aa, 1.0)), 0.0)


def _segments(z: np.ndarray, size: int) -> np.ndarray:
    """Spectra (2, segments, K) of half-overlapping Hann-windowed stretches of `z` (2, M)."""
    parts = sliding_window_view(z, size, axis=-1)[:, :: size - size // 2]
    window = signal.windows.hann(size, sym=False)
    return rfft((parts - parts.mean(axis=-1, keepdims=True)) * window)
