"""Roughness of a profile: displacement spectral density and class (ISO 8608), and IRI.

Profiles `z` (..., N) [m] are sampled every `ds` [m] along the last axis. Densities are one-sided,
`G` (..., K) [m³] at the spatial frequencies `n` (K,) [cycles/m]. A level is the density G_d(n0)
[m³] at n0 = 0.1 cycles/m of the road G_d(n0) (n / n0)^-2 with the same density at a frequency.
"""

import itertools
from functools import cache, lru_cache
from typing import Annotated

import numpy as np
import scipy

from road_envs.core.config import Positive

Band = tuple[float, float]  # lower and upper limit of spatial frequency [cycles/m]
N_0 = 0.1  # reference spatial frequency of ISO 8608 [cycles/m]

TrackWidth = Annotated[Positive, "m", "distance between the wheel paths"]
TRACK: TrackWidth = 1.5  # default of `TrackWidth`

CLASSES = {name: 16e-6 * 4.0**k for k, name in enumerate("ABCDEFGH")}
"""Geometric mean of G_d(n0) [m³] of each class (ISO 8608, table C.1); its limit is twice that."""

FIT_BAND = (0.011, 2.83)  # band [cycles/m] of the straight-line fit of ISO 8608


def displacement_psd(
    z: np.ndarray, ds: float, segment: float = 100.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacement PSD: `n` (K,) [cycles/m] without 0, and `G` (..., K) [m³].

    Welch's method: linearly detrended, half overlapping Hann windows of at most `segment` [m].
    """
    z = np.asarray(z, dtype=float)
    size = min(z.shape[-1], round(segment / ds))
    n, G = scipy.signal.welch(z, 1.0 / ds, "hann", size, size // 2, detrend=detrend_linear)
    return n[1:], G[..., 1:]


def root_coherence(n: np.ndarray, w: float, track: float) -> np.ndarray:
    """Return the square root of the coherence of two paths of an isotropic surface.

    The paths are `track` [m] apart; `n` [cycles/m] has any shape, `w` is the waviness. With
    x = 2 pi n track and v = w / 2 the result is 2^(1-v) / Gamma(v) x^v K_v(x), 1 at n = 0 (Kamash &
    Robson, J. Sound Vib. 57, 1978, for w = 2: x K_1(x); Matérn's integral for any w).
    """
    x, v = 2.0 * np.pi * np.asarray(n, dtype=float) * track, 0.5 * w
    x = np.maximum(x, 1e-12)  # K_v is infinite at 0, x^v K_v(x) is not; both are 0 for large x
    scale = 2.0 ** (1.0 - v) / scipy.special.gamma(v)
    return np.clip(scale * x**v * scipy.special.kv(v, x), 0.0, 1.0)


def detrend_linear(z: np.ndarray) -> np.ndarray:
    """Return `z` (..., N) without its least-squares straight line along the last axis."""
    x = np.arange(z.shape[-1]) - 0.5 * (z.shape[-1] - 1)
    slope = np.einsum("...i,i->...", z, x) / np.sum(x * x)  # avoids BLAS, which starts threads
    return z - z.mean(axis=-1, keepdims=True) - slope[..., None] * x


def band_pass(z: np.ndarray, ds: float, band: Band) -> np.ndarray:
    """Return the part of `z` (..., M) [m] inside `band`, without phase shift; (..., K) with K < M.

    So that neither drift nor ends leak into the band, the least-squares line is subtracted and the
    profile continued by odd reflection (height and slope go on), tapered to zero over 20 m. One
    longest wavelength, at most a tenth, is cut from each end.
    """
    M = z.shape[-1]
    pad = min(M - 1, round(20.0 / ds))
    ends = [(0, 0)] * (z.ndim - 1) + [(pad, pad)]
    z = np.pad(detrend_linear(z), ends, mode="reflect", reflect_type="odd")
    z = z * scipy.signal.windows.tukey(z.shape[-1], 2 * pad / z.shape[-1])
    size = scipy.fft.next_fast_len(z.shape[-1], real=True)
    n = scipy.fft.rfftfreq(size, ds)
    spectrum = np.where((n >= band[0]) & (n <= band[1]), scipy.fft.rfft(z, size), 0.0)
    trim = round(min(1.0 / band[0], 0.1 * M * ds) / ds)
    return scipy.fft.irfft(spectrum, size)[..., pad + trim : pad + M - trim]


def smooth_psd(n: np.ndarray, G: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the density averaged over the bands of ISO 8608: centres (M,) and means (..., M).

    They are octaves up to 0.0312 cycles/m, third octaves up to 0.25, twelfth octaves above; those
    that exceed `n`, which is equidistant and starts at its spacing, are omitted.
    """
    octave, third = 2.0**-4.5, 2.0 ** (-2 + 1 / 6)  # upper limits of the bands of 2^-5 and 2^-2
    edges = np.r_[
        octave * 2.0 ** np.arange(-8, 0),
        octave * 2.0 ** (np.arange(8) / 3.0),
        third * 2.0 ** (np.arange(12 * 12) / 12.0),
    ]
    half = 0.5 * (n[1] - n[0])
    edges = edges[(edges >= n[0] - half) & (edges <= n[-1] + half)]
    return np.sqrt(edges[1:] * edges[:-1]), band_means(n, G, edges[:-1], edges[1:])


def band_means(n: np.ndarray, G: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the mean density (..., M) [m³] over the bands from `low` to `high` (M,) [cycles/m].

    Each of the equidistant `n` represents the cell around it (ISO 8608, clause on smoothing).
    """
    return G @ _band_weights(*(np.asarray(x, dtype=float).tobytes() for x in (n, low, high)))


@lru_cache(maxsize=64)
def _band_weights(n: bytes, low: bytes, high: bytes) -> np.ndarray:
    """Share (K, M) of each cell in each band; a board asks for a few, often."""
    cells, begins, ends = (np.frombuffer(x) for x in (n, low, high))
    half = 0.5 * (cells[1] - cells[0])
    inside = np.minimum(ends[:, None], cells + half) - np.maximum(begins[:, None], cells - half)
    return (np.maximum(inside, 0.0) / (ends - begins)[:, None]).T


def fit_line(
    n: np.ndarray, G: np.ndarray, w: float | None = None, band: tuple[float, float] = FIT_BAND
) -> tuple[float, float]:
    """Return `G_d0` [m³] and the waviness of the least-squares line of log G (K,) over log n.

    Points inside `band` are used, which should be smoothed: equidistant over log n. With a given
    `w` only the level is fitted. Raises ValueError on fewer than two points of positive density.
    """
    use = (n >= band[0]) & (n <= band[1]) & (G > 0.0)
    if use.sum() < 2:
        raise ValueError(
            "the profile is too short or too coarse for an ISO 8608 class: fewer than 2 points of "
            f"its density are in {band[0]} to {band[1]} cycles/m"
        )
    x, y = np.log(n[use] / N_0), np.log(G[use])
    if w is None:
        slope, level = np.polyfit(x, y, 1)
        return float(np.exp(level)), float(-slope)
    return float(np.exp(np.mean(y + w * x))), w


def roughness_class(G_d0: float) -> str:
    """Return the class "A" to "H" of a road with the density `G_d0` [m³] at n0."""
    return next((name for name, mean in CLASSES.items() if G_d0 < 2.0 * mean), "H")


def octave_levels(
    n: np.ndarray, G: np.ndarray, band: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (M,) of the octaves inside `band` [cycles/m], and their levels (..., M) [m³].

    The centres are powers of two. The mean of n^-2 over an octave is its value at the centre, so
    that the level of an ISO road is its G_d(n0), of which `roughness_class` gives the class.
    """
    low, high = np.ceil(np.log2(band[0])), np.floor(np.log2(band[1]))
    centre = 2.0 ** np.arange(low, high + 1.0)
    means = band_means(n, G, centre * 2.0**-0.5, centre * 2.0**0.5)
    return centre, means * (centre / N_0) ** 2


def iri(
    z: np.ndarray, ds: float, average: float = 0.25, segment: float | None = None
) -> np.ndarray:
    """Return the International Roughness Index [mm/m], (...,) or (..., segments).

    It is the mean magnitude of `golden_car`, over the whole profile or each whole `segment` [m].
    """
    motion = 1e3 * np.abs(golden_car(z, ds, average))
    if segment is None:
        return motion.mean(axis=-1)
    size = round(segment / ds)
    count = motion.shape[-1] // size
    return motion[..., : count * size].reshape(*motion.shape[:-1], count, size).mean(axis=-1)


def golden_car(z: np.ndarray, ds: float, average: float = 0.25) -> np.ndarray:
    """Return the suspension slope (..., N - base) [-] of the golden car at 80 km/h.

        z_s'' = K2 (z_u - z_s) + C (z_u' - z_s')
        mu z_u'' = -z_s'' + K1 (y - z_u)          K1 = 653, K2 = 63.3, C = 6, mu = 0.15

    (Sayers, Transp. Res. Rec. 1501, 1995; ASTM E1926). The profile y is a moving average over
    `average` [m], rounded to `base` whole steps (0: none), and linear between samples, for which
    the state transition is exact, mode by mode. The initial motion follows the mean slope of the
    first 11 m. Raises ValueError if the profile is shorter than `average`.
    """
    z = np.asarray(z, dtype=float)
    base = max(1, round(average / ds))
    if z.shape[-1] <= base:
        raise ValueError(f"a profile of {z.shape[-1]} samples is shorter than {average} m")
    slope = (z[..., base:] - z[..., :-base]) / (base * ds)
    first = max(1, min(round(11.0 / ds), z.shape[-1] - 1))
    start = (z[..., first] - z[..., 0]) / (first * ds)

    poles, modes, inputs = _golden_modes(ds)
    initial = np.linalg.solve(modes, np.array([1.0, 0.0, 1.0, 0.0]))
    rattle = modes[0] - modes[2]
    out = np.zeros(slope.shape, dtype=complex)
    for pole, gain, x, output in zip(poles, inputs, initial, rattle, strict=True):
        zi = pole * x * start[..., None]
        out += output * scipy.signal.lfilter([gain], [1.0, -pole], slope, zi=zi)[0]
    return out.real


@cache
def _golden_modes(ds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return poles (4,), modes (4, 4) and modal inputs (4,) for one step `ds` [m]."""
    K1, K2, C, mu = 653.0, 63.3, 6.0, 0.15
    body, wheel = [-K2, -C, K2, C], [K2 / mu, C / mu, -(K1 + K2) / mu, -C / mu]
    A = np.array([[0.0, 1.0, 0.0, 0.0], body, [0.0, 0.0, 0.0, 1.0], wheel])
    B = np.array([0.0, 0.0, 0.0, K1 / mu])
    S = scipy.linalg.expm(A * ds / (80.0 / 3.6))
    P = np.linalg.solve(A, (S - np.eye(4)) @ B)
    poles, modes = np.linalg.eig(S)
    return poles, modes, np.linalg.solve(modes, P)


IN_PER_MI = 63.36  # inches per mile in 1 mm/m
COARSEST = 0.3  # widest spacing [m] of which the IRI is computed (ASTM E1926: 300 mm, class 2)


def profile_indices(z: np.ndarray, ds: float, segment: float) -> list[dict[str, float]]:
    """Return the roughness of both wheel paths `z` (2, N) [m] by segments of `segment` [m].

    Each has `begin_m` and `end_m` [m], and `left`, `right`, `mean` (MRI) and `half_car` (HRI, that
    of the mean profile; Sayers 1989) [mm/m]. A segment begins with the motion behind the last (ASTM
    E1926); a rest of less than half a segment belongs to the one before. Raises ValueError if the
    spacing is above COARSEST, or the profile is shorter than 11 m.
    """
    if ds > COARSEST:
        raise ValueError(f"a spacing of {ds:g} m; the IRI needs at most {COARSEST:g} m")
    length = (z.shape[-1] - 1) * ds
    if length < 11.0:
        raise ValueError(f"a profile of {length:.3g} m; the IRI needs at least 11 m")
    motion = 1e3 * np.abs(golden_car(np.stack([z[0], z[1], z.mean(axis=0)]), ds))
    count = int(length / segment + 0.5)
    edges = [0.0, *(k * segment for k in range(1, count)), length]
    rows = []
    for begin, end in itertools.pairwise(edges):
        last = None if end == length else round(end / ds)
        left, right, half = motion[:, round(begin / ds) : last].mean(axis=1)
        rows.append({"begin_m": begin, "end_m": end, "left": float(left), "right": float(right),
                     "mean": 0.5 * float(left + right), "half_car": float(half)})  # fmt: skip
    return rows
