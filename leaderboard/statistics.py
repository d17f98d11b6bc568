"""From many scores to one line of a table, without reading more into them than they hold.

Scores of an entry are (R, C, S): roads, conditions, training seeds. The unit of replication is the
road, then the seed, so the bootstrap draws roads, then seeds, and never samples along one road
(Agarwal et al., NeurIPS 2021, for the interquartile mean and stratified intervals). One training
is tested on every road, so a draw of seeds holds for all roads of a replicate. Entries are paired:
each replicate puts all of them on the same roads.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

REPLICATES = 2000
LEVEL = 0.95


class Interval(NamedTuple):
    """An interquartile mean and its bootstrap interval."""

    mean: float
    low: float
    high: float


class Standing(NamedTuple):
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
    R, _, S = scores.shape
    road_rng, seed_rng = np.random.default_rng(seed).spawn(2)
    roads = road_rng.integers(R, size=(replicates, R))
    seeds = seed_rng.integers(S, size=(replicates, S))
    drawn = scores[roads[:, :, None], :, seeds[:, None, :]]
    return interquartile_mean(drawn.reshape(replicates, -1))


def interval(scores: np.ndarray, seed: int = 0) -> Interval:
    """Interquartile mean of `scores` (R, C, S) with its 95 % interval; NaN if any score is."""
    return _interval(scores, bootstrap(scores, seed))


def standings(scores: Mapping[str, np.ndarray], seed: int = 0) -> dict[str, Standing]:
    """Rank of each entry by `scores` (R, C, S), the lower the better, best first.

    An entry is better beyond doubt if the 95 % interval of the paired difference is below 0, so
    entries that cannot be told apart share a rank. A score that is NaN comes last.
    """
    replicates = {name: bootstrap(x, seed) for name, x in scores.items()}
    rows = {
        name: Standing(
            1 + sum(_better(other, mine) for other in replicates.values()),
            _interval(scores[name], mine),
        )
        for name, mine in replicates.items()
    }
    last = np.inf
    by_mean = sorted(rows.items(), key=lambda row: np.nan_to_num(row[1].score.mean, nan=last))
    return dict(by_mean)


def _better(other: np.ndarray, mine: np.ndarray) -> bool:
    if np.isnan(mine).any():
        return not np.isnan(other).any()
    return bool(np.quantile(other - mine, 0.5 + LEVEL / 2) < 0.0)


def _interval(scores: np.ndarray, replicates: np.ndarray) -> Interval:
    low, high = np.quantile(replicates, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
    return Interval(float(interquartile_mean(scores.ravel())), float(low), float(high))
