"""Roughness scores: spectral density, ISO 8608 class, IRI.

Truth `y` and estimate `a` are heights (2, M) [m], `ds` [m] apart; their densities `G_y` and `G_a`
(2, K) [m³] at `n` (K,) [cycles/m] use the same settings (ISO 8608: Welch, Hann, 50 % overlap,
segments of at most 100 m). The reference is the road as realised, not the class that it was drawn
from. Ratios of densities are 10 log10(estimate / truth) [dB], clipped to +-60 dB (a flat estimate).
"""

import numpy as np

from leaderboard.metrics.heights import SCORED_F_MAX, Band
from road_envs.records.roughness import (
    CLASSES,
    band_means,
    fit_line,
    golden_car,
    octave_levels,
    roughness_class,
    smooth_psd,
)

MAX_RATIO_DB = 60.0  # [dB]
IRI_SEGMENT_LENGTH = 100.0  # [m]
OCTAVE_CENTRES = (0.25, 0.5, 1.0, 2.0)  # [cycles/m] octaves in which classes are compared
THIRD_OCTAVES = 2.0 ** (np.arange(-9, 6) / 3.0)
"""Centres [cycles/m] of the third octaves of the error spectrum: 0.125 to 3.17."""


def third_octave_errors(n: np.ndarray, G_y: np.ndarray, G_e: np.ndarray) -> list[float]:
    """Return the NRMSE [-] in each of THIRD_OCTAVES, of both wheel paths together."""
    true, wrong = (
        band_means(
            n, G.sum(axis=0), THIRD_OCTAVES * 2.0 ** (-1 / 6), THIRD_OCTAVES * 2.0 ** (1 / 6)
        )
        for G in (G_y, G_e)
    )
    ratio = np.divide(wrong, true, out=np.full_like(true, np.nan), where=true > 0)
    return np.sqrt(ratio).tolist()


def dsd_distance(
    n: np.ndarray, G_y: np.ndarray, G_a: np.ndarray, band: Band
) -> tuple[float, float]:
    """Return RMS and mean [dB] of the density ratios over the third octaves inside `band`."""
    k = np.arange(np.ceil(3 * np.log2(band[0])), np.floor(3 * np.log2(band[1])) + 1)
    low, high = 2.0 ** ((k - 0.5) / 3), 2.0 ** ((k + 0.5) / 3)
    inside = (low >= band[0]) & (high <= band[1])
    true, estimated = (band_means(n, G, low[inside], high[inside]) for G in (G_y, G_a))
    ratio = _decibels(estimated, true)
    return float(np.sqrt(np.mean(ratio**2))), float(np.mean(ratio))


def class_differences(n: np.ndarray, G_y: np.ndarray, G_a: np.ndarray, v: float) -> np.ndarray:
    """Return estimated minus true ISO class (2, octaves), in classes; 0 where it is right.

    Covers those of OCTAVE_CENTRES that the 25 Hz low-pass at `v` [m/s] leaves whole; perhaps none.
    """
    whole = [n_c for n_c in OCTAVE_CENTRES if n_c * np.sqrt(2.0) <= SCORED_F_MAX / v]
    if not whole:
        return np.zeros((2, 0), dtype=int)
    octaves = (whole[0], whole[-1])
    true, estimated = (octave_levels(n, G, octaves)[1] for G in (G_y, G_a))
    return np.vectorize(_class_index, otypes=[int])(estimated) - np.vectorize(
        _class_index, otypes=[int]
    )(true)


def fitted_class(
    n: np.ndarray, G_y: np.ndarray, G_a: np.ndarray, band: Band
) -> tuple[float, float, float]:
    """Return the share [-] of wheel paths in the right class, and the error of Gd(n0) [dB].

    The error is given as mean magnitude and as signed mean. Class and Gd(n0) are those of the line
    with w = 2 fitted to the smoothed density inside `band`.
    """
    true, estimated = (np.array([_fitted_G_d0(n, path, band) for path in G]) for G in (G_y, G_a))
    right = [roughness_class(a) == roughness_class(y) for a, y in zip(estimated, true, strict=True)]
    error = _decibels(estimated, true)
    return float(np.mean(right)), float(np.mean(np.abs(error))), float(np.mean(error))


def iri_error(y: np.ndarray, a: np.ndarray, ds: float) -> tuple[float, float]:
    """Return the mean absolute IRI error per 100 m, in mm/m and relative to the true mean."""
    true, estimated = _iri(y, ds), _iri(a, ds)
    error = float(np.mean(np.abs(estimated - true)))
    return error, error / float(true.mean()) if true.any() else np.nan


def _iri(z: np.ndarray, ds: float) -> np.ndarray:
    """Return the IRI (2, segments) [mm/m] of whole segments of about 100 m."""
    motion = 1e3 * np.abs(golden_car(z, ds))  # m/m to mm/m
    segments = max(1, round(z.shape[-1] * ds / IRI_SEGMENT_LENGTH))
    return np.array([part.mean(axis=-1) for part in np.array_split(motion, segments, axis=-1)]).T


def _fitted_G_d0(n: np.ndarray, G: np.ndarray, band: Band) -> float:
    """Fit Gd(n0) [m³] of one wheel path by a line with w = 2 inside `band`; 0 if it is flat."""
    n, G = smooth_psd(n, G)
    inside = (n >= band[0]) & (n <= band[1]) & (G > 0.0)
    return fit_line(n, G, w=2.0, band=band)[0] if inside.sum() >= 2 else 0.0


def _class_index(G_d0: float) -> int:
    return list(CLASSES).index(roughness_class(G_d0))


def _decibels(a: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return 10 log10(a / y), clipped to +-MAX_RATIO_DB; NaN where both are 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.clip(10.0 * np.log10(a / y), -MAX_RATIO_DB, MAX_RATIO_DB)
