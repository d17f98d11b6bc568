"""The paper's error measure, equation 12 of Ngwangwa et al. (`heights`), which compares levels."""

from leaderboard.metrics import heights
from leaderboard.metrics.api import PERCENT, Metric, ScoredEstimate, metrics

EQ_12_RAW = "level_error_raw"  # key of the paper's equation 12 as printed: raw heights
STATE_LIMITS = (0.15, 0.25)  # eq. 12 of a near-optimal and a sub-optimal training (Appendix A)
_FORM = PERCENT | {"digits": 1}


@metrics(
    Metric(EQ_12_RAW, "level error, paper eq. 12 as printed", **_FORM, head="eq. 12",
           help="Equation 12 of the paper as printed, of raw heights: it mostly measures the "
           "arbitrary datum. It compares two RMS levels and nothing else: the truth with its sign "
           "flipped scores 0 %."),
    Metric("level_error", "level error about the mean", **_FORM, head="eq. 12, mean",
           help="Equation 12 of the paper, of heights about their mean: the error of the RMS level "
           "alone. The longest waves dominate it, so an estimator that cuts them off, such as "
           "kalman_lag and kalman_rts, has a large one at a small in-band error, and an unrelated "
           "road of the same class a small one."),
    *(Metric(f"level_error_{side}", f"level error about the mean, {side}", **_FORM, head=side,
             help=f"Level error about the mean of the {side} wheel path.")
      for side in ("left", "right")),
    Metric("level_bias", "signed level error about the mean", **_FORM, better="zero",
           head="signed level", help="Level error about the mean with its sign: negative where the "
           "estimate is too smooth."),
)  # fmt: skip
def _levels(scored: ScoredEstimate) -> tuple[float, ...]:
    raw = heights.level_error(scored.y, scored.a).pooled
    y, a = heights.remove_mean(scored.y), heights.remove_mean(scored.a)
    left, right, both = heights.level_error(y, a)
    return abs(raw), abs(both), abs(left), abs(right), both
