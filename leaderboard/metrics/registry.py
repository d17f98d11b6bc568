"""The table of all scores, the format of each, and the function that computes them."""

from typing import Literal, NamedTuple

import numpy as np

from leaderboard.metrics import heights, roughness
from leaderboard.metrics.obstacles import obstacle_scores
from road_envs.data.record import Estimate, Profile

UNDEFINED = "–"
"""Text of a score that is not defined."""

HEIGHT_LIMIT = 1e6
"""Estimated heights are clipped to +- this [m], so that an absurd estimate still has a score."""

Better = Literal["low", "high", "zero", ""]


class Score(NamedTuple):
    """Format of a score: its value times `factor`, in `unit`, with `digits` decimals."""

    label: str
    unit: str
    factor: float
    digits: int
    better: Better

    def format_value(self, value: float) -> str:
        """Return the value as text; a dash if it is not finite."""
        if not np.isfinite(value):
            return UNDEFINED
        rounded = round(self.factor * value, self.digits) + 0.0  # no minus before a zero
        return f"{rounded:{'+' if self.better == 'zero' else ''}.{self.digits}f}"


EQ_12_RAW = "level_error_raw"
"""Score key of the paper's equation 12 as printed: raw heights."""

STATE_LIMITS = (0.15, 0.25)
"""Equation 12 up to which a training is near-optimal, and sub-optimal (Appendix A of the paper)."""

SCORES = {
    "nrmse": Score("in-band NRMSE", "", 1.0, 3, "low"),
    "nrmse_left": Score("in-band NRMSE, left", "", 1.0, 2, "low"),
    "nrmse_right": Score("in-band NRMSE, right", "", 1.0, 2, "low"),
    "bound_nrmse": Score("bound on the in-band NRMSE", "", 1.0, 3, "low"),
    "bound_efficiency": Score("bound efficiency", "%", 100.0, 0, "high"),
    "nrmse_full": Score("NRMSE, 0.05-3 cycles/m", "", 1.0, 2, "low"),
    "r": Score("correlation r", "", 1.0, 2, "high"),
    "lag": Score("best lag", "m", 1.0, 2, "zero"),
    "r_at_lag": Score("r at best lag", "", 1.0, 2, "high"),
    "coherence": Score("coherence", "", 1.0, 2, "high"),
    EQ_12_RAW: Score("level error, paper eq. 12 as printed", "%", 100.0, 1, "low"),
    "level_error": Score("level error about the mean", "%", 100.0, 1, "low"),
    "level_error_left": Score("level error about the mean, left", "%", 100.0, 1, "low"),
    "level_error_right": Score("level error about the mean, right", "%", 100.0, 1, "low"),
    "level_bias": Score("signed level error about the mean", "%", 100.0, 1, "zero"),
    "dsd_distance_db": Score("DSD distance", "dB", 1.0, 1, "low"),
    "dsd_bias_db": Score("DSD bias", "dB", 1.0, 1, "zero"),
    "class_exact": Score("octaves in the true class", "%", 100.0, 0, "high"),
    "class_within_one": Score("octaves within one class", "%", 100.0, 0, "high"),
    "fitted_class": Score("fitted class correct", "%", 100.0, 0, "high"),
    "G_d0_error_db": Score("error of Gd(n0)", "dB", 1.0, 1, "low"),
    "G_d0_bias_db": Score("signed error of Gd(n0)", "dB", 1.0, 1, "zero"),
    "iri_error": Score("IRI error", "mm/m", 1.0, 2, "low"),
    "iri_error_relative": Score("IRI error", "%", 100.0, 0, "low"),
    "bump_precision": Score("bump precision", "%", 100.0, 0, "high"),
    "bump_recall": Score("bump recall", "%", 100.0, 0, "high"),
    "bump_f1": Score("bump F1", "", 1.0, 2, "high"),
    "bump_location_error": Score("bump location error", "m", 1.0, 2, "low"),
    "bump_height_error": Score("bump height error", "mm", 1000.0, 0, "low"),
    "bump_height_error_relative": Score("bump height error", "%", 100.0, 0, "low"),
    "bump_ghosts": Score("bumps on the wrong side", "", 1.0, 1, "low"),
    "crps": Score("CRPS in band", "mm", 1000.0, 2, "low"),
    "coverage_50": Score("errors in the 50 % interval", "%", 100.0, 0, ""),
    "coverage_90": Score("errors in the 90 % interval", "%", 100.0, 0, ""),
    **{
        f"class_exact_{n:g}": Score(f"class at {n:g} cycles/m", "%", 100.0, 0, "high")
        for n in roughness.OCTAVE_CENTRES
    },
    **{
        f"error_at_{n:.3g}": Score(f"NRMSE at {n:.3g} cycles/m", "", 1.0, 2, "low")
        for n in roughness.THIRD_OCTAVES
    },
}


