"""Measurements as means of acceleration samples over short blocks.

A block of b samples with white noise of variance sigma² each has a mean of variance sigma² / b, and
the vehicle model predicts that mean exactly. No information below the block rate is lost, and
missing, clipped or invalid samples are left out one by one.
"""

from dataclasses import dataclass

import numpy as np

MIN_NOISE_DENSITY = 1e-3  # [(m/s²)/sqrt(Hz)] below which the model's integration error dominates


@dataclass(frozen=True, eq=False)
class BlockMeans:
    """Means `y` (S, J) [m/s²] over blocks of b samples, the `sample_weight` (S, J, b) of each
    sample in the mean of its block (0 if unused) and the number of samples used, `sample_count` (S,
    J). The reading of a sample that is `censored` (S, J b), as in `block_means`, is a `limit` (S, J
    b) [m/s²]; both are None if no sample is.
    """

    y: np.ndarray
    sample_weight: np.ndarray
    sample_count: np.ndarray
    censored: np.ndarray | None = None
    limit: np.ndarray | None = None

    @property
    def n_samples(self) -> int:
        """Samples J b of each sensor, used or not."""
        return self.sample_weight.shape[1] * self.sample_weight.shape[2]

    @property
    def censored_blocks(self) -> np.ndarray:
        """1 and -1 (S, J) where the true mean of a block exceeds `y` or is below it, else 0."""
        if self.censored is None:
            return np.zeros(self.y.shape)
        return np.sign(self.censored.reshape(self.sample_weight.shape).sum(axis=2))

    def average(self, a: np.ndarray) -> np.ndarray:
        """Return the means (S, J) of other samples `a` (S, J b) with the same weights."""
        return np.einsum("sjb,sjb->sj", self.sample_weight, a.reshape(self.sample_weight.shape))

    def average_transpose(self, means: np.ndarray) -> np.ndarray:
        """Apply the transpose of `average`: from means (S, J) to samples (S, J b)."""
        return (self.sample_weight * means[:, :, None]).reshape(means.shape[0], -1)

    def residual(self, predicted: np.ndarray) -> np.ndarray:
        """Return the means (S, J) of measured less `predicted` (S, J b) samples [m/s²].

        A censored sample that is predicted beyond its limit has no residual.
        """
        residual = self.y - self.average(predicted)
        if self.censored is not None and self.limit is not None:
            beyond = self.censored * (predicted - self.limit) > 0.0
            residual -= self.average(np.where(beyond, self.limit - predicted, 0.0))
        return residual


def block_means(
    a: np.ndarray,
    valid: np.ndarray,
    block: int,
    censored: np.ndarray | None = None,
    bridged: bool = False,
) -> BlockMeans:
    """Return the means of the `valid` samples of `a` (S, T) [m/s²], over blocks of `block` samples.

    `censored` (S, T) is 1 where `a` is the upper end of the instrument's range, which the true
    value exceeds, -1 where it is the lower end, else 0. Up to `block` - 1 samples at the end fill
    no block and are left out. If `bridged`, samples that are not valid hold a value between their
    neighbours: they are in the means, but such blocks count no samples. Censored ones are then not
    valid.
    """
    J = a.shape[1] // block
    shape, a = (a.shape[0], J, block), a[:, : J * block]
    used = valid[:, : J * block]
    if bridged:
        count = block * used.reshape(shape).all(axis=2)
        y, weight = a.reshape(shape).mean(axis=2), np.full(shape, 1.0 / block)
        return BlockMeans(y, weight, count.astype(float))
    if censored is not None:
        censored = censored[:, : J * block]
        used = used | (censored != 0)
        censored = censored if censored.any() else None
    used = used.reshape(shape)
    count = used.sum(axis=2)
    weight = used / np.maximum(count, 1)[:, :, None]
    y = np.einsum("sjb,sjb->sj", weight, np.where(used, a.reshape(shape), 0.0))
    return BlockMeans(y, weight, count.astype(float), censored, None if censored is None else a)
