"""Alignment of an estimate with the true profile of a road by cross-correlation.

The stations of a measured drive are those of its odometer or of a speed that was integrated, so
they differ from those of a levelled or profiled road by an unknown distance: that of the largest
correlation of their slopes in the scored band (`estimators.common.alignment`). Where positions
wander, the lag of each window of 20 m is followed along the road (`align_locally`).
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter1d

from estimators.common.alignment import MIN_OVERLAP, SEARCHED, is_match, lag_correlations
from road_envs.core.config import ConfigError
from road_envs.records.record import Estimate, Profile, scored_band
from road_envs.records.roughness import band_pass
from road_envs.roads import Surface

_LOCAL_WINDOW, _LOCAL_STEP = 20.0, 5.0  # length [m] of windows of a local alignment, and step
# largest lag [m] of an estimate whose positions wander, three standard deviations of the worst
# receiver (`position_noise`), and its change over the distance
_LOCAL_SEARCH, _LOCAL_STRETCH = 9.0, 0.06
_BEYOND = 0.6  # leads the search through windows beyond the ends of the truth, which do not count


class _Alignment(NamedTuple):
    """Truth and estimate, moved by `lag` [m] towards larger stations, over their overlap, with the
    `correlation` of slopes in the scored band, at this lag and where the stations had put it.
    """

    truth: Profile
    estimate: Estimate
    lag: float
    correlation: float
    correlation_before: float

    @property
    def note(self) -> str:
        """A sentence on the lag, and on what is scored."""
        was = "" if np.isnan(self.correlation_before) else f", {self.correlation_before:.2f} before"
        return (
            f"aligned with the truth by {self.lag:+.2f} m (correlation of slopes in the scored "
            f"band {self.correlation:.2f}{was}); {self.truth.s[-1]:.1f} m overlap and are scored"
        )


def align(road: Surface, estimate: Estimate, v: float, chainage: float = 0.0) -> _Alignment:
    """Align an estimate of a drive at `v` [m/s] with the `road` that was driven.

    `chainage` [m] is the station of the road at which station 0 of the estimate is assumed. Raises
    ConfigError if the profiles do not overlap, or do not match at any lag.
    """
    ds, band = estimate.ds, scored_band(v)
    first = int(np.ceil((road.start - chainage) / ds))
    size = int(np.floor((road.end - chainage) / ds)) - first + 1
    trimmed = round(1.0 / (band[0] * ds))  # of either profile, by the band-pass
    needed = int(np.ceil(MIN_OVERLAP / ds))
    if (shorter := min(size, estimate.s.size)) < needed + 2 * trimmed:
        raise ConfigError(
            f"{ds * shorter:.1f} m are too short to be aligned with the truth: at least "
            f"{MIN_OVERLAP + 2 * trimmed * ds:.0f} m are needed"
        )
    grid = first + np.arange(size)
    slopes = np.gradient(band_pass(road.height(chainage + ds * grid), ds, band), axis=1)
    found = np.gradient(band_pass(estimate.z, ds, band), axis=1)
    # a lag of k: station i of the estimate is station i + k of the truth's grid
    start = first + (size - slopes.shape[1]) // 2 - (estimate.s.size - found.shape[1]) // 2
    lags, r = lag_correlations(slopes, found, needed, start)
    near = np.abs(lags) * ds <= SEARCHED
    if not near.any():
        raise ConfigError(
            f"the drive covers stations {chainage:.1f} to {chainage + estimate.s[-1]:.1f} m and "
            f"the truth {road.start:.1f} to {road.end:.1f} m: they do not overlap within "
            f"{SEARCHED:g} m; give the chainage of the first sample (--offset)"
        )
    best = int(np.argmax(np.where(near, r, -2.0)))
    lag, correlation = int(lags[best]), float(r[best])
    before = float(r[lags == 0][0]) if (lags == 0).any() else np.nan
    begin, end = max(0, first - lag), min(estimate.s.size, first + size - lag)
    if not is_match(correlation, ds * (end - begin), band):
        raise ConfigError(
            f"the estimate matches the truth at no lag within {SEARCHED:g} m: its best "
            f"correlation is {correlation:.2f}, at {ds * lag:+.2f} m; check the road, the vehicle "
            "and the chainage of the first sample (--offset)"
        )
    k = np.arange(end - begin)
    fields = {name: getattr(estimate, name) for name in ("z", "z_std", "unsure")}
    kept: Any = {name: x[..., begin:end] for name, x in fields.items() if x is not None}
    part = dataclasses.replace(estimate, s=ds * k, draws=None, **kept)
    truth = Profile(ds * k, road.height(chainage + ds * (begin + lag + k)))
    return _Alignment(truth, part, ds * lag, correlation, before)


def align_locally(
    y: np.ndarray, a: np.ndarray, std: np.ndarray | None, ds: float, v: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return heights `y` of the truth, and `a` of an estimate with their deviation `std`, if any,
    moved to where their slopes match those of the truth, window by window; as they are if none do.
    All are (2, M) [m], `ds` [m] apart, of a drive at `v` [m/s]; what is returned (2, K) is at the
    stations of the truth that the estimate covers.
    """
    s = ds * np.arange(y.shape[1])
    mapped, moved = s, a
    for _ in range(3):  # from the second time on with windows that are hardly stretched
        centres, lags, correlation = _local_lags(y, moved, ds, v)
        if not correlation >= 0.5:  # that of unrelated roads, whose lags are free too, is 0.2
            return y, a, std
        mapped = mapped + np.interp(mapped, centres, lags)
        moved = CubicSpline(mapped, a, axis=1)(np.clip(s, mapped[0], mapped[-1]))
    inside = (s >= mapped[0]) & (s <= mapped[-1])
    if std is not None:
        std = np.array([np.interp(s[inside], mapped, path) for path in std])
    return y[:, inside], moved[:, inside], std


