"""Measurements as means of acceleration samples over short blocks.

A block of b samples with white noise of variance sigma² each has a mean of variance sigma² / b, and
the vehicle model predicts that mean exactly. No information below the block rate is lost, and
missing, clipped or invalid samples are left out one by one.
"""

from dataclasses import dataclass

import numpy as np

MIN_NOISE_DENSITY = 1e-3
"""Noise density [(m/s²)/sqrt(Hz)] below which the integration error of the model dominates."""


@dataclass(frozen=True, eq=False)
class BlockMeans:
    """Means `y` (S, J) [m/s²] over blocks of b samples, the `sample_weight` (S, J, b) of each
    sample in the mean of its block (0 if unused) and the number of samples used, `sample_count` (S,
    J).
    """

    y: np.ndarray
    sample_weight: np.ndarray
    sample_count: np.ndarray

    @property
    def n_samples(self) -> int:
        """Samples J b of each sensor, used or not."""
        return self.sample_weight.shape[1] * self.sample_weight.shape[2]

    def average(self, a: np.ndarray) -> np.ndarray:
        """Return the means (S, J) of other samples `a` (S, J b) with the same weights."""
        return np.einsum("sjb,sjb->sj", self.sample_weight, a.reshape(self.sample_weight.shape))


def block_means(a: np.ndarray, valid: np.ndarray, block: int) -> BlockMeans:
    """Return the means of the `valid` samples of `a` (S, T) [m/s²], over blocks of `block` samples.

    Up to `block` - 1 samples at the end fill no block and are left out.
    """
    J = a.shape[1] // block
    shape = (a.shape[0], J, block)
    valid, a = valid[:, : J * block].reshape(shape), a[:, : J * block].reshape(shape)
    count = valid.sum(axis=2)
    weight = valid / np.maximum(count, 1)[:, :, None]
    y = np.einsum("sjb,sjb->sj", weight, np.where(valid, a, 0.0))
    return BlockMeans(y, weight, count.astype(float))
