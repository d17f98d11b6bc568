"""The scores of one estimate, and how each is printed: the judge's table of contents."""

from typing import Literal, NamedTuple

import numpy as np

from leaderboard.metrics import heights, roughness
from leaderboard.metrics.obstacles import obstacle_scores
from road_envs.data.record import Estimate, Profile

UNDEFINED = "–"
"""Stands for a score that is not defined."""

HEIGHT_LIMIT = 1e6
"""Heights beyond this [m] count as this much."""

Better = Literal["low", "high", "zero", ""]


class Score(NamedTuple):
    """How a score is printed: its value times `factor`, in `unit`, with `digits` decimals."""

    label: str
    unit: str
    factor: float
    digits: int
    better: Better

    def format_value(self, value: float) -> str:
        """The value as printed; a dash for one that is not defined."""
        if not np.isfinite(value):
            return UNDEFINED
        rounded = round(self.factor * value, self.digits) + 0.0  # no minus before a zero
        return f"{rounded:{'+' if self.better == 'zero' else ''}.{self.digits}f}"


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
    "level_error_raw": Score("level error, paper eq. 12 as printed", "%", 100.0, 1, "low"),
    "level_error": Score("level error about the mean", "%", 100.0, 1, "low"),
    "level_error_left": Score("level error about the mean, left", "%", 100.0, 1, "low"),
    "level_error_right": Score("level error about the mean, right", "%", 100.0, 1, "low"),
    "level_bias": Score("level error about the mean with its sign", "%", 100.0, 1, "zero"),
    "dsd_distance_db": Score("DSD distance", "dB", 1.0, 1, "low"),
    "dsd_bias_db": Score("DSD bias", "dB", 1.0, 1, "zero"),
    "class_exact": Score("octaves in the true class", "%", 100.0, 0, "high"),
    "class_within_one": Score("octaves within one class", "%", 100.0, 0, "high"),
    "fitted_class": Score("fitted class right", "%", 100.0, 0, "high"),
    "G_d0_error_db": Score("error of Gd(n0)", "dB", 1.0, 1, "low"),
    "G_d0_bias_db": Score("error of Gd(n0) with its sign", "dB", 1.0, 1, "zero"),
    "iri_error": Score("IRI error", "mm/m", 1.0, 2, "low"),
    "iri_error_relative": Score("IRI error", "%", 100.0, 0, "low"),
    "bump_precision": Score("bump precision", "%", 100.0, 0, "high"),
    "bump_recall": Score("bump recall", "%", 100.0, 0, "high"),
    "bump_f1": Score("bump F1", "", 1.0, 2, "high"),
    "bump_location_error": Score("bump location error", "m", 1.0, 2, "low"),
    "bump_height_error": Score("bump height error", "mm", 1000.0, 0, "low"),
    "bump_height_error_relative": Score("bump height error", "%", 100.0, 0, "low"),
    "bump_ghosts": Score("ghost bumps", "", 1.0, 1, "low"),
    "crps": Score("CRPS in band", "mm", 1000.0, 2, "low"),
    "coverage_50": Score("inside the 50 % interval", "%", 100.0, 0, ""),
    "coverage_90": Score("inside the 90 % interval", "%", 100.0, 0, ""),
    **{
        f"class_exact_{n:g}": Score(f"class at {n:g} cycles/m", "%", 100.0, 0, "high")
        for n in roughness.OCTAVE_CENTRES
    },
    **{
        f"error_at_{n:.3g}": Score(f"NRMSE at {n:.3g} cycles/m", "", 1.0, 2, "low")
        for n in roughness.THIRD_OCTAVES
    },
}


def compute_scores(
    truth: Profile, estimate: Estimate, v: float, bumps: bool, bound: float | None = None
) -> dict[str, float]:
    """All scores of an estimate of a drive at `v` [m/s]; those of obstacles where `bumps` says so
    and the truth has some, those of uncertainty where the estimate has a standard deviation.

    `bound` is the least NRMSE that the drive allows: its efficiency is the mean square error of the
    bound over that of the estimate. Heights beyond 1000 km count as that: an absurd estimate has an
    absurd score, not none.

    Equation 12 is told twice. `level_error_raw` is as printed, of raw heights: a surface starts at
    height 0 by convention, and a level that counts from there measures mostly the convention.
    `level_error` is of heights about their mean.
    A score that is not defined, such as the error relative to a flat truth, is NaN.
    """
    y, a, ds = truth.z, np.clip(estimate.z, -HEIGHT_LIMIT, HEIGHT_LIMIT), truth.ds
    inside = heights.band_pass(np.stack([y, a]), ds, heights.scored_band(v))
    result = _profile_scores(y, a, inside, ds, v) | roughness.roughness_scores(y, a, ds, v)
    if bumps and (found := obstacle_scores(y, a, ds)) is not None:
        result |= {f"bump_{name}": float(value) for name, value in found._asdict().items()}
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
    """Scores of heights; `inside` (2, 2, K) [m] is truth and estimate in the scored band."""
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
