"""Roughness: spectral densities, ISO 8608 classes and IRI of an estimate against the true ones.

`roughness` has the definitions. The reference is the road as realised, not the class that it was
drawn from.
"""

from collections.abc import Callable

import numpy as np

from leaderboard.metrics import roughness
from leaderboard.metrics.api import Metric, ScoredEstimate, metric


def _distance(scored: ScoredEstimate) -> tuple[float, float]:
    n, (G_y, G_a, _) = scored.densities
    return roughness.dsd_distance(n, G_y, G_a, scored.band)


def _class_steps(scored: ScoredEstimate) -> np.ndarray:
    n, (G_y, G_a, _) = scored.densities
    return roughness.class_differences(n, G_y, G_a, scored.v)


def _fitted(scored: ScoredEstimate) -> tuple[float, float, float]:
    n, (G_y, G_a, _) = scored.densities
    return roughness.fitted_class(n, G_y, G_a, scored.band)


def _iri(scored: ScoredEstimate) -> tuple[float, float]:
    return roughness.iri_error(scored.y, scored.a, scored.ds)


def _third_octaves(scored: ScoredEstimate) -> list[float]:
    n, (G_y, _, G_e) = scored.densities
    return roughness.third_octave_errors(n, G_y, G_e)


def _share(hits: np.ndarray) -> float:
    return float(np.mean(hits)) if hits.size else np.nan


@metric("DSD distance", unit="dB", digits=1, head="DSD")
def dsd_distance_db(scored: ScoredEstimate) -> float:
    """RMS ratio of the estimated to the true displacement density over third octaves in band."""
    return scored.shared(_distance)[0]


@metric("DSD bias", unit="dB", digits=1, better="zero", head="bias")
def dsd_bias_db(scored: ScoredEstimate) -> float:
    """Mean ratio of the estimated to the true density over third octaves in band."""
    return scored.shared(_distance)[1]


@metric("octaves in the true class", unit="%", factor=100.0, digits=0, better="high", head="class")
def class_exact(scored: ScoredEstimate) -> float:
    """Share of octaves from 0.25 to 2 cycles/m whose ISO 8608 class is that of the true road.

    Octaves that the 25 Hz low-pass cuts do not count. A class is 6 dB wide.
    """
    return _share(scored.shared(_class_steps) == 0)


@metric(
    "octaves within one class",
    unit="%", factor=100.0, digits=0, better="high", head="within one",
)  # fmt: skip
def class_within_one(scored: ScoredEstimate) -> float:
    """Share of octaves whose class is at most one from that of the true road."""
    return _share(np.abs(scored.shared(_class_steps)) <= 1)


@metric("fitted class correct", unit="%", factor=100.0, digits=0, better="high", head="fitted")
def fitted_class(scored: ScoredEstimate) -> float:
    """Share of wheel paths whose class, of a line with w = 2 fitted in band, is the true one."""
    return scored.shared(_fitted)[0]


@metric("error of Gd(n0)", unit="dB", digits=1, head="level")
def G_d0_error_db(scored: ScoredEstimate) -> float:
    """Error of the roughness level Gd(n0), fitted with w = 2 in band; a class is 6 dB wide."""
    return scored.shared(_fitted)[1]


@metric("signed error of Gd(n0)", unit="dB", digits=1, better="zero", head="± level")
def G_d0_bias_db(scored: ScoredEstimate) -> float:
    """Signed error of the roughness level Gd(n0): negative where the estimate is too smooth."""
    return scored.shared(_fitted)[2]


@metric("IRI error", unit="mm/m", head="IRI")
def iri_error(scored: ScoredEstimate) -> float:
    """Mean absolute error of the international roughness index per 100 m."""
    return scored.shared(_iri)[0]


@metric("relative IRI error", unit="%", factor=100.0, digits=0, head="IRI")
def iri_error_relative(scored: ScoredEstimate) -> float:
    """Mean absolute error of the international roughness index, relative to the true mean."""
    return scored.shared(_iri)[1]


def _class_in_octave(k: int) -> Callable[[ScoredEstimate], float]:
    def share(scored: ScoredEstimate) -> float:
        steps = scored.shared(_class_steps)
        return _share(steps[:, k] == 0) if k < steps.shape[1] else np.nan

    return share


def _error_in_third_octave(k: int) -> Callable[[ScoredEstimate], float]:
    return lambda scored: scored.shared(_third_octaves)[k]


CLASS_BY_OCTAVE = tuple(
    Metric(
        key=f"class_exact_{n:g}",
        label=f"class at {n:g} cycles/m",
        head=f"at {n:g}",
        unit="%",
        factor=100.0,
        digits=0,
        better="high",
        help=f"Share of wheel paths with the true ISO 8608 class in the octave of {n:g} cycles/m.",
        compute=_class_in_octave(k),
    )
    for k, n in enumerate(roughness.OCTAVE_CENTRES)
)
ERROR_BY_THIRD_OCTAVE = tuple(
    Metric(
        key=f"error_at_{n:.3g}",
        label=f"NRMSE at {n:.3g} cycles/m",
        help=f"RMS error over RMS truth in the third octave of {n:.3g} cycles/m.",
        compute=_error_in_third_octave(k),
    )
    for k, n in enumerate(roughness.THIRD_OCTAVES)
)
