"""Statistics of a board: interquartile means, bootstrap intervals, ranks.

Scores of an entry are (R, C, S): roads, conditions, training seeds. The bootstrap is hierarchical:
it resamples roads, then seeds, and never parts of one road (Agarwal et al., NeurIPS 2021, for the
interquartile mean and stratified intervals). One trained estimator is tested on every road, so a
resample of seeds holds for all roads of a replicate. Entries are paired: each replicate uses the
same roads for all of them. Roads are resampled within their family, so that the differences
between families do not widen the intervals. Of n roads n - 1 are drawn, each with the weight
n / (n - 1): drawing n would give (n - 1) / n of the variance of a mean, half of it with two roads
(Rao and Wu, J. Am. Stat. Assoc. 83, 231-241, 1988, with m = n - 1). So are seeds. An interval is
the standard deviation of the replicates times a quantile of Student's t, with as many degrees of
freedom as roads are drawn (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter
12): percentiles of the replicates of few roads are too narrow.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t

_REPLICATES = 2000  # of an interval or a rank: its width varies by 1.6 %
_QUANTILES = (0.5 - 0.95 / 2, 0.5 + 0.95 / 2)  # shares below the ends of an interval of 95 %
MIN_ROADS = 5  # least number for an interval or a rank: with two, it is their two scores
# share of a score by which the same program differs on other processors or kernels in half of its
# runs: ten times the median that was measured (`evaluation.comparison`); nobody leads by less
REPRODUCIBLE = 5e-3
MAX_BATCH_SCORES = 2_000_000  # scores held in memory at once while resampling: 16 MB
Strata = Sequence[Sequence[int]]  # indices of the roads of each stratum (family of roads)
_Mean = Callable[..., np.ndarray]  # of values, an axis and weights, as `interquartile_mean`


class Interval(NamedTuple):
    """An interquartile mean with its bootstrap interval."""

    mean: float
    low: float
    high: float


def interquartile_mean(
    x: np.ndarray, axis: int = -1, weights: np.ndarray | None = None
) -> np.ndarray:
    """Return the mean of the middle half of `x`; values at the quartiles count in part. NaNs are
    ignored; the mean of no values is NaN. Each value counts once, or as often as its `weights` (n,)
    say, whole numbers for the values along the axis.
    """
    x = np.moveaxis(x, axis, -1)
    order = np.argsort(x, axis=-1)
    x = np.take_along_axis(x, order, axis=-1)
    count = np.where(np.isnan(x), 0.0, 1.0 if weights is None else weights[order])
    # a value covers as many ranks as it counts: it has the weight of those of them that lie between
    # the quartiles, at 1/4 and 3/4 of all
    end = np.cumsum(count, axis=-1)
    low, high = 0.25 * end[..., -1:], 0.75 * end[..., -1:]
    weight = np.maximum(np.minimum(end, high) - np.maximum(end - count, low), 0.0)
    total = weight.sum(axis=-1)
    with np.errstate(invalid="ignore"):
        return np.sum(np.where(weight > 0.0, weight * x, 0.0), axis=-1) / total


def bootstrap(
    scores: np.ndarray,
    seed: int,
    replicates: int = _REPLICATES,
    strata: Strata | None = None,
    mean: _Mean = interquartile_mean,
) -> np.ndarray:
    """Return the means (B,) of resamples of `scores` (R, C, S): roads, then seeds.

    Roads are resampled within each of `strata`, lists of their indices; there is one by default,
    and where one has a single road with runs, of which nothing could be drawn. The resampled roads
    depend on `seed`, `strata`, B and which roads have runs alone, so entries with one `seed` and
    runs on the same roads are paired. NaNs mark missing runs; a road without runs is not drawn.
    """
    batches = _replicate_scores(scores, seed, replicates, strata)
    return np.concatenate([mean(x, axis=-1, weights=weights) for x, weights in batches])


class Resampled(NamedTuple):
    """A weighted sum of means, its replicates (B,), and the roads drawn in each."""

    mean: float
    replicates: np.ndarray
    n_drawn: int

    def interval(self) -> Interval:
        """Return the sum with its 95 % interval, NaNs if a replicate is undefined."""
        if not np.isfinite(self.replicates).all():
            return Interval(np.nan, np.nan, np.nan)
        half = float(_half_width(self.replicates.std(), self.n_drawn))
        return Interval(self.mean, self.mean - half, self.mean + half)

    def logarithm(self) -> "Resampled":
        """Return the logarithms of mean and replicates, of `REPRODUCIBLE` of the mean at least."""
        least = max(REPRODUCIBLE * self.mean, np.finfo(float).tiny)
        logs = np.log(np.maximum(self.replicates, least))
        return Resampled(math.log(max(self.mean, least)), logs, self.n_drawn)


def _half_width(std: ArrayLike, n_drawn: ArrayLike) -> np.ndarray:
    """Return half the width of a 95 % interval, from the `std` of replicates of `n_drawn` roads."""
    return np.asarray(std * t.ppf(_QUANTILES[1], n_drawn))


def resample(
    parts: Sequence[np.ndarray],
    weights: Sequence[float] = (1.0,),
    strata: Strata | None = None,
    mean: _Mean = interquartile_mean,
) -> Resampled:
    """Return the sum of the means of `parts`, each (R, C, S), with `weights`; see `bootstrap`. All
    have the same roads and seeds in each replicate.
    """
    made = [bootstrap(part, 0, strata=strata, mean=mean) for part in parts]
    means = [float(mean(part.ravel())) for part in parts]
    drawn = min(sum(map(_number_drawn, map(len, _drawable(part, strata)))) for part in parts)
    return Resampled(float(np.dot(weights, means)), np.tensordot(weights, made, axes=1), drawn)


def iqm_slope(parts: Mapping[int, np.ndarray], strata: Strata | None = None) -> Interval:
    """Return the least-squares slope of the interquartile mean of `parts` (R, C, S) over their
    keys, with its 95 % interval; the parts are paired road by road and seed by seed.
    """
    x = np.array([*parts], dtype=float)
    x -= x.mean()
    return resample([*parts.values()], (x / np.sum(x * x)).tolist(), strata=strata).interval()


def performance_profile(
    scores: np.ndarray, thresholds: np.ndarray, strata: Strata | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the shares (T,) of `scores` (R, C, S) at or below each of `thresholds` (T,), and the
    ends (T,) of their bootstrap intervals. NaN: a missing run; infinity: one above every threshold.
    """

    def shares(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
        count = ~np.isnan(x) @ weights
        with np.errstate(invalid="ignore"):
            return np.stack([(x <= limit) @ weights / count for limit in thresholds], axis=-1)

    batches = _replicate_scores(scores, 0, 300, strata)  # replicates: enough for a drawn line
    parts = [shares(*batch) for batch in batches]
    low, high = np.quantile(np.concatenate(parts), _QUANTILES, axis=0)
    return shares(scores.ravel(), np.ones(scores.size)), low, high


def _replicate_scores(
    scores: np.ndarray, seed: int, replicates: int, strata: Strata | None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield resampled scores (b, N) and their weights (N,) in batches of replicates."""
    # indices of the roads (B, r), drawn stratum by stratum, and of the seeds (B, s): the streams of
    # both are apart, so that entries with other numbers of seeds still share their roads
    _, C, S = scores.shape
    drawable = _drawable(scores, strata)
    numbers = [_number_drawn(len(part)) for part in drawable]
    road_rng, seed_rng = np.random.default_rng(seed).spawn(2)
    drawn = [
        np.asarray(part)[road_rng.integers(len(part), size=(replicates, n))]
        for part, n in zip(drawable, numbers, strict=True)
    ]
    roads = np.concatenate(drawn, axis=1)
    seeds = seed_rng.integers(S, size=(replicates, _number_drawn(S)))
    whole = math.lcm(*numbers)  # makes the weights whole numbers, whose sums are exact
    of_roads = [whole * len(part) // n for part, n in zip(drawable, numbers, strict=True)]
    weights = np.repeat(np.repeat(of_roads, numbers), seeds.shape[1] * C).astype(float)
    size = max(1, MAX_BATCH_SCORES // scores.size)
    for k in range(0, replicates, size):
        # scores (b, r, s, C): each road of a replicate with each of its seeds; a seed is a trained
        # estimator, which is drawn for all roads at once
        part = slice(k, k + size)
        resampled = scores[roads[part, :, None], :, seeds[part, None, :]]
        yield resampled.reshape(len(resampled), -1), weights


def _drawable(scores: np.ndarray, strata: Strata | None) -> list[list[int]]:
    """Return the indices of the roads that are drawn in each stratum: those with runs."""
    has_runs = ~np.isnan(scores).all(axis=(1, 2))
    has_runs |= not has_runs.any()
    drawable = [[k for k in part if has_runs[k]] for part in strata or [range(len(scores))]]
    drawable = [*filter(None, drawable)]
    return [np.flatnonzero(has_runs).tolist()] if min(map(len, drawable)) < 2 else drawable


def _number_drawn(n: int) -> int:
    """Return how many of `n` roads or seeds are drawn: n - 1, and the only one."""
    return max(1, n - 1)


def iqm_interval(scores: np.ndarray, strata: Strata | None = None) -> Interval:
    """Return the interquartile mean of `scores` (R, C, S) with its 95 % interval, of its logarithm
    if all replicates are positive; or NaNs.
    """
    made = resample([scores], strata=strata)
    if not (made.replicates > 0.0).all():
        return made.interval()
    mean, _, high = made.logarithm().interval()
    factor = math.exp(high - mean)
    return Interval(made.mean, made.mean / factor, made.mean * factor)


def count_roads(scores: np.ndarray) -> int:
    """Return the number of roads with runs in `scores` (R, C, S)."""
    return int(np.sum(~np.isnan(scores).all(axis=(1, 2))))


def rank_entries(scores: Mapping[str, np.ndarray], strata: Strata | None = None) -> dict[str, int]:
    """Rank the entries by their `scores` (R, C, S), lower is better; best first, NaNs last.

    They are in the order of their interquartile means, and share the rank of the one before, as in
    1 2 2 2 5, unless more others are significantly better than were of any before. An entry is
    significantly better if the 95 % interval of the paired difference, of the logarithms if no
    score is negative, is beyond `REPRODUCIBLE`, as of two that err alike one is always ahead, by
    rounding. Roads alone are drawn, each with all its runs: of three seeds, one of luck alone would
    be drawn too often.
    """
    made = {name: resample([x.reshape(len(x), -1, 1)], strata=strata) for name, x in scores.items()}
    known = {name: x for name, x in made.items() if np.isfinite(x.replicates).all()}
    better = dict.fromkeys(scores, len(known))
    if known:
        in_logs = not any((x < 0.0).any() for x in scores.values())
        compared = [x.logarithm() if in_logs else x for x in known.values()]
        mean, draws, drawn = (np.array(x) for x in zip(*compared, strict=True))
        least = np.log1p(REPRODUCIBLE) if in_logs else REPRODUCIBLE * np.abs(mean)
        cov = np.atleast_2d(np.cov(draws))
        var = np.maximum(np.diag(cov)[:, None] + np.diag(cov) - 2.0 * cov, 0.0)  # of differences
        half = _half_width(np.sqrt(var), np.minimum.outer(drawn, drawn))
        ahead = mean[:, None] - mean - half > least  # who is ahead of whom
        better |= dict(zip(known, ahead.sum(axis=1).tolist(), strict=True))
    order = sorted(scores, key=lambda name: np.nan_to_num(made[name].mean, nan=np.inf))
    counts = [*accumulate((better[name] for name in order), max)]
    return {name: 1 + counts.index(n) for name, n in zip(order, counts, strict=True)}
