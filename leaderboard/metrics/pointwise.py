"""Errors at each station, as `heights` defines them: NRMSE, correlation, coherence, uncertainty."""

import numpy as np

from leaderboard.metrics import heights
from leaderboard.metrics.api import PERCENT, Metric, ScoredEstimate, metric, metrics


@metrics(
    Metric("nrmse", "in-band NRMSE", digits=3, head="NRMSE",
           help="RMS of the error over RMS of the truth, both wheel paths, inside the scored "
           "band. The band is 0.2 to min(1.8, 22.5 Hz / speed) cycles/m, which the sensors can "
           "observe. A flat road has 1, an unrelated road of the same roughness 1.41."),
    *(Metric(f"nrmse_{side}", f"in-band NRMSE, {side}", head=f"NRMSE {side}",
             help=f"In-band NRMSE of the {side} wheel path.") for side in ("left", "right")),
    Metric("nrmse_at_lag", "in-band NRMSE at the best lag", digits=3, head="at lag",
           help="Least in-band NRMSE of the estimate shifted by up to 0.5 m to either side. "
           "Where it is far below the NRMSE at fixed stations, the road is right and its place "
           "is wrong, as behind an odometer with an offset."),
    Metric("bound_nrmse", "bound on the in-band NRMSE", digits=3, head="bound",
           help="Least in-band NRMSE of a linear car without friction on a Gaussian road of this "
           "spectrum."),
    Metric("bound_efficiency", "bound efficiency", **PERCENT, better="high", head="of bound",
           help="Mean square error of the bound over that of the estimate."),
)  # fmt: skip
def _errors(scored: ScoredEstimate) -> tuple[float, ...]:
    left, right, both = heights.error_over_truth(*scored.in_band)
    at_lag = heights.error_at_best_lag(*scored.in_band, scored.ds)
    efficiency = (scored.bound / both) ** 2 if both > 0.0 else np.nan
    return both, left, right, at_lag, scored.bound, efficiency


@metrics(
    Metric("nrmse_aligned", "in-band NRMSE after local alignment", digits=3, head="aligned",
           help="In-band NRMSE of the estimate whose stations follow the truth, by the lag of "
           "largest correlation in windows of 20 m, over the stations that it then covers. Only on "
           "tasks whose positions wander; an estimate that matches nowhere is scored as it is."),
    Metric("coverage_90_aligned", "errors in the 90 % interval after local alignment", **PERCENT,
           better="", head="aligned in 90 %",
           help="Share of errors inside the 90 % interval after local alignment."),
)  # fmt: skip
def _aligned_errors(scored: ScoredEstimate) -> tuple[float, ...]:
    if not scored.wandering:
        return (np.nan,) * 2
    y, a, std = scored.aligned
    coverage = np.nan if std is None else heights.uncertainty(y, a, std).coverage_90
    return heights.error_over_truth(y, a).pooled, coverage


_ATTAINABLE = (  # of boards alone: `report.attainable`
    Metric("attainable_nrmse", "attainable in-band NRMSE", digits=3, head="attainable",
           help="Error of an estimator that knows vehicle, noise and the spectrum of the road, "
           "to first order about the truth: the posterior of the nonlinear vehicle from data "
           "below 100 Hz. Where roads are rough in places only, an estimator that finds the "
           "places can be below. On request: leaderboard --attainable."),
    Metric("attainable_efficiency", "efficiency", **PERCENT, better="high", head="of attainable",
           help="Mean square of the attainable error over that of the estimate."),
)  # fmt: skip


@metric("NRMSE, 0.05-3 cycles/m", head="NRMSE 0.05-3")
def nrmse_full(scored: ScoredEstimate) -> float:
    """RMS of the error over RMS of the truth from 0.05 to 3 cycles/m, at every speed."""
    return heights.nrmse(scored.y, scored.a, scored.ds, (0.05, 3.0)).pooled


@metrics(
    Metric("r", "correlation r", better="high", head="r",
           help="Pearson's correlation of estimate and truth inside the scored band."),
    Metric("lag", "best lag", unit="m", better="zero", head="lag", help="Shift within ±0.5 m at "
           "which the correlation is largest; positive if the estimate is late."),
    Metric("r_at_lag", "r at best lag", better="high", head="r at lag",
           help="Largest correlation over shifts within ±0.5 m."),
)  # fmt: skip
def _correlation(scored: ScoredEstimate) -> heights.Correlation:
    return heights.correlation(*scored.in_band, scored.ds)


@metric("coherence", better="high")
def coherence(scored: ScoredEstimate) -> float:
    """Mean squared coherence over the scored band, which a wrong gain does not change."""
    return heights.coherence(scored.y, scored.a, scored.ds, scored.band)


@metrics(
    Metric("crps", "CRPS in band", unit="mm", factor=1000.0, head="CRPS", help="Continuous ranked "
           "probability score of estimates with a standard deviation; 0 is perfect."),
    *(Metric(f"coverage_{p}", f"errors in the {p} % interval", **PERCENT, better="",
             head=f"in {p} %", help=f"Share of errors inside the {p} % interval, for estimates "
             "with a standard deviation.") for p in (50, 90)),
)  # fmt: skip
def _uncertainty(scored: ScoredEstimate) -> tuple[float, ...]:
    return (np.nan,) * 3 if scored.std is None else heights.uncertainty(*scored.in_band, scored.std)
