"""The paper's error measure, equation 12 of Ngwangwa et al., which compares two levels.

eps = (rms(a) - rms(y)) / rms(y)       estimate a, truth y, whole profiles, no band
"""

from leaderboard.metrics import heights
from leaderboard.metrics.api import ScoredEstimate, metric

EQ_12_RAW = "level_error_raw"
"""Key of the paper's equation 12 as printed: raw heights."""

STATE_LIMITS = (0.15, 0.25)
"""Equation 12 up to which a training is near-optimal, and sub-optimal (Appendix A of the paper)."""


def _level(scored: ScoredEstimate) -> heights.Sides:
    return heights.level_error(heights.remove_mean(scored.y), heights.remove_mean(scored.a))


@metric("level error, paper eq. 12 as printed", unit="%", factor=100.0, digits=1, head="eq. 12")
def level_error_raw(scored: ScoredEstimate) -> float:
    """Equation 12 of the paper as printed, of raw heights: it mostly measures the arbitrary datum.

    It compares two RMS levels and nothing else: the truth with its sign flipped scores 0 %.
    """
    return abs(heights.level_error(scored.y, scored.a).pooled)


@metric("level error about the mean", unit="%", factor=100.0, digits=1, head="eq. 12, mean")
def level_error(scored: ScoredEstimate) -> float:
    """Equation 12 of the paper, of heights about their mean: the error of the RMS level alone.

    The longest waves dominate it, so an estimator that cuts them off, such as kalman_lag and
    kalman_rts, has a large one at a small in-band error, and an unrelated road of the same class a
    small one.
    """
    return abs(scored.shared(_level).pooled)


@metric("level error about the mean, left", unit="%", factor=100.0, digits=1, head="left")
def level_error_left(scored: ScoredEstimate) -> float:
    """Level error about the mean of the left wheel path."""
    return abs(scored.shared(_level).left)


@metric("level error about the mean, right", unit="%", factor=100.0, digits=1, head="right")
def level_error_right(scored: ScoredEstimate) -> float:
    """Level error about the mean of the right wheel path."""
    return abs(scored.shared(_level).right)


@metric(
    "signed level error about the mean",
    unit="%", factor=100.0, digits=1, better="zero", head="signed level",
)  # fmt: skip
def level_bias(scored: ScoredEstimate) -> float:
    """Level error about the mean with its sign: negative where the estimate is too smooth."""
    return scored.shared(_level).pooled
