"""Agreement of roughness measurements, with a reference or among passes over one road.

The cross-correlation is in the way of AASHTO R 56: profiles are passed through the filter of the
IRI, and the largest cross-correlation of the filtered profiles P and Q over small lags is scaled by
the ratio of their standard deviations (Karamihas & Gillespie 2002, "Development of cross
correlation for objective comparison of profiles"):

    R = max over lags of <P(s) Q(s + lag)> / (sigma_P sigma_Q) x min(sigma_P, sigma_Q) / max(...)

It is 1 only where both the places and the sizes of roughness agree. It is a comparison in the style
of that practice, not a certification by it.
"""

from typing import NamedTuple

import numpy as np
from scipy.signal import correlate, correlation_lags

from leaderboard.metrics.api import Metric, ScoredEstimate, metric, metrics
from road_envs.records.roughness import golden_car, iri

_LAG_MAX = 1.0  # largest lag [m] of the cross-correlation


class _BlandAltman(NamedTuple):  # limits: bias ± 1.96 deviations (Bland & Altman, Lancet 327, 1986)
    bias: float
    lower: float
    upper: float


def bland_altman(x: np.ndarray, y: np.ndarray) -> _BlandAltman:
    """Return mean and limits of agreement of x - y, two measurements (N,) of the same segments."""
    difference = np.subtract(x, y, dtype=float)
    bias = float(difference.mean())
    spread = 1.96 * float(difference.std(ddof=1)) if difference.size > 1 else np.nan
    return _BlandAltman(bias, bias - spread, bias + spread)


def intraclass_correlation(x: np.ndarray) -> float:
    """Return ICC(2,1) of measurements (N, K) of N segments in K passes: absolute agreement, of
    random samples of both (Shrout & Fleiss, Psychological Bulletin 86, 1979). NaN for fewer than
    two segments or passes, or without any scatter.
    """
    x = np.asarray(x, dtype=float)
    n, k = x.shape
    if n < 2 or k < 2:
        return np.nan
    rows, columns, mean = x.mean(axis=1), x.mean(axis=0), x.mean()
    between_rows = k * np.sum((rows - mean) ** 2) / (n - 1)
    between_columns = n * np.sum((columns - mean) ** 2) / (k - 1)
    rest = np.sum((x - rows[:, None] - columns + mean) ** 2) / ((n - 1) * (k - 1))
    total = between_rows + (k - 1) * rest + k * (between_columns - rest) / n
    return float((between_rows - rest) / total) if total > 0.0 else np.nan


def repeatability(x: np.ndarray) -> float:
    """Return the standard deviation within segments of measurements (N, K) in K passes."""
    x = np.asarray(x, dtype=float)
    return float(np.sqrt(np.mean(x.var(axis=1, ddof=1)))) if x.shape[1] > 1 else np.nan


def iri_filtered_correlation(y: np.ndarray, a: np.ndarray, ds: float) -> float:
    """Return the scaled cross-correlation R of two profiles (M,) [m], R 56-style."""
    P, Q = (x - x.mean() for x in golden_car(np.stack([y, a]), ds))
    power = float(P @ P), float(Q @ Q)
    if not min(power) > 0.0:
        return np.nan
    near = np.abs(correlation_lags(P.size, Q.size)) * ds <= _LAG_MAX
    # <PQ> / (sP sQ) x min / max = <PQ> / max²
    return float(correlate(P, Q, method="fft")[near].max() / max(power))


def _segment_iri(scored: ScoredEstimate, length: float) -> np.ndarray:
    """Return true and estimated IRI [mm/m] of both wheel paths by segment, (2, N)."""
    length = min(length, (scored.y.shape[1] - 1) * scored.ds - 1.0)
    return np.array([iri(z, scored.ds, segment=length).ravel() for z in (scored.y, scored.a)])


@metric("IRI-filtered cross-correlation, R 56-style", digits=2, better="high", head="R 56-style")
def iri_cross_correlation(scored: ScoredEstimate) -> float:
    """Cross-correlation of IRI-filtered profiles, scaled by their amplitudes, R 56-style.
    Mean of both wheel paths. Inertial profilers had 0.95 on dense-graded and 0.64 on open-graded
    asphalt (Nazef & Mraz, RPUG 2013).
    """
    paths = zip(scored.y, scored.a, strict=True)
    return float(np.mean([iri_filtered_correlation(y, a, scored.ds) for y, a in paths]))


@metrics(
    Metric("iri_bias", "IRI bias", unit="mm/m", better="zero", head="IRI bias", help="Mean "
           "difference of the IRI per 100 m, estimate less truth, of both wheel paths."),
    Metric("iri_rmse", "IRI RMSE", unit="mm/m", head="IRI RMSE",
           help="RMS difference of the IRI per 100 m of both wheel paths."),
)  # fmt: skip
def _difference(scored: ScoredEstimate) -> tuple[float, ...]:
    true, found = _segment_iri(scored, 100.0)
    return bland_altman(found, true).bias, float(np.sqrt(np.mean((found - true) ** 2)))


@metrics(
    *(Metric(f"iri_{end}_limit", f"{end} limit of agreement of the IRI", unit="mm/m", better="zero",
             head=head, help=f"Bias of the IRI per 20 m {sign} 1.96 standard deviations of the "
             "differences (Bland-Altman).")
      for end, head, sign in (("lower", "IRI low", "less"), ("upper", "IRI up", "plus"))),
    Metric("iri_icc", "intraclass correlation of the IRI", better="high", head="IRI ICC",
           help="ICC(2,1) of the true and the estimated IRI per 20 m of both wheel paths."),
)  # fmt: skip
def _agreement(scored: ScoredEstimate) -> tuple[float, ...]:
    true, found = _segment_iri(scored, 20.0)  # of which a drive has several
    _, lower, upper = bland_altman(found, true)
    return lower, upper, intraclass_correlation(np.stack([true, found], axis=1))
