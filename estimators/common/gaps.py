"""Stretches of a road over which no sensor was read.

A logger pauses, a phone that moved in its mount is turned upright in parts: what lies between is
not known, however smooth an estimate is there.
"""

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_opening, gaussian_filter1d

from estimators.common.explained import mark_unsure
from road_envs.records.record import PROFILE_SPACING, Estimate, Record

_LEAST = 0.1  # shortest gap [s]: a period of the axles, over which the vehicle tells what it was


def read_share(at: np.ndarray, s: np.ndarray, read: np.ndarray, wheelbase: float) -> np.ndarray:
    """Return the share (M,) of what was read while either axle passed the stations `at` (M,) [m].

    `read` (N,) is that when the front axle was at the stations `s` (N,) [m].
    """
    front, rear = (np.interp(at + behind, s, read) for behind in (0.0, wheelbase))
    return np.maximum(front, rear)


def unread_stations(at: np.ndarray, record: Record, wheelbase: float = 0.0) -> np.ndarray:
    """Return which stations `at` (M,) [m] both axles passed while no sensor was read; the front
    axle alone without a `wheelbase` [m].
    """
    steps = np.diff(record.t)
    interval = float(np.median(steps))
    lost = ~np.isfinite(record.a).any(axis=0)
    lost = binary_opening(lost, np.ones(max(1, round(_LEAST / interval))))
    jump = steps > max(_LEAST, 1.5 * interval)  # samples that are not in the record at all
    lost[:-1] |= jump
    lost[1:] |= jump
    known = np.isfinite(record.s)
    return read_share(at, record.s[known], (~lost[known]).astype(float), wheelbase) < 0.5


def mark_gaps(estimate: Estimate, record: Record, wheelbase: float) -> Estimate:
    """Return `estimate` with the stations that both axles passed while no sensor was read marked as
    `unsure`, in the first note and by a `z_std` of the level of the other heights at least.
    """
    gaps = unread_stations(estimate.s, record, wheelbase)
    if not gaps.any():
        return estimate
    z_std = estimate.z_std
    if z_std is not None and not gaps.all():
        short = estimate.z - gaussian_filter1d(estimate.z, 1.0 / PROFILE_SPACING, axis=1)
        level = np.sqrt((short[:, ~gaps] ** 2).mean(axis=1, keepdims=True))
        z_std = np.where(gaps, np.maximum(z_std, level), z_std)
    first, last = estimate.s[np.flatnonzero(gaps)[[0, -1]]]
    note = (
        f"no sensor was read over {PROFILE_SPACING * gaps.sum():.0f} m of the road between "
        f"{first:.0f} and {last:.0f} m: heights there are not known"
    )
    return mark_unsure(replace(estimate, z_std=z_std), gaps, note)
