"""Posterior of the International Roughness Index, by samples of the road.

An estimate that carries samples of its posterior (`Estimate.draws`) has an IRI of each, and their
logarithms have a mean and a standard deviation: the IRI of a segment, with an interval of 95 %. The
IRI of the estimate itself is too low by the power of the waves that were not resolved, which the
samples have. Without samples the IRI is that of the estimate, without an interval, unless a
standard deviation is known from elsewhere.
"""

from typing import NamedTuple

import numpy as np

from road_envs.records.record import Estimate
from road_envs.records.roughness import golden_car

_MODEL_STD = 0.01
"""Relative standard deviation of what the samples do not contain: the model of a known vehicle is
not the vehicle. On 16 drives over classes A to D the IRI had an RMS error of 0.2 to 2.2 %, the
samples a deviation of 0.25 to 1 %.
"""

_SMOOTH_STD = 0.05
"""Standard deviation [mm/m] of the IRI by what hides smooth roads: where dry friction holds the
struts, the most probable road is flatter than the roads that are (class A, known vehicle: IRI 2 to
5 % low with the noise of the paper's sensors, 0.22 m/s², 0 to 2 % with that of phones, 0.018 m/s²).
"""

NO_INTERVAL_NOTE = (
    "the estimator draws no samples of the road: its IRI has no interval, and is too low by the "
    "waves that were not resolved"
)


class IriPosterior(NamedTuple):
    """Lower limit, median and upper limit [mm/m], each (3, K): left, right and mean by segment. The
    limits are NaN where there is no interval.
    """

    low: np.ndarray
    median: np.ndarray
    high: np.ndarray


def posterior_iri(
    estimate: Estimate,
    edges: np.ndarray,
    *,
    factor: float = 1.0,
    relative_std: float | np.ndarray = 0.0,
) -> IriPosterior:
    """IRI of the segments between stations `edges` (K + 1,) [m].

    All values are multiplied by `factor`; `relative_std`, one or by segment (K,), is a relative
    standard deviation that adds to that of the samples, to `_MODEL_STD` and to `_SMOOTH_STD`.
    """
    index = np.searchsorted(estimate.s, edges)
    roads = estimate.z[None] if estimate.draws is None else estimate.draws

    def path_indices(z: np.ndarray) -> list[np.ndarray]:
        left, right = segment_means(1e3 * np.abs(golden_car(z, estimate.ds)), index)
        return [left, right, 0.5 * (left + right)]

    log = np.log(factor * np.array([path_indices(z) for z in roads]))
    middle, std = log.mean(axis=0), np.hypot(log.std(axis=0), relative_std)
    if estimate.draws is not None:
        std = np.sqrt(std**2 + _MODEL_STD**2 + (_SMOOTH_STD / np.exp(middle)) ** 2)
    elif not np.any(relative_std):
        std = np.full_like(std, np.nan)
    spread = 1.96 * std  # of an interval of 95 %
    return IriPosterior(*(np.exp(middle + part) for part in (-spread, 0.0, spread)))


def segment_means(x: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Means (..., K) of `x` (..., N) between the indices (K + 1,), the last one included."""
    ends = np.minimum(index, x.shape[-1] - 1)
    ends[-1] += 1
    return np.add.reduceat(x[..., : ends[-1]], ends[:-1], axis=-1) / np.diff(ends)
