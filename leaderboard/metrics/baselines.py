"""Marks that stand on every board, so that a reader sees what a score is worth.

    flat, mean, unrelated_road   estimators that measure nothing
    truth_plus_noise             the judge's own: the truth with 2 % noise added inside the band

2 % is below 3.2 %, the least error that any linear method can reach with the paper's three noisy
accelerometers on the judge's car. An entry that scores better has seen the truth, or the judge is
broken; either way its row is flagged.
"""

import numpy as np

from leaderboard.metrics.heights import Band, band_pass
from road_envs.data.record import Estimate, Profile

TRUTH_PLUS_NOISE = "truth_plus_noise"
BASELINES = ("flat", "mean", "unrelated_road", TRUTH_PLUS_NOISE)
NOISE_LEVEL = 0.02


def truth_plus_noise(truth: Profile, band: Band, seed: int) -> Estimate:
    """The truth with Gaussian noise whose level inside `band` is 2 % of the truth's."""
    noise = np.random.default_rng(seed).standard_normal(truth.z.shape)
    level = _rms(band_pass(truth.z, truth.ds, band)) / _rms(band_pass(noise, truth.ds, band))
    return Estimate(truth.s, truth.z + NOISE_LEVEL * level * noise)


def _rms(z: np.ndarray) -> float:
    return float(np.sqrt(np.mean(z**2)))
