"""Measurements as means of acceleration samples over short blocks.

A block of b samples with white noise of variance sigma² each has a mean of variance sigma² / b, and
the vehicle model predicts that mean exactly. No information below the block rate is lost, and
missing, clipped or invalid samples are left out one by one.
"""

from dataclasses import dataclass

import numpy as np

from road_envs.data.record import Record
from road_envs.sensing.instruments import Instruments

CLIP_THRESHOLD = 0.98
"""Share of the sensor's range from which on a sample counts as clipped."""

REQUIRED_BANDWIDTH = 25.0
"""Bandwidth [Hz] that the accelerations must at least hold: that of the scored band."""

MIN_NOISE_DENSITY = 1e-3
"""Noise density [(m/s²)/sqrt(Hz)] below which the integration error of the model dominates."""

ANTIALIAS_SPREAD = 3
"""Samples to either side of an invalid one that the anti-alias filter mixes with it."""


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


def block_means(a: np.ndarray, used: np.ndarray, block: int) -> BlockMeans:
    """Return the means of the samples `a` (S, T) [m/s²] that are `valid` (S, T), over blocks of
    `block`.

    Up to `block` - 1 samples at the end fill no block and are left out.
    """
    J = a.shape[1] // block
    shape = (a.shape[0], J, block)
    kept = used[:, : J * block].reshape(shape)
    count = kept.sum(axis=2)
    share = kept / np.maximum(count, 1)[:, :, None]
    y = np.einsum("sjb,sjb->sj", share, np.where(kept, a[:, : J * block].reshape(shape), 0.0))
    return BlockMeans(y, share, count.astype(float))


def valid_samples(record: Record, instruments: Instruments) -> np.ndarray:
    """Return which samples (S, T) are finite and neither clipped nor near a clipped or missing one."""
    false = ~np.isfinite(record.a)
    false |= np.abs(np.nan_to_num(record.a)) >= CLIP_THRESHOLD * instruments.range
    wide = false.copy()
    for k in range(1, ANTIALIAS_SPREAD + 1):
        wide[:, k:] |= false[:, :-k]
        wide[:, :-k] |= false[:, k:]
    return ~wide


def to_uniform_clock(record: Record) -> tuple[Record, list[str]]:
    """Return the record on a uniform clock, NaN where samples are missing, and a note if it
    changed.
    """
    steps = np.diff(record.t)
    dt = float(np.median(steps))
    if np.abs(steps - dt).max() <= JITTER * dt:
        return record, []
    t = record.t[0] + dt * np.arange(round((record.t[-1] - record.t[0]) / dt) + 1)
    place = np.round((record.t - record.t[0]) / dt).astype(int)
    a = np.full((record.a.shape[0], t.size), np.nan)
    a[:, place] = record.a
    last = np.clip(np.searchsorted(record.t, t + 0.5 * dt) - 1, 0, record.t.size - 1)
    v, s = (np.interp(t, record.t, x) for x in (record.v, record.s))
    even = Record(t, a, v, s, record.spring_stiff[last], record.damper_high[last], record.length)
    return even, [f"the clock is uneven; {t.size - np.unique(place).size} samples were dropped"]


JITTER = 0.01
"""Relative deviation of a clock step from the median above which the clock counts as uneven."""

MIN_DURATION = 1.0
"""Least duration [s] of a record."""

MIN_MEAN_SPEED = 0.1
"""Mean speed [m/s] below which the vehicle counts as standing."""


def validate_record(record: Record) -> None:
    """Raise ValueError unless the record can be that of a drive which these estimators can use."""
    if record.t.size < 2 or not record.t[-1] - record.t[0] >= MIN_DURATION:
        raise ValueError(
            f"the record is shorter than {MIN_DURATION:g} s: too short for the car to be heard"
        )
    for name in ("t", "v", "s"):
        if not np.isfinite(getattr(record, name)).all():
            raise ValueError(f"the record's {name} must be finite all along")
    if not (np.diff(record.t) > 0.0).all():
        raise ValueError("the record's clock must go on from sample to sample")
    for name in ("spring_stiff", "damper_high"):
        states = np.asarray(getattr(record, name))
        if states.shape != (record.t.size, 4) or not np.isin(states, (0, 1)).all():
            raise ValueError(
                f"'{name}' must say of each of 4 struts, at each sample, true or false"
            )
    if (record.v < 0.0).any() or (np.diff(record.s) < 0.0).any():
        raise ValueError("the record drives backwards: v must not be negative nor s decrease")
    if not record.v.mean() >= MIN_MEAN_SPEED:
        raise ValueError(f"the car stands (mean speed {record.v.mean():.2g} m/s): no road is heard")
    if record.fs < 2.0 * REQUIRED_BANDWIDTH:
        raise ValueError(
            f"sampled at {record.fs:g} Hz; at least {2.0 * REQUIRED_BANDWIDTH:g} Hz are wanted to "
            f"hear {REQUIRED_BANDWIDTH:g} Hz"
        )
    if not np.isfinite(record.a).any():
        raise ValueError("the record has no finite acceleration")