def _local_lags(
    y: np.ndarray, a: np.ndarray, ds: float, v: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the middles (W,) [m] of windows of an estimate `a` (2, M) [m], their lags (W,) [m]
    towards larger stations against `y` (2, M), and the mean correlation of slopes there.
    """
    truth, found = np.gradient(band_pass(np.stack([y, a]), ds, scored_band(v)), axis=2)
    trim, size = (y.shape[1] - truth.shape[1]) // 2, round(_LOCAL_WINDOW / ds)
    begins = np.arange(0, found.shape[1] - size + 1, round(_LOCAL_STEP / ds))
    if not begins.size:
        return np.zeros(0), np.zeros(0), 0.0
    scores = _window_correlations(truth, found, begins, size, round(_LOCAL_SEARCH / ds))
    path = _likeliest_path(scores, round(_LOCAL_STRETCH * _LOCAL_STEP / ds))
    # the vertex of a parabola through three lags
    inner = np.clip(path, 1, scores.shape[1] - 2)
    before, at, after = (scores[np.arange(begins.size), inner + j] for j in (-1, 0, 1))
    curvature = np.minimum(before - 2.0 * at + after, -1e-12)
    vertex = np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)
    centres = ds * (trim + begins + 0.5 * (size - 1))
    lags = ds * (inner - scores.shape[1] // 2 + vertex)
    seen = ~(np.stack([before, at, after]) == _BEYOND).any(axis=0)
    correlation, centres, lags = float(np.mean(seen * at)), centres[seen], lags[seen]
    if centres.size > 2:  # beyond the middles of the outer windows the lag goes on as before
        ends = np.array([0.0, ds * y.shape[1]])
        slopes = (lags[[2, -1]] - lags[[0, -3]]) / (centres[[2, -1]] - centres[[0, -3]])
        outer = lags[[0, -1]] + slopes * (ends - centres[[0, -1]])
        centres, lags = np.insert(ends, 1, centres), np.insert(outer, 1, lags)
    return centres, lags, correlation


def _window_correlations(
    truth: np.ndarray, found: np.ndarray, begins: np.ndarray, size: int, reach: int
) -> np.ndarray:
    """Return the correlations (W, 2 `reach` + 1) of slopes (2, K) in windows of `size` stations
    from `begins` (W,) on, at lags of -`reach` to `reach`; _BEYOND where the truth ends.
    """
    scores = np.full((begins.size, 2 * reach + 1), _BEYOND)
    for row, begin in zip(scores, begins.tolist(), strict=True):
        low, window = max(begin - reach, 0), found[:, begin : begin + size]
        k, r = lag_correlations(truth[:, low : begin + size + reach], window, size, low - begin)
        row[k + reach] = r
    return scores


def _likeliest_path(scores: np.ndarray, most: int) -> np.ndarray:
    """Return the columns (W,) of `scores` (W, L) that change by `most` at most from row to row with
    the largest sum: dynamic programming (Sakoe & Chiba, IEEE Trans. ASSP 26, 1978, 43-49).
    """
    total = scores.copy()
    for w in range(1, len(scores)):
        total[w] += maximum_filter1d(total[w - 1], 2 * most + 1, mode="nearest")
    path = np.zeros(len(scores), dtype=int)
    path[-1] = total[-1].argmax()
    for w in range(len(scores) - 2, -1, -1):
        low = max(path[w + 1] - most, 0)
        path[w] = low + total[w, low : path[w + 1] + most + 1].argmax()
    return path
