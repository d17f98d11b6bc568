"""Alignment of two profiles of one road, whose stations come from different odometers.

The slopes of roads are nearly white, so that unrelated ones seldom have a large correlation and the
lag of equal ones is sharp. The correlation coefficient of the band-passed slopes, of both wheel
paths together, is searched over lags, and over scales of the odometer; then a piecewise linear map
of the stations follows the lag of each window along the road.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from road_envs.records.roughness import Band, band_pass

SEARCHED = 50.0  # largest lag [m] that is searched, to either side
MIN_OVERLAP = 20.0  # shortest overlap [m] of two profiles: four of the longest scored waves
_MIN_CORRELATION = 0.3  # correlation below which two profiles do not match, at any length
# Largest correlation of unrelated profiles over thousands of lags, times the square root of their
# number of independent values
_CHANCE = 5.0
_MAX_STRETCH = 0.015  # largest relative difference of two odometers
_MISPLACEMENT = 0.1  # largest distance [m] of equal stations, at the overlap's ends, of two scales
_SEARCH_SPACING = 0.1  # [m] of the profiles in the search, a fifth of the shortest scored wave
_WINDOW = 20.0  # length [m] of the windows in which the lag is refined, one every half window
_REFINED = 0.4  # largest lag [m] of a window against the one before it, but for the uniform scale
_SEARCH_LENGTH = 300.0  # length [m] from the beginning on which lag and scale are searched
_MIN_WINDOW_CORRELATION = 0.5  # correlation of a window below which its lag is not used
_Slopes = tuple[np.ndarray, np.ndarray]  # stations (K,) [m] and slopes (2, K) of the wheel paths


@dataclass(frozen=True, eq=False)
class StationMap:
    """Piecewise linear map of stations to those of the reference.

    `stations` (K,) [m], increasing, are mapped to `reference` (K,) [m]; beyond the ends the scale
    is that of the nearest piece. `correlation` of the slopes in the band, at one lag and one scale.
    """

    stations: np.ndarray
    reference: np.ndarray
    correlation: float = 1.0

    @property
    def lag(self) -> float:
        """Mean shift [m] towards larger stations."""
        return float(np.mean(self.reference - self.stations))

    @property
    def stretch(self) -> float:
        """Relative excess of a distance of the reference, on the whole."""
        return float(np.ptp(self.reference) / np.ptp(self.stations) - 1.0)

    def apply(self, s: np.ndarray) -> np.ndarray:
        """Return the reference stations (N,) [m] of the stations `s` (N,) [m]."""
        piece = self._piece(s)
        return self.reference[piece] + self._slopes[piece] * (s - self.stations[piece])

    def scale(self, s: np.ndarray) -> np.ndarray:
        """Return the derivative (N,) of the map at the stations `s` (N,) [m]."""
        return self._slopes[self._piece(s)]

    def inverse(self) -> "StationMap":
        """Return the map from the reference to these stations."""
        return StationMap(self.reference, self.stations, self.correlation)

    @property
    def _slopes(self) -> np.ndarray:
        return np.diff(self.reference) / np.diff(self.stations)

    def _piece(self, s: np.ndarray) -> np.ndarray:
        found = np.searchsorted(self.stations, s, side="right") - 1
        return np.clip(found, 0, self.stations.size - 2)


def identity_map(length: float) -> StationMap:
    """Return the map of a profile of `length` [m] to itself."""
    ends = np.array([0.0, length])
    return StationMap(ends, ends)


def is_match(correlation: float, overlap: float, band: Band) -> bool:
    """Return whether a correlation over an `overlap` [m] is larger than by chance."""
    independent = 4.0 * (band[1] - band[0]) * overlap
    return correlation >= max(_MIN_CORRELATION, _CHANCE / np.sqrt(independent))


def map_stations(
    reference: np.ndarray, other: np.ndarray, ds: float, band: Band
) -> tuple[StationMap, bool]:
    """Map stations of the profile `other` (2, M) [m] to those of `reference` (2, N) [m].

    Both begin at station 0, with points `ds` [m] apart, and are compared inside `band`
    [cycles/m]. Return the map of largest correlation, and whether the profiles match. Raises
    ValueError if less than MIN_OVERLAP would be common.
    """
    first, second = (_slopes(z, ds, band) for z in (reference, other))
    shortest = min(np.ptp(x[0]) for x in (first, second))
    if shortest < MIN_OVERLAP:
        trimmed = 2.0 * min(1.0 / band[0], 0.1 * ds * min(reference.shape[1], other.shape[1]))
        raise ValueError(
            f"{shortest + trimmed:.1f} m are too short to be aligned: at least "
            f"{MIN_OVERLAP + 2.0 / band[0]:.0f} m are needed"
        )
    head = second[0] <= second[0][0] + _SEARCH_LENGTH
    begin = second[0][head], second[1][:, head]
    lag, stretch, correlation, overlap = _search(first, begin)
    ends = second[0][[0, -1]]
    whole = StationMap(ends, lag + (1.0 + stretch) * ends, correlation)
    if not is_match(correlation, overlap, band):
        return whole, False
    for _ in range(2):  # the second time with windows that are hardly stretched
        whole = _refine(whole, first, second, ds)
    return whole, True


def _slopes(z: np.ndarray, ds: float, band: Band) -> _Slopes:
    """Return stations and band-passed slopes of `z` (2, M) [m]."""
    slope = np.gradient(band_pass(z, ds, band), ds, axis=1)
    cut = (z.shape[1] - slope.shape[1]) // 2
    return ds * (cut + np.arange(slope.shape[1])), slope


def _search(first: _Slopes, second: _Slopes) -> tuple[float, float, float, float]:
    """Return lag [m], stretch, correlation and overlap [m] of the largest correlation."""
    (s, x), (r, y) = first, second
    x, begin = _resample(s, x, 1.0)
    step = 2.0 * _MISPLACEMENT / max(min(np.ptp(s), np.ptp(r)), 1.0)
    count = int(np.ceil(_MAX_STRETCH / step))
    best = (0.0, 0.0, -2.0, 0.0)
    for stretch in np.linspace(-_MAX_STRETCH, _MAX_STRETCH, 2 * count + 1):
        scaled, start = _resample(r, y, 1.0 + stretch)
        needed = int(np.floor(min(MIN_OVERLAP / _SEARCH_SPACING, x.shape[1], scaled.shape[1])))
        k, correlation = lag_correlations(x, scaled, needed, 0)
        lags = _SEARCH_SPACING * k + begin - start
        near = np.abs(lags) <= SEARCHED
        if near.any() and (top := float(correlation[near].max())) > best[2]:
            i = int(np.flatnonzero(near)[np.argmax(correlation[near])])
            overlap = min(k[i] + scaled.shape[1], x.shape[1]) - max(k[i], 0)
            best = (_peak(lags, correlation, i), float(stretch), top, _SEARCH_SPACING * overlap)
    return best


def _resample(s: np.ndarray, slope: np.ndarray, scale: float) -> tuple[np.ndarray, float]:
    """Return slopes (2, N) at multiples of _SEARCH_SPACING of `scale` x `s`, and the first."""
    stations = scale * s
    begin, end = np.ceil(stations[0] / _SEARCH_SPACING), np.floor(stations[-1] / _SEARCH_SPACING)
    grid = _SEARCH_SPACING * np.arange(begin, end + 1.0)
    return np.array([np.interp(grid, stations, x) for x in slope]), float(grid[0])


def _refine(whole: StationMap, first: _Slopes, second: _Slopes, ds: float) -> StationMap:
    """Return the map through the lags of windows of `second`, relative to the map `whole`."""
    (s, x), (r, y) = first, second
    mapped = whole.apply(r)
    begin, end = max(s[0], mapped[0]), min(s[-1], mapped[-1])
    count = max(1, round((end - begin) / (0.5 * _WINDOW)) - 1)
    length = min(_WINDOW, end - begin)
    reach, size = round(_REFINED / ds), int(length / ds) - 2 * round(_REFINED / ds)
    knots, shifts, last = [], [], 0.0
    for left in np.linspace(begin, end - length, count):
        inner = left + _REFINED + ds * np.arange(size)
        outer = left + last + _REFINED + ds * (np.arange(size + 2 * reach) - reach)
        window = np.array([np.interp(inner, mapped, path) for path in y])
        road = np.array([np.interp(outer, s, path) for path in x])
        k, correlation = lag_correlations(road, window, size, -reach)
        i = int(np.argmax(correlation))
        if correlation[i] > _MIN_WINDOW_CORRELATION and 0 < i < k.size - 1:
            last += _peak(ds * k, correlation, i)
            knots.append(float(left + 0.5 * length))
            shifts.append(last)
    if not knots:
        return whole
    # stations of the other profile where its windows have their middles
    own = np.interp(knots, mapped, r)
    ends = np.array([min(r[0], own[0] - 1.0), max(r[-1], own[-1] + 1.0)])
    stations = np.concatenate([ends[:1], own, ends[1:]])
    shift = np.interp(stations, own, shifts)
    return StationMap(stations, whole.apply(stations) + shift, whole.correlation)


def _peak(lags: np.ndarray, correlation: np.ndarray, i: int) -> float:
    """Return the lag at the vertex of the parabola through the correlations about index `i`."""
    if not 0 < i < correlation.size - 1 or not np.allclose(np.diff(lags[i - 1 : i + 2], 2), 0.0):
        return float(lags[i])
    left, top, right = correlation[i - 1 : i + 2]
    curvature = left - 2.0 * top + right
    fraction = 0.5 * (left - right) / curvature if curvature < 0.0 else 0.0
    return float(lags[i] + fraction * (lags[i + 1] - lags[i]))


def lag_correlations(
    reference: np.ndarray, other: np.ndarray, needed: int, start: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return lags (L,) and correlation coefficients (L,) of slopes (2, N) and (2, M).

    At a lag k, sample i of `other` lies on sample i + k - `start` of `reference`. Only lags with at
    least `needed` common samples are returned.
    """
    ones = np.ones_like(other)

    def slide(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return scipy.signal.fftconvolve(x, y[:, ::-1], axes=1).sum(axis=0)

    product = slide(reference, other)
    power = slide(reference**2, ones) * slide(np.ones_like(reference), other**2)
    common = np.rint(slide(np.ones_like(reference), ones)) / 2.0
    k = np.arange(product.size) - (other.shape[1] - 1)
    use = common >= needed
    r = product[use] / np.sqrt(np.maximum(power[use], 1e-30))
    return k[use] + start, r
