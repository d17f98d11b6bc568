"""From many scores to one line of a table, without reading more into them than they hold.

Scores of an entry are (R, C, S): roads, conditions, training seeds. The unit of replication is the
road, then the seed, so the bootstrap draws roads, then seeds, and never samples along one road
(Agarwal et al., NeurIPS 2021, for the interquartile mean and stratified intervals). One training
is tested on every road, so a draw of seeds holds for all roads of a replicate. Entries are paired:
each replicate puts all of them on the same roads.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

REPLICATES = 2000
CONFIDENCE = 0.95
MAX_BATCH_SCORES = 2_000_000
"""Scores held at a time while replicates are drawn: 16 MB."""


class Interval(NamedTuple):
    """An interquartile mean and its bootstrap interval."""

    mean: float
    low: float
    high: float


class PerformanceProfile(NamedTuple):
    """Shares (T,) of runs at or below each threshold, with their bootstrap intervals."""

    share: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Rank(NamedTuple):
    """Where an entry stands: `rank` is 1 + how many entries are better beyond doubt."""

    rank: int
    score: Interval


def interquartile_mean(x: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half of `x`, the values at its edges with their share."""
    x = np.sort(x, axis=axis)
    size = x.shape[axis]
    rank = np.arange(size)
    weight = np.clip(np.minimum(rank + 1, 0.75 * size) - np.maximum(rank, 0.25 * size), 0.0, 1.0)
    return np.tensordot(x, weight / weight.sum(), axes=(axis, 0))


def bootstrap(scores: np.ndarray, seed: int, replicates: int = REPLICATES) -> np.ndarray:
    """Interquartile means (B,) of `scores` (R, C, S) with roads, then seeds, drawn again.

    The draw of roads depends on `seed`, R and B alone: entries with one `seed` are paired.
    """
    return np.concatenate(
        [interquartile_mean(x) for x in _replicate_scores(scores, seed, replicates)]
    )


def iqm_slope(parts: Sequence[np.ndarray], seed: int = 0) -> Interval:
    """Growth of the interquartile mean from one of `parts` (R, C, S) to the next, by least squares.

    With its 95 % interval; the parts are paired, road by road and seed by seed.
    """
    x = np.arange(len(parts)) - 0.5 * (len(parts) - 1)
    weight = x / np.sum(x * x)
    drawn = weight @ np.stack([bootstrap(part, seed) for part in parts])
    low, high = np.quantile(drawn, [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2])
    mean = weight @ np.array([float(interquartile_mean(part.ravel())) for part in parts])
    return Interval(float(mean), float(low), float(high))


def performance_profile(
    scores: np.ndarray, thresholds: np.ndarray, seed: int = 0, replicates: int = REPLICATES
) -> PerformanceProfile:
    """Performance profile of `scores` (R, C, S), the lower the better, at `thresholds` (T,).

    The share of runs that are at least as good as each threshold; a score that is NaN never is.
    """
    with np.errstate(invalid="ignore"):
        reached = [np.mean(scores <= x) for x in thresholds]
        parts = [
            np.stack([np.mean(x <= limit, axis=1) for limit in thresholds], axis=1)
            for x in _replicate_scores(scores, seed, replicates)
        ]
    low, high = np.quantile(
        np.concatenate(parts), [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2], axis=0
    )
    return PerformanceProfile(np.array(reached), low, high)


def _replicate_scores(scores: np.ndarray, seed: int, replicates: int) -> Iterator[np.ndarray]:
    """The replicates' scores (b, R C S), some replicates at a time."""
    R, _, S = scores.shape
    road_rng, seed_rng = np.random.default_rng(seed).spawn(2)
    roads = road_rng.integers(R, size=(replicates, R))
    seeds = seed_rng.integers(S, size=(replicates, S))
    size = max(1, MAX_BATCH_SCORES // scores.size)
    for k in range(0, replicates, size):
        part = slice(k, k + size)
        drawn = scores[roads[part, :, None], :, seeds[part, None, :]]
        yield drawn.reshape(len(drawn), -1)


def iqm_interval(scores: np.ndarray, seed: int = 0) -> Interval:
    """Interquartile mean of `scores` (R, C, S) with its 95 % interval; NaN if any score is."""
    return _as_interval(scores, bootstrap(scores, seed))


def rank_entries(
    scores: Mapping[str, np.ndarray], seed: int = 0, replicates: int = REPLICATES
) -> dict[str, Rank]:
    """Rank of each entry by `scores` (R, C, S), the lower the better, best first.

    An entry is better beyond doubt if the 95 % interval of the paired difference is below 0: if
    it is ahead in 97.5 % of the replicates. So entries that cannot be told apart share a rank. A
    score that is NaN comes last.
    """
    if not scores:
        return {}
    drawn = np.stack([bootstrap(x, seed, replicates) for x in scores.values()])  # (N, B)
    drawn[np.isnan(drawn).any(axis=1)] = np.inf
    rows = {
        name: Rank(
            1 + int(np.sum(np.mean(drawn < mine, axis=1) > 0.5 + CONFIDENCE / 2)),
            _as_interval(scores[name], mine),
        )
        for name, mine in zip(scores, drawn, strict=True)
    }
    last = np.inf
    by_mean = sorted(rows.items(), key=lambda row: np.nan_to_num(row[1].score.mean, nan=last))
    return dict(by_mean)


def _as_interval(scores: np.ndarray, replicates: np.ndarray) -> Interval:
    if not np.isfinite(replicates).all():
        return Interval(np.nan, np.nan, np.nan)
    low, high = np.quantile(replicates, [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2])
    return Interval(float(interquartile_mean(scores.ravel())), float(low), float(high))
