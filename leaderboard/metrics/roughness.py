"""Roughness: spectral densities, ISO 8608 classes and IRI of an estimate against the true ones.

Truth `y` and estimate `a` are heights (2, M) [m], `ds` [m] apart; their densities `G_y` and `G_a`
(2, K) [m³] at `n` (K,) [cycles/m] use the same settings (ISO 8608: Welch, Hann, 50 % overlap,
segments of at most 100 m). The reference is the road as realised, not the class that it was drawn
from. Ratios of densities are 10 log10(estimate / truth) [dB], clipped to +-60 dB (a flat estimate).
"""

import numpy as np

from leaderboard.metrics.api import PERCENT, Metric, ScoredEstimate, metrics
from road_envs.records.record import SCORED_F_MAX
from road_envs.records.roughness import (
    CLASSES,
    Band,
    band_means,
    fit_line,
    golden_car,
    octave_levels,
    roughness_class,
    smooth_psd,
)

THIRD_OCTAVES = 2.0 ** (np.arange(-9, 6) / 3.0)  # their centres [cycles/m], from 0.125 to 3.17
_OCTAVE_CENTRES = (0.25, 0.5, 1.0, 2.0)  # [cycles/m] octaves in which classes are compared


@metrics(
    Metric("dsd_distance_db", "DSD distance", unit="dB", digits=1, head="DSD", help="RMS ratio of "
           "the estimated to the true displacement density over third octaves in band."),
    Metric("dsd_bias_db", "DSD bias", unit="dB", digits=1, better="zero", head="bias",
           help="Mean ratio of the estimated to the true density over third octaves in band."),
)  # fmt: skip
def _density_ratio(scored: ScoredEstimate) -> tuple[float, ...]:
    n, (G_y, G_a, _) = scored.densities
    low, high = scored.band
    k = np.arange(np.ceil(3 * np.log2(low)), np.floor(3 * np.log2(high)) + 1)
    begin, end = 2.0 ** ((k - 0.5) / 3), 2.0 ** ((k + 0.5) / 3)
    inside = (begin >= low) & (end <= high)
    true, estimated = (band_means(n, G, begin[inside], end[inside]) for G in (G_y, G_a))
    ratio = _decibels(estimated, true)
    return float(np.sqrt(np.mean(ratio**2))), float(np.mean(ratio))


def _class_steps(scored: ScoredEstimate) -> np.ndarray:
    """Return estimated minus true ISO class (2, octaves), in classes; 0 where it is right. Covers
    the octaves that the 25 Hz low-pass at the speed leaves whole; perhaps none.
    """
    n, (G_y, G_a, _) = scored.densities
    whole = [n_c for n_c in _OCTAVE_CENTRES if n_c * np.sqrt(2.0) <= SCORED_F_MAX / scored.v]
    if not whole:
        return np.zeros((2, 0), dtype=int)
    levels = np.stack([octave_levels(n, G, (whole[0], whole[-1]))[1] for G in (G_y, G_a)])
    index = np.vectorize(lambda G_d0: [*CLASSES].index(roughness_class(G_d0)), otypes=[int])
    true, estimated = index(levels)
    return estimated - true


@metrics(
    Metric("class_exact", "octaves in the true class", **PERCENT, better="high", head="class",
           help="Share of octaves from 0.25 to 2 cycles/m whose ISO 8608 class is that of the true "
           "road. Octaves that the 25 Hz low-pass cuts do not count. A class is 6 dB wide."),
    Metric("class_within_one", "octaves within one class", **PERCENT, better="high",
           head="within one",
           help="Share of octaves whose class is at most one from that of the true road."),
)  # fmt: skip
def _octave_classes(scored: ScoredEstimate) -> tuple[float, ...]:
    steps = scored.shared(_class_steps)
    return _share(steps == 0), _share(np.abs(steps) <= 1)


