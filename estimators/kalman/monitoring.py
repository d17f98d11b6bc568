"""Consistency of the innovations along the road, and heights reduced by their own uncertainty.

On the filter's own model the normalized innovation squared (NIS) is 1 in the mean. Where it is
larger, on an obstacle that the prior did not expect or where wheels lift off, so is the error: the
variance of a height is multiplied by the NIS of the metres in which both axles passed it (the Birge
ratio; Bar-Shalom, Li & Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, section 5.4). A height is then multiplied by q / (q + variance), with q the mean square of the
heights about it: what is no larger than its own error is emitted as a level road.
"""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import convolve

from estimators.kalman.tuning import TUNING
from road_envs.records.record import PROFILE_SPACING
from road_envs.vehicle.parameters import VehicleParameters


def obstacle_std(square: np.ndarray, nodes: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return the standard deviation (2, M) [m] by which heights near obstacles err in addition.

    `square` (N, 2) [m²] of the accepted steps at the stations `nodes` (N,) [m]: an obstacle's
    height is found by laws that are linear about the road without it.
    """
    total = np.cumsum(np.vstack([np.zeros(2), square]), axis=0)
    reach = TUNING.obstacle_reach
    first, last = (np.searchsorted(nodes, s + side) for side in (-reach, reach))
    return TUNING.obstacle_error * np.sqrt(np.maximum(total[last] - total[first], 0.0)).T


def local_nis(nis: np.ndarray, front: np.ndarray, s: np.ndarray, lag: float) -> np.ndarray:
    """Return the greatest local mean (M,) of the `nis` (J,), 1 at least, that counts for `s` (M,).

    `front` (J,) [m]: the front axle's station when a block is known. Of blocks that are known when
    the front axle is `lag` [m] past the station.
    """
    origin = min(front[0], s[0]) - 1.0
    cell = ((front - origin) / TUNING.nis_cell).astype(int)
    size = max(cell.max(), int((s[-1] - origin) / TUNING.nis_cell)) + 2
    count = np.bincount(cell, minlength=size)
    mean = np.bincount(cell, nis, size) / np.maximum(count, 1)
    ahead = min(TUNING.nis_ahead, lag - TUNING.nis_cell)
    behind = TUNING.nis_behind + TUNING.nis_cell * (ahead < 0.0)
    low = ((s - behind - origin) / TUNING.nis_cell).astype(int)
    high = np.floor((s + ahead - origin) / TUNING.nis_cell).astype(int)
    width = int(np.max(high - low)) + 1
    windows = np.minimum(np.maximum(low, 0)[:, None] + np.arange(width), high[:, None])
    return np.maximum(mean[np.clip(windows, 0, size - 1)].max(axis=1), 1.0)


def recent_nis(nis: np.ndarray, front: np.ndarray, length: float) -> np.ndarray:
    """Return the mean (J,) of the `nis` (J,) over the last `length` [m] of the front axle, which
    has the station `front` (J,) [m] at each block; over `min_blocks`, at least.
    """
    total, last = np.cumsum(np.append(0.0, nis)), np.arange(1, nis.size + 1)
    first = np.minimum(np.searchsorted(front, front - length), last - TUNING.min_blocks)
    first = np.maximum(first, 0)
    return (total[last] - total[first]) / (last - first)


def with_model_error(
    z_std: np.ndarray, z: np.ndarray, acceleration: np.ndarray, car: VehicleParameters
) -> np.ndarray:
    """Return standard deviations `z_std` (2, M) of heights `z` (2, M) [m] with the errors that no
    innovation shows, since another road explains the readings as well.

    The laws are linearized about a motion, the less well the greater the latest `acceleration` (M,)
    [m/s²]; and a `car` within its tolerances answers with other heights, in proportion to those of
    the metres behind.
    """
    linearized = z_std * np.hypot(1.0, acceleration / TUNING.linear_acceleration)
    total = np.cumsum(z**2, axis=1)
    width = round(TUNING.tolerance_length / PROFILE_SPACING)
    before = np.pad(total, ((0, 0), (width, 0)))[:, : z.shape[1]]
    mean = (total - before) / np.minimum(np.arange(1, z.shape[1] + 1), width)
    stated = [one.relative for one in car.tolerances.values() if one.about is None]
    share = TUNING.tolerance_error * float(np.median(stated or [0.0]))
    return np.hypot(linearized, share * np.sqrt(np.maximum(mean, 0.0)))


def long_waves(z: np.ndarray) -> np.ndarray:
    """Return the waves (2, M) of heights `z` (2, M) [m] that are longer than the scored band."""
    return gaussian_filter1d(z, TUNING.detrend_length / PROFILE_SPACING, axis=1)


def reduce_uncertain(
    z: np.ndarray, z_std: np.ndarray, ahead: float, *, drifting: bool
) -> np.ndarray:
    """Return heights `z` (2, M) [m] times q / (q + `z_std`² (2, M)).

    q is the mean square over `power_window` behind and `ahead` [m] of each station. Of `drifting`
    heights the waves that are longer than the scored band are left as they are.
    """
    long = long_waves(z) if drifting else np.zeros_like(z)
    width = round(TUNING.power_window / PROFILE_SPACING)
    kernel = np.ones(2 * width + 1)
    kernel[: width - round(ahead / PROFILE_SPACING)] = 0.0
    ones = convolve(np.ones(z.shape[1]), kernel, "same", "direct")
    q, variance = (
        np.array([convolve(path**2, kernel, "same", "direct") for path in x]) / ones
        for x in (z - long, z_std)
    )
    return long + (z - long) * q / np.maximum(q + variance, 1e-300)


def reduce_slope(long: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return long waves (2, M) [m] whose slope is multiplied by a `share` (M,), 0 to 1.

    A filter that has lost the vehicle drifts by metres; reducing the drift itself would make a step
    of it where the share is 1 again.
    """
    if (share >= 1.0).all():
        return long
    return long[:, :1] + np.cumsum(share * np.diff(long, axis=1, prepend=long[:, :1]), axis=1)
