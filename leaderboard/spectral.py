"""How near the roughness of an estimate is to that of the truth: spectral density, class, IRI.

Truth `y` and estimate `a` are heights (2, M) [m], `ds` [m] apart; their densities `G_y` and `G_a`
(2, K) [m³] at `n` (K,) [cycles/m] are made under the same settings (ISO 8608: Welch, Hann, 50 %
overlap, segments of at most 100 m). The truth is the road as realised, not the class it was drawn
from. Ratios of densities are 10 log10(estimate / truth) [dB]; one beyond 60 dB, such as that of a
flat estimate, counts as 60 dB.
"""

import numpy as np

from leaderboard.metrics import F_MAX, Band, scored_band
from road_envs.roughness import (
    CLASSES,
    band_means,
    classify,
    dsd,
    fit_line,
    golden_car,
    octave_levels,
    smooth,
)

CAP = 60.0  # [dB]
IRI_SEGMENT = 100.0  # [m]


def scores(y: np.ndarray, a: np.ndarray, ds: float, v: float) -> dict[str, float]:
    """All scores of roughness for a drive at `v` [m/s]."""
    band = scored_band(v)
    (n, G_y), (_, G_a) = dsd(y, ds), dsd(a, ds)
    distance, bias = dsd_distance(n, G_y, G_a, band)
    exact, within_one = class_agreement(n, G_y, G_a, v)
    fitted, G_d0_error = fitted_class(n, G_y, G_a, band)
    error, relative = iri_error(y, a, ds)
    return {
        "dsd_distance_db": distance,
        "dsd_bias_db": bias,
        "class_exact": exact,
        "class_within_one": within_one,
        "fitted_class": fitted,
        "G_d0_error_db": G_d0_error,
        "iri_error": error,
        "iri_error_relative": relative,
    }


def dsd_distance(
    n: np.ndarray, G_y: np.ndarray, G_a: np.ndarray, band: Band
) -> tuple[float, float]:
    """RMS and mean [dB] of the density ratios over the third octaves that lie inside `band`."""
    k = np.arange(np.ceil(3 * np.log2(band[0])), np.floor(3 * np.log2(band[1])) + 1)
    low, high = 2.0 ** ((k - 0.5) / 3), 2.0 ** ((k + 0.5) / 3)
    inside = (low >= band[0]) & (high <= band[1])
    true, found = (band_means(n, G, low[inside], high[inside]) for G in (G_y, G_a))
    ratio = _decibels(found, true)
    return float(np.sqrt(np.mean(ratio**2))), float(np.mean(ratio))


def class_agreement(
    n: np.ndarray, G_y: np.ndarray, G_a: np.ndarray, v: float
) -> tuple[float, float]:
    """Shares [-] of octaves (both wheel paths) in the true ISO class, and within one class of it.

    The octaves at 0.25, 0.5, 1 and 2 cycles/m, as far as the 25 Hz low-pass leaves them whole.
    """
    octaves = (0.25, min(2.0, F_MAX / v / np.sqrt(2.0)))
    if octaves[1] < octaves[0]:
        return np.nan, np.nan
    true, found = (octave_levels(n, G, octaves)[1].ravel() for G in (G_y, G_a))
    steps = [_index(a) - _index(y) for a, y in zip(found, true, strict=True)]
    return float(np.mean(np.equal(steps, 0))), float(np.mean(np.abs(steps) <= 1))


def fitted_class(
    n: np.ndarray, G_y: np.ndarray, G_a: np.ndarray, band: Band
) -> tuple[float, float]:
    """Share [-] of wheel paths whose class is right, and mean size [dB] of the error of Gd(n0).

    Class and Gd(n0) are those of the line with w = 2 through the smoothed density inside `band`.
    """
    true, found = (np.array([_level(n, path, band) for path in G]) for G in (G_y, G_a))
    right = [classify(a) == classify(y) for a, y in zip(found, true, strict=True)]
    return float(np.mean(right)), float(np.mean(np.abs(_decibels(found, true))))


def iri_error(y: np.ndarray, a: np.ndarray, ds: float) -> tuple[float, float]:
    """Mean absolute error of the IRI per 100 m [mm/m], and relative to the true mean [-]."""
    true, found = _iri(y, ds), _iri(a, ds)
    error = float(np.mean(np.abs(found - true)))
    return error, error / float(true.mean()) if true.any() else np.nan


def _iri(z: np.ndarray, ds: float) -> np.ndarray:
    """IRI (2, segments) [mm/m]; the road is cut into whole segments of about 100 m."""
    motion = 1e3 * np.abs(golden_car(z, ds))
    segments = max(1, round(z.shape[-1] * ds / IRI_SEGMENT))
    return np.array([part.mean(axis=-1) for part in np.array_split(motion, segments, axis=-1)]).T


def _level(n: np.ndarray, G: np.ndarray, band: Band) -> float:
    """Gd(n0) [m³] of one wheel path by a line with w = 2 inside `band`; 0 if it is flat."""
    n, G = smooth(n, G)
    inside = (n >= band[0]) & (n <= band[1]) & (G > 0.0)
    return fit_line(n, G, w=2.0, band=band)[0] if inside.sum() >= 2 else 0.0


def _index(G_d0: float) -> int:
    return list(CLASSES).index(classify(G_d0))


def _decibels(a: np.ndarray, y: np.ndarray) -> np.ndarray:
    """10 log10(a / y), cut at +-60 dB; NaN where both are 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.clip(10.0 * np.log10(a / y), -CAP, CAP)
