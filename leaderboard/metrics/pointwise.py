"""Errors at each station inside the scored band: NRMSE, correlation, lag, coherence, uncertainty.

`heights` has the definitions.
"""

import numpy as np

from leaderboard.metrics import heights
from leaderboard.metrics.api import Metric, ScoredEstimate, metric


def _error(scored: ScoredEstimate) -> heights.Sides:
    return heights.error_over_truth(*scored.in_band)


def _shift(scored: ScoredEstimate) -> heights.Correlation:
    return heights.correlation(*scored.in_band, scored.ds)


def _uncertainty(scored: ScoredEstimate) -> heights.Uncertainty:
    if scored.std is None:
        return heights.Uncertainty(np.nan, np.nan, np.nan)
    return heights.uncertainty(*scored.in_band, scored.std)


@metric("in-band NRMSE", digits=3, head="NRMSE")
def nrmse(scored: ScoredEstimate) -> float:
    """RMS of the error over RMS of the truth, both wheel paths, inside the scored band.

    The band is 0.2 to min(1.8, 22.5 Hz / speed) cycles/m, which the sensors can observe. A flat
    road has 1, an unrelated road of the same roughness 1.41.
    """
    return scored.shared(_error).pooled


@metric("in-band NRMSE, left", head="NRMSE left")
def nrmse_left(scored: ScoredEstimate) -> float:
    """In-band NRMSE of the left wheel path."""
    return scored.shared(_error).left


@metric("in-band NRMSE, right", head="NRMSE right")
def nrmse_right(scored: ScoredEstimate) -> float:
    """In-band NRMSE of the right wheel path."""
    return scored.shared(_error).right


@metric("in-band NRMSE at the best lag", digits=3, head="at lag")
def nrmse_at_lag(scored: ScoredEstimate) -> float:
    """Least in-band NRMSE of the estimate shifted by up to 0.5 m to either side.

    Where it is far below the NRMSE at fixed stations, the road is right and its place is wrong, as
    behind an odometer with an offset.
    """
    return heights.error_at_best_lag(*scored.in_band, scored.ds)


@metric("bound on the in-band NRMSE", digits=3, head="bound")
def bound_nrmse(scored: ScoredEstimate) -> float:
    """Least in-band NRMSE of a linear car without friction on a Gaussian road of this spectrum."""
    return scored.bound


@metric("bound efficiency", unit="%", factor=100.0, digits=0, better="high", head="of bound")
def bound_efficiency(scored: ScoredEstimate) -> float:
    """Mean square error of the bound over that of the estimate."""
    error = scored.shared(_error).pooled
    return (scored.bound / error) ** 2 if error > 0.0 else np.nan


attainable_nrmse = Metric(
    key="attainable_nrmse", label="attainable in-band NRMSE", digits=3, head="attainable",
    help="Error of an estimator that knows vehicle, noise and the spectrum of the road, to first "
    "order about the truth: the posterior of the nonlinear vehicle from data below 100 Hz. Where "
    "roads are rough in places only, an estimator that finds the places can be below. "
    "On request: leaderboard --attainable.",
)  # fmt: skip

attainable_efficiency = Metric(
    key="attainable_efficiency", label="efficiency", unit="%", factor=100.0, digits=0,
    better="high", head="of attainable",
    help="Mean square of the attainable error over that of the estimate.",
)  # fmt: skip


@metric("NRMSE, 0.05-3 cycles/m", head="NRMSE 0.05-3")
def nrmse_full(scored: ScoredEstimate) -> float:
    """RMS of the error over RMS of the truth from 0.05 to 3 cycles/m, at every speed."""
    return heights.nrmse(scored.y, scored.a, scored.ds, heights.FULL_BAND).pooled


@metric("correlation r", better="high", head="r")
def r(scored: ScoredEstimate) -> float:
    """Pearson's correlation of estimate and truth inside the scored band."""
    return scored.shared(_shift).r


@metric("best lag", unit="m", better="zero", head="lag")
def lag(scored: ScoredEstimate) -> float:
    """Shift within ±0.5 m at which the correlation is largest; positive if the estimate is late."""
    return scored.shared(_shift).lag


@metric("r at best lag", better="high", head="r at lag")
def r_at_lag(scored: ScoredEstimate) -> float:
    """Largest correlation over shifts within ±0.5 m."""
    return scored.shared(_shift).r_at_lag


@metric("coherence", better="high")
def coherence(scored: ScoredEstimate) -> float:
    """Mean squared coherence over the scored band, which a wrong gain does not change."""
    return heights.coherence(scored.y, scored.a, scored.ds, scored.band)


@metric("CRPS in band", unit="mm", factor=1000.0, head="CRPS")
def crps(scored: ScoredEstimate) -> float:
    """Continuous ranked probability score of estimates with a standard deviation; 0 is perfect."""
    return scored.shared(_uncertainty).crps


@metric("errors in the 50 % interval", unit="%", factor=100.0, digits=0, better="", head="in 50 %")
def coverage_50(scored: ScoredEstimate) -> float:
    """Share of errors inside the 50 % interval, for estimates with a standard deviation."""
    return scored.shared(_uncertainty).coverage_50


@metric("errors in the 90 % interval", unit="%", factor=100.0, digits=0, better="", head="in 90 %")
def coverage_90(scored: ScoredEstimate) -> float:
    """Share of errors inside the 90 % interval, for estimates with a standard deviation."""
    return scored.shared(_uncertainty).coverage_90