PRINTED_SCORES = (
    "nrmse", "nrmse_left", "nrmse_right", "r", "coherence", "level_error", "level_error_raw",
    "class_exact", "fitted_class", "dsd_distance_db", "iri_error", "bump_recall",
    "bump_precision", "coverage_50", "coverage_90",
)  # fmt: skip
"""Scores that are printed of one estimate; there are three times as many."""


def compute_scores(
    truth: Profile, estimate: Estimate, v: float, bumps: bool, bound: float | None = None
) -> dict[str, float]:
    """Return all scores of an `estimate` of a drive at `v` [m/s], by their keys in SCORES.

    Obstacle scores are included if `bumps` is set and the truth has obstacles, uncertainty scores
    if the estimate has a standard deviation. With `bound`, the least NRMSE of the drive, the
    efficiency is the ratio of the mean square errors of the bound and of the estimate.

    Equation 12 appears twice: `level_error_raw` of raw heights, as printed, which mostly measures
    the arbitrary datum, and `level_error` of heights about their mean. Scores that are not defined,
    such as an error relative to a flat truth, are NaN.
    """
    y, a, ds = truth.z, np.clip(estimate.z, -HEIGHT_LIMIT, HEIGHT_LIMIT), truth.ds
    inside = heights.band_pass(np.stack([y, a]), ds, heights.scored_band(v))
    result = _profile_scores(y, a, inside, ds, v) | roughness.roughness_scores(y, a, ds, v)
    if bumps and (obstacle := obstacle_scores(y, a, ds)) is not None:
        result |= {f"bump_{name}": float(value) for name, value in obstacle._asdict().items()}
    if estimate.z_std is not None:
        sigma = np.minimum(estimate.z_std, HEIGHT_LIMIT)
        result |= heights.uncertainty(inside[0], inside[1], sigma)._asdict()
    if bound is not None:
        nrmse = result["nrmse"]
        efficiency = (bound / nrmse) ** 2 if nrmse > 0.0 else np.nan
        result |= {"bound_nrmse": bound, "bound_efficiency": efficiency}
    return result


def _profile_scores(
    y: np.ndarray, a: np.ndarray, inside: np.ndarray, ds: float, v: float
) -> dict[str, float]:
    """Return the scores of heights; `inside` (2, 2, K) [m]: truth and estimate in the band."""
    y_inside, a_inside = inside
    error = heights.error_over_truth(y_inside, a_inside)
    level = heights.level_error(heights.remove_mean(y), heights.remove_mean(a))
    correlation = heights.correlation(y_inside, a_inside, ds)
    return {
        "nrmse": error.pooled,
        "nrmse_left": error.left,
        "nrmse_right": error.right,
        "nrmse_full": heights.nrmse(y, a, ds, heights.FULL_BAND).pooled,
        "r": correlation.r,
        "lag": correlation.lag,
        "r_at_lag": correlation.r_at_lag,
        "coherence": heights.coherence(y, a, ds, heights.scored_band(v)),
        "level_error": abs(level.pooled),
        "level_error_left": abs(level.left),
        "level_error_right": abs(level.right),
        "level_bias": level.pooled,
        "level_error_raw": abs(heights.level_error(y, a).pooled),
    }