@metrics(
    Metric("fitted_class", "fitted class correct", **PERCENT, better="high", head="fitted",
           help="Share of wheel paths whose class, of a line with w = 2 fitted in band, is the "
           "true one."),
    Metric("G_d0_error_db", "error of Gd(n0)", unit="dB", digits=1, head="level", help="Error of "
           "the roughness level Gd(n0), fitted with w = 2 in band; a class is 6 dB wide."),
    Metric("G_d0_bias_db", "signed error of Gd(n0)", unit="dB", digits=1, better="zero",
           head="± level", help="Signed error of the roughness level Gd(n0): negative where the "
           "estimate is too smooth."),
)  # fmt: skip
def _fitted_line(scored: ScoredEstimate) -> tuple[float, ...]:
    n, (G_y, G_a, _) = scored.densities
    true, found = (np.array([_fitted_G_d0(n, G, scored.band) for G in Gs]) for Gs in (G_y, G_a))
    right = [roughness_class(a) == roughness_class(y) for a, y in zip(found, true, strict=True)]
    error = _decibels(found, true)
    return float(np.mean(right)), float(np.mean(np.abs(error))), float(np.mean(error))


@metrics(
    Metric("iri_error", "IRI error", unit="mm/m", head="IRI",
           help="Mean absolute error of the international roughness index per 100 m."),
    Metric("iri_error_relative", "relative IRI error", **PERCENT, head="IRI", help="Mean absolute "
           "error of the international roughness index, relative to the true mean."),
)  # fmt: skip
def _iri_errors(scored: ScoredEstimate) -> tuple[float, ...]:
    motion = 1e3 * np.abs(golden_car(np.stack([scored.y, scored.a]), scored.ds))  # m/m to mm/m
    count = max(1, round(scored.y.shape[-1] * scored.ds / 100.0))  # segments of about 100 m
    parts = [part.mean(axis=-1) for part in np.array_split(motion, count, axis=-1)]
    true, estimated = np.transpose(parts, (1, 2, 0))
    error = float(np.mean(np.abs(estimated - true)))
    return error, error / float(true.mean()) if true.any() else np.nan


@metrics(*(
    Metric(f"class_exact_{n:g}", f"class at {n:g} cycles/m", **PERCENT, better="high",
           head=f"at {n:g}", help="Share of wheel paths with the true ISO 8608 class in the octave "
           f"of {n:g} cycles/m.")
    for n in _OCTAVE_CENTRES
))  # fmt: skip
def _class_by_octave(scored: ScoredEstimate) -> list[float]:
    shares = [_share(steps == 0) for steps in scored.shared(_class_steps).T]
    return shares + [np.nan] * (len(_OCTAVE_CENTRES) - len(shares))


@metrics(*(
    Metric(f"error_at_{n:.3g}", f"NRMSE at {n:.3g} cycles/m",
           help=f"RMS error over RMS truth in the third octave of {n:.3g} cycles/m.")
    for n in THIRD_OCTAVES
))  # fmt: skip
def _error_by_third_octave(scored: ScoredEstimate) -> list[float]:
    n, (G_y, _, G_e) = scored.densities
    limits = THIRD_OCTAVES * 2.0 ** (-1 / 6), THIRD_OCTAVES * 2.0 ** (1 / 6)
    true, wrong = (band_means(n, G.sum(axis=0), *limits) for G in (G_y, G_e))
    ratio = np.divide(wrong, true, out=np.full_like(true, np.nan), where=true > 0)
    return np.sqrt(ratio).tolist()


def _fitted_G_d0(n: np.ndarray, G: np.ndarray, band: Band) -> float:
    """Fit Gd(n0) [m³] of one wheel path by a line with w = 2 inside `band`; 0 if it is flat."""
    n, G = smooth_psd(n, G)
    inside = (n >= band[0]) & (n <= band[1]) & (G > 0.0)
    return fit_line(n, G, w=2.0, band=band)[0] if inside.sum() >= 2 else 0.0


def _decibels(a: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return 10 log10(a / y), clipped to +-60 dB; NaN where both are 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.clip(10.0 * np.log10(a / y), -60.0, 60.0)


def _share(hits: np.ndarray) -> float:
    return float(np.mean(hits)) if hits.size else np.nan
