"""Baselines shown on every board, which put the score of an entry into proportion.

    flat, mean, unrelated_road   estimators that use no measurement
    truth_plus_noise             the truth plus 2 % noise inside the band, made by the evaluation
    memory                       the training road with its known delay undone, by the evaluation

`memory` appears where a task trains on altered copies of its test road: it uses no measurement, and
its score is what an entry earns there by remembering the training road and where it lay.
The least error of any linear estimator with the paper's three noisy accelerometers is 3.2 %. An
entry that scores better than 2 % has used the truth, or the evaluation is faulty; its row is
flagged (`report.notes.sanity_warnings`).
"""

from collections.abc import Sequence

import numpy as np

from leaderboard.metrics.heights import Band, band_pass
from road_envs.records.record import Estimate, Profile

TRUTH_PLUS_NOISE = "truth_plus_noise"
MEMORY = "memory"
BASELINES = ("flat", "mean", "unrelated_road", TRUTH_PLUS_NOISE)  # baselines of every task
ALL_BASELINES = (*BASELINES, MEMORY)  # names of all baselines; no entry may have one of them
NOISE_LEVEL = 0.02  # ratio of the noise of `truth_plus_noise` to the truth, both as in-band RMS


def truth_plus_noise(truth: Profile, band: Band, seed: int) -> Estimate:
    """Return the truth plus Gaussian noise of NOISE_LEVEL times its RMS inside `band`."""
    noise = np.random.default_rng(seed).standard_normal(truth.z.shape)
    # match the RMS inside the band, the part that is scored
    inside = (band_pass(z, truth.ds, band) for z in (truth.z, noise))
    true, own = (np.sqrt(np.mean(z**2)) for z in inside)
    return Estimate(truth.s, truth.z + NOISE_LEVEL * (true / own) * noise)


def memory(truths: Sequence[Profile], delays: Sequence[float], stations: np.ndarray) -> Estimate:
    """Return the mean of the `truths` of training drives at `stations` (M,) [m], each moved back by
    its delay [m] and continued at its last height.
    """
    moved = [
        np.stack([np.interp(stations + delay, truth.s, path) for path in truth.z])
        for truth, delay in zip(truths, delays, strict=True)
    ]
    return Estimate(stations, np.mean(moved, axis=0))
