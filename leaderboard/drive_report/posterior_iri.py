"""Posterior of the International Roughness Index, by samples of the profile's error.

An estimate has the standard deviation of its error inside the scored band. Samples of that error
are added to the profile and the IRI of each is computed; the median and the 2.5 and 97.5 %
quantiles are reported. This also removes the bias of the smoothed profile, whose IRI is too low by
the power of what was not resolved. Where the vehicle differs from its description, an estimator
takes its motion for noise and states an error that is larger than the road itself; no error counts
for more than MAX_ERROR_SHARE of the roughness around it.

Assumptions: the error is Gaussian with a density proportional to n^-2, as the slopes of roads and
of their errors are nearly white, and it continues with that density over the band of the IRI; it is
common to both wheel paths, which makes the interval of their mean no narrower than those of the
paths. What the posterior does not know, such as the gains of sensors and speed and a vehicle that
differs from its description, is added as a relative standard deviation of the IRI, MODEL_STD.
"""

from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfftfreq
from scipy.ndimage import uniform_filter1d

from leaderboard.metrics.heights import band_pass
from road_envs.records.record import Estimate, scored_band
from road_envs.records.roughness import golden_car

IRI_BAND = (0.04, 2.0)
"""Band [cycles/m] over which the error is continued: 25 to 0.5 m, the waves that the golden car
answers to.
"""

MODEL_STD = 0.07
"""Relative standard deviation of the IRI by what the posterior does not know, from simulated drives
of grade S2 (`tests/long/report_trial.py` with seeds 201 to 203).
"""

MAX_ERROR_SHARE, SHARE_LENGTH = 0.35, 20.0
"""Largest standard deviation of the error relative to the RMS height in the scored band, and the
window [m] of that. By a third, the median of the IRI is 6 % above that of the profile.
"""

SAMPLES = 100
QUANTILES = (0.025, 0.5, 0.975)
"""The interval of 95 % and the median."""


class IriPosterior(NamedTuple):
    """Lower limit, median and upper limit [mm/m], each (3, K): left, right and mean by segment."""

    low: np.ndarray
    median: np.ndarray
    high: np.ndarray


def posterior_iri(
    estimate: Estimate,
    v: float,
    edges: np.ndarray,
    *,
    factor: float = 1.0,
    model_std: float | np.ndarray = MODEL_STD,
) -> IriPosterior:
    """Return the IRI of the segments between stations `edges` (K + 1,) [m] of a drive at `v` [m/s].

    All values are multiplied by `factor`; `model_std`, one or by segment (K,), is the relative
    standard deviation by what the posterior does not know. Without a standard deviation of the
    estimate all three values are those of its profile.
    """
    rng, band = np.random.default_rng(0), scored_band(v)
    index = np.searchsorted(estimate.s, edges)
    known = estimate.z_std is not None
    std = np.zeros(1)
    if estimate.z_std is not None:
        std = np.minimum(estimate.z_std, MAX_ERROR_SHARE * _roughness(estimate, band))
    drawn = []
    for _ in range(SAMPLES if known else 1):
        error = 0.0
        if known:
            error = std * unit_error(estimate.s.size, estimate.ds, band, rng)
        drawn.append(_segment_iri(estimate.z + error, estimate.ds, index))
    iri = np.array(drawn)
    if known:
        iri *= np.exp(model_std * rng.standard_normal((SAMPLES, 1, 1)))
    return IriPosterior(*np.quantile(factor * iri, QUANTILES, axis=0))


def unit_error(
    size: int, ds: float, band: tuple[float, float], rng: np.random.Generator
) -> np.ndarray:
    """Return an error (size,) of density n^-2 over IRI_BAND whose part in `band` has variance 1."""
    whole = next_fast_len(size + round(1.0 / (IRI_BAND[0] * ds)), real=True)
    n = rfftfreq(whole, ds)
    inside = (n >= IRI_BAND[0]) & (n <= IRI_BAND[1])
    density = np.zeros(n.size)
    density[inside] = n[inside] ** -2.0
    scored = (n >= band[0]) & (n <= band[1])
    lines = rng.standard_normal(n.size) + 1j * rng.standard_normal(n.size)
    x = irfft(np.sqrt(density) * lines, whole)
    # the variance of irfft of such lines is 4 sum(density) / whole²
    return (x / np.sqrt(4.0 * density[scored].sum()) * whole)[:size]


def _roughness(estimate: Estimate, band: tuple[float, float]) -> np.ndarray:
    """Return the RMS height (2, M) [m] in the `band` around each station."""
    z = band_pass(estimate.z, estimate.ds, band)
    power = uniform_filter1d(z**2, round(SHARE_LENGTH / estimate.ds), axis=1, mode="nearest")
    missing = estimate.s.size - z.shape[1]  # the filter cuts the ends
    ends = (missing // 2, missing - missing // 2)
    return np.sqrt(np.pad(np.maximum(power, 0.0), ((0, 0), ends), mode="edge"))


def _segment_iri(z: np.ndarray, ds: float, index: np.ndarray) -> np.ndarray:
    """Return the IRI (3, K) [mm/m] of left, right and their mean between the indices (K + 1,)."""
    motion = 1e3 * np.abs(golden_car(z, ds))
    index = np.minimum(index, motion.shape[1] - 1)
    sums = np.add.reduceat(motion, index[:-1], axis=1)
    sums[:, -1] = motion[:, index[-2] : index[-1] + 1].sum(axis=1)
    counts = np.diff(index)
    counts[-1] += 1
    left, right = sums / counts
    return np.array([left, right, 0.5 * (left + right)])
