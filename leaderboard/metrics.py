"""How near an estimated profile is to the true one: pure functions of heights, each in its band.

Heights are (2, M) [m], the left and right wheel path, `ds` [m] apart. An accelerometer sees neither
drift nor what its low-pass takes away, so a pointwise score has a band [n_lo, n_hi] [cycles/m]:

    NRMSE  = rms(B e) / rms(B y)             e = a - y: estimate a, truth y, band-pass B
    r(lag) = <B y(s), B a(s + lag)> / (|B y| |B a|)
    eq. 12 = (rms(a) - rms(y)) / rms(y)      Ngwangwa et al., whole profile, no band

A flat estimate has NRMSE 1, an unrelated road of the same roughness sqrt(2). Equation 12 compares
two levels and nothing else: a road turned upside down scores 0. A score whose truth is flat is NaN.
"""

from typing import NamedTuple

import numpy as np
from scipy import signal
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from road_envs.record import F_MAX as F_MAX
from road_envs.record import N_HI as N_HI
from road_envs.record import N_LO as N_LO
from road_envs.record import scored_band as scored_band

VERSION = 1
"""Goes up whenever a score of the same two profiles changes; older results are then stale."""

Band = tuple[float, float]
FULL_BAND: Band = (0.05, 3.0)
LAG_MAX = 0.5  # [m]
SEGMENT = 10.0  # [m] of the coherence's Welch segments: 0.1 cycles/m apart
NOTHING = 1e-9  # an rms below this share of the truth's is rounding, not content


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


def band_pass(z: np.ndarray, ds: float, band: Band) -> np.ndarray:
    """The part of `z` (..., M) [m] inside `band`, without phase shift; (..., K) with K < M.

    The profile loses its straight line, is continued by odd reflection (height and slope go on)
    and faded to nothing over 20 m, so neither drift nor ends leak into the band; then every
    frequency outside is set to zero. One longest wavelength, at most a tenth, is cut from each end.
    """
    M = z.shape[-1]
    pad = min(M - 1, round(20.0 / ds))
    ends = [(0, 0)] * (z.ndim - 1) + [(pad, pad)]
    z = np.pad(signal.detrend(z), ends, mode="reflect", reflect_type="odd")
    z = z * signal.windows.tukey(z.shape[-1], 2 * pad / z.shape[-1])
    size = next_fast_len(z.shape[-1], real=True)
    n = rfftfreq(size, ds)
    spectrum = np.where((n >= band[0]) & (n <= band[1]), rfft(z, size), 0.0)
    trim = round(min(1.0 / band[0], 0.1 * M * ds) / ds)
    return irfft(spectrum, size)[..., pad + trim : pad + M - trim]


def nrmse(y: np.ndarray, a: np.ndarray, ds: float, band: Band) -> Sides:
    """RMS [-] of the error of estimate `a` over RMS of truth `y`, both (2, M), inside `band`."""
    return _ratio(band_pass(a - y, ds, band), band_pass(y, ds, band))


def correlation(y: np.ndarray, a: np.ndarray, ds: float, band: Band) -> Correlation:
    """Pearson's r over both wheel paths inside `band`; lags are searched within +-0.5 m.

    An estimate without any content in the band has r = 0 at lag 0.
    """
    y, a = band_pass(y, ds, band), band_pass(a, ds, band)
    reach = min(int(LAG_MAX / ds), y.shape[-1] // 4)
    inner = y[:, reach : y.shape[-1] - reach]
    shifts = np.arange(-reach, reach + 1)
    r = np.array([_pearson(inner, a[:, reach + k : reach + k + inner.shape[-1]]) for k in shifts])
    best = int(np.argmax(r)) if np.nan_to_num(r).any() else reach
    return Correlation(_pearson(y, a), float(shifts[best] * ds), float(r[best]))


def coherence(y: np.ndarray, a: np.ndarray, ds: float, band: Band) -> float:
    """Mean of gamma2(n) [-] over `band` and both wheel paths (Welch, Hann, 10 m, 50 % overlap).

    Two unrelated profiles have 1 / (independent segments), not 0: about 0.1 at 100 m.
    """
    size = min(round(SEGMENT / ds), y.shape[-1] // 4)
    n, P_yy = signal.welch(y, 1.0 / ds, nperseg=size)
    P_aa = signal.welch(a, 1.0 / ds, nperseg=size)[1]
    P_ya = signal.csd(y, a, 1.0 / ds, nperseg=size)[1]
    inside = (n >= band[0]) & (n <= band[1])
    product = P_yy * P_aa
    gamma2 = np.divide(np.abs(P_ya) ** 2, product, out=np.zeros_like(product), where=product > 0)
    return float(gamma2[:, inside].mean()) if P_yy.any() else np.nan


def level_error(y: np.ndarray, a: np.ndarray) -> Sides:
    """Equation 12 with its sign [-]: how much the RMS of `a` exceeds that of `y`, both (2, M).

    Heights are taken as given, from whatever datum. The paper prints one number for a drive of two
    wheel paths and does not say how it was formed; `pooled` takes the RMS over both.
    """
    return Sides(*(level - 1.0 for level in _ratio(a, y)))


def about_mean(z: np.ndarray) -> np.ndarray:
    """Heights (2, M) [m] about the mean of each wheel path."""
    return z - z.mean(axis=-1, keepdims=True)


def _ratio(above: np.ndarray, below: np.ndarray) -> Sides:
    """RMS of `above` over RMS of `below`, both (2, M); NaN over a wheel path that is flat."""
    a, b = np.mean(above**2, axis=-1), np.mean(below**2, axis=-1)
    a, b = np.append(a, a.mean()), np.append(b, b.mean())
    ratio = np.divide(a, b, out=np.full(3, np.nan), where=b > NOTHING**2 * b[2])
    return Sides(*np.sqrt(ratio).tolist())


def _pearson(y: np.ndarray, a: np.ndarray) -> float:
    """Correlation over both wheel paths of band-passed (hence mean-free) profiles (2, K)."""
    yy, aa = np.sum(y * y), np.sum(a * a)
    if yy == 0.0:
        return np.nan
    return float(np.sum(y * a) / np.sqrt(yy * aa)) if aa > NOTHING**2 * yy else 0.0
