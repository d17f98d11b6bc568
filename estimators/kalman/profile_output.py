"""Output of road heights at stations while the filter runs.

The filter's height datum drifts, by centimetres over some ten metres, and each update moves it.
Heights that are read out one by one would have a step at every update. Each station is therefore
emitted relative to the long waves of the road about it, as estimated at the same moment:

    output(s) = E[(low * z)(s) - (long * z)(s)]

`low` is a windowed sinc (Hann) that ends at the frequency `cutoff`. `long` is the zero-phase
low-pass with the response 1 / (1 + (n / n_detrend)^4). Its kernel, with u = decay |s|,

    decay / 2 e^-u (cos u + sin u)           decay = sqrt 2 pi n_detrend

extends over all the road behind; two decaying sums carry the retired part of it (`state.py`).
"""

from dataclasses import dataclass

import numpy as np

from estimators.kalman.tuning import TUNING
from road_envs.kernels._numba import kernel

_HALF_WINDOW = TUNING.half_window / TUNING.node_spacing  # [nodes]


@dataclass(frozen=True, eq=False)
class ProfileOutput:
    """Emission schedule and emitted heights of M stations, in order.

    Schedule: node numbers `node` (M,); the number of blocks `emit_block` (M,) after which each is
    emitted; `cutoff` (2, M) [cycles/node] of the kernel `low`, for height and for variance;
    `detrended`: whether long waves are subtracted from the height (from the variance they always
    are); `both_axles`: whether the rear axle has passed a station then. Results: heights `z` [m]
    and their in-band `variance` [m²] (M, 2), left and right.
    """

    node: np.ndarray
    emit_block: np.ndarray
    cutoff: np.ndarray
    detrended: bool
    both_axles: bool
    z: np.ndarray
    variance: np.ndarray


@kernel
def _windowed_sinc(d, cutoff):
    """Return the low-pass `d` nodes from its centre; `cutoff` in cycles/node."""
    if abs(d) >= _HALF_WINDOW:
        return 0.0
    return 2.0 * cutoff * np.sinc(2.0 * cutoff * d) * np.cos(0.5 * np.pi * d / _HALF_WINDOW) ** 2


@kernel(inline=False)
def _output_weights(u, at, decay, cutoff):
    """Write the weights `u` (2 + L,) of retired-node sums and of L nodes, the oldest first, in the
    output at the position `at` from the oldest node. The road beyond the nodes counts as level
    with the nearest one. With a `decay` of 0 no long waves are subtracted.
    """
    u[:] = 0.0
    last, sum_low = u.size - 3, 0.0
    low, high = int(np.floor(at - _HALF_WINDOW)) - 1, int(np.ceil(at + _HALF_WINDOW)) + 1
    # the curve at a node is (1, 4, 1) / 6 of the coefficients
    left = _windowed_sinc(low - 1.0 - at, cutoff)
    middle = _windowed_sinc(low - at, cutoff)
    for k in range(low, high + 1):
        right = _windowed_sinc(k + 1.0 - at, cutoff)
        weight = (4.0 * middle + (left + right)) / 6.0
        u[2 + min(max(k, 0), last)] += weight
        sum_low += weight
        left, middle = middle, right
    u /= sum_low  # a level road keeps its height
    if decay == 0.0:
        return
    # exp((i - 1) decay d) at the distance d, from node to node by a product
    c, s = np.exp(-decay) * np.cos(decay), np.exp(-decay) * np.sin(decay)
    middle = min(max(int(np.floor(at)), 0), last)
    for step in (-1, 1):
        k = middle if step < 0 else middle + 1
        x = decay * abs(k - at)
        a, b = np.exp(-x) * np.cos(x), np.exp(-x) * np.sin(x)
        while 0 <= k <= last:
            u[2 + k] -= 0.5 * decay * (a + b)
            a, b = c * a - s * b, s * a + c * b
            k += step
    # the integrals of `long` over the level road ahead and over the retired nodes
    x = decay * (last + 0.5 - at)
    u[2 + last] -= 0.5 * np.exp(-x) * np.cos(x)
    x = decay * at
    u[0] = -0.5 * decay * np.exp(-x) * (np.cos(x) + np.sin(x))
    u[1] = -0.5 * decay * np.exp(-x) * (np.cos(x) - np.sin(x))


@kernel(inline=False)
def fill_weights(at, decay, cutoff, u):
    """Write the `_output_weights` of M positions `at` (M,) to `u` (M, 2 + L)."""
    for m in range(at.size):
        _output_weights(u[m], at[m], decay, cutoff[m])


def lost_noise_scale(signal_power: np.ndarray | float) -> np.ndarray | float:
    """Return the noise scale above which a filter of `signal_power` has lost the vehicle."""
    return np.maximum(TUNING.lost_noise_scale, TUNING.lost_power_share * signal_power)
