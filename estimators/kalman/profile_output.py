"""Output of road heights at stations while the filter runs.

The filter's height datum drifts, by centimetres over some ten metres, and each update moves it.
Heights that are read out one by one would have a step at every update. Each station is therefore
emitted relative to the long waves of the road about it, as estimated at the same moment:

    output(s) = E[(low * z)(s) - (long * z)(s)]

`low` is a windowed sinc (Hann) that ends at the frequency `cutoff`. `long` is the zero-phase
low-pass with the response 1 / (1 + (n / N_DETREND)^4). Its kernel, with u = decay |s|,

    decay / 2 e^-u (cos u + sin u)           decay = sqrt 2 pi N_DETREND

extends over all the road behind; two decaying sums carry the retired part of it (`state.py`).
"""

from typing import NamedTuple

import numpy as np

from estimators.kalman.state import (
    NODES,
    NOISE_SCALE,
    RETIRED,
    SIGNAL_POWER,
    FilterModel,
    FilterState,
)
from road_envs._numba import kernel

N_DETREND = 0.1
"""Spatial frequency [cycles/m] at which half the height is emitted; the scored band begins at 0.2.
"""

HALF_WINDOW = 1.0
"""Half length [m] of the kernel `low`."""


VARIANCE_STRIDE = 8
"""Stations from one whose variance is computed to the next."""

LOST_NOISE_SCALE, LOST_POWER_SHARE = 20.0, 0.05
"""Noise scale, a mean of the normalized innovation squared over the last second, above which the
filter has lost the vehicle, if the noise also exceeds this share of the measurements' power.
Heights are then emitted reduced, and the roughness is no longer adapted to them."""

EARLY_NOISE_SCALE = 8.0
"""Noise scale above which heights are reduced that are emitted before the rear axle has passed: of
a vehicle that is not the one described they are worth nothing."""


class ProfileOutput(NamedTuple):
    """Emission schedule and emitted heights of M stations, in order.

    Schedule: node numbers `node` (M,); the block `emit_block` (M,) before which each is emitted;
    `cutoff` (M, 2) [cycles/node] of the kernel `low`, for height and for variance; its half length
    `half_window` [nodes]; `both_axles`: whether the rear axle has passed it then; `detrended`:
    whether long waves are subtracted from the height (from the variance they always are). Results:
    heights `z` [m] and their in-band `variance` [m²] (M, 2), left and right;
    `share` (M,), 0 to 1, by how much they are to be trusted; `next_station` (1,), the first not yet
    emitted.

    For the smoother, else of length 0: the covariance of the emitted heights with the state,
    `height_covariance` (M, 2, n), and of their in-band part, `band_covariance` (M /
    VARIANCE_STRIDE, 2, n).
    """

    node: np.ndarray
    emit_block: np.ndarray
    cutoff: np.ndarray
    half_window: float
    detrended: bool
    both_axles: bool
    z: np.ndarray
    variance: np.ndarray
    share: np.ndarray
    next_station: np.ndarray
    height_covariance: np.ndarray
    band_covariance: np.ndarray


def decay_per_node(ds: float) -> float:
    """Return the decay of the retired-node sums per node, for nodes `ds` [m] apart."""
    return float(np.sqrt(2.0) * np.pi * N_DETREND * ds)


@kernel
def sinc(x):
    """Return sin(pi x) / (pi x)."""
    return 1.0 if abs(x) < 1e-9 else np.sin(np.pi * x) / (np.pi * x)


@kernel
def windowed_sinc(d, cutoff, half_window):
    """Return the low-pass at `d` nodes from its centre, of `cutoff` [cycles/node] and
    `half_window`.
    """
    if abs(d) >= half_window:
        return 0.0
    return 2.0 * cutoff * sinc(2.0 * cutoff * d) * np.cos(0.5 * np.pi * d / half_window) ** 2


@kernel
def spline_low_pass(d, cutoff, half_window):
    """Return the low-pass of the curve, which at a node is (1, 4, 1) / 6 of its coefficients."""
    left = windowed_sinc(d - 1.0, cutoff, half_window)
    right = windowed_sinc(d + 1.0, cutoff, half_window)
    return (4.0 * windowed_sinc(d, cutoff, half_window) + (left + right)) / 6.0


@kernel(inline=False)
def output_weights(u, at, newest_node, decay, cutoff, half_window):
    """Write the weights `u` (2 + K,) of retired-node sums and nodes in the output at a node number
    `at`.

    The road beyond the nodes counts as level with the nearest one. With a `decay` of 0 no long
    waves are subtracted.
    """
    u[:] = 0.0
    K = u.size - 2
    oldest, sum_low = newest_node - K + 1, 0.0
    low, high = int(np.floor(at - half_window)) - 1, int(np.ceil(at + half_window)) + 1
    for k in range(low, high + 1):
        weight = spline_low_pass(k - at, cutoff, half_window)
        u[2 + min(max(k, oldest), newest_node) % K] += weight
        sum_low += weight
    u /= sum_low  # a level road keeps its height
    if decay == 0.0:
        return
    for k in range(oldest, newest_node + 1):
        x = decay * abs(k - at)
        u[2 + k % K] -= 0.5 * decay * np.exp(-x) * (np.cos(x) + np.sin(x))
    # the integrals of `long` over the level road ahead and over the retired nodes
    x = decay * (newest_node + 0.5 - at)
    u[2 + newest_node % K] -= 0.5 * np.exp(-x) * np.cos(x)
    x = decay * (at - oldest)
    u[0] = -0.5 * decay * np.exp(-x) * (np.cos(x) + np.sin(x))
    u[1] = -0.5 * decay * np.exp(-x) * (np.cos(x) - np.sin(x))


@kernel(inline=False)
def read_out(x, u, component):
    """Return the weighted sum of the entries of `x` (n,) of a component (0 mean, 1 half
    difference).
    """
    z = u[0] * x[RETIRED + 2 * component] + u[1] * x[RETIRED + 2 * component + 1]
    for k in range(u.size - 2):
        z += u[2 + k] * x[NODES + 2 * k + component]
    return z


@kernel(inline=False)
def covariance_row(state: FilterState, u, component, out):
    """Write the weighted sum of rows of the covariance of a component (0 mean, 1 half difference)
    to `out` (n,).
    """
    P = state.P
    out[:] = u[0] * P[RETIRED + 2 * component] + u[1] * P[RETIRED + 2 * component + 1]
    for k in range(u.size - 2):
        if u[2 + k] != 0.0:
            out += u[2 + k] * P[NODES + 2 * k + component]
    for r in range(state.n_pending[0]):
        out -= read_out(state.pending[r], u, component) * state.pending[r]


@kernel(inline=False)
def covariance_rows(state: FilterState, u, out):
    """Write the weighted sums of rows of the covariance for the left and right wheel path to `out`
    (2, n).
    """
    mean, difference = np.empty(state.x.size), np.empty(state.x.size)
    covariance_row(state, u, 0, mean)
    covariance_row(state, u, 1, difference)
    out[0] = mean + difference
    out[1] = mean - difference


@kernel
def lost_noise_scale(adaptive):
    """Return the noise scale above which the filter, with `adaptive` (5,), has lost the vehicle."""
    return max(LOST_NOISE_SCALE, LOST_POWER_SHARE * adaptive[SIGNAL_POWER])


@kernel(inline=False)
def emit(model: FilterModel, state: FilterState, output: ProfileOutput, j):
    """Emit all stations that are due before the block `j`."""
    n, newest_node, next_station = state.x.size, state.newest_node[0], output.next_station
    if next_station[0] == output.node.size or output.emit_block[next_station[0]] > j:
        return
    u, rows = np.empty(2 + model.n_nodes), np.empty((2, n))
    decay = model.decay if output.detrended else 0.0
    while next_station[0] < output.node.size and output.emit_block[next_station[0]] <= j:
        m = next_station[0]
        # a station that no wheel has passed is given the height of the nearest node
        at = min(max(output.node[m], float(newest_node - u.size + 3)), float(newest_node))
        output_weights(u, at, newest_node, decay, output.cutoff[m, 0], output.half_window)
        z, d = read_out(state.x, u, 0), read_out(state.x, u, 1)
        output.z[m, 0], output.z[m, 1] = z + d, z - d
        lost = lost_noise_scale(state.adaptive) if output.both_axles else EARLY_NOISE_SCALE
        output.share[m] = min(1.0, lost / state.adaptive[NOISE_SCALE]) ** 2
        if output.height_covariance.shape[0] > 0:
            covariance_rows(state, u, output.height_covariance[m])
        if m % VARIANCE_STRIDE == 0:
            output_weights(u, at, newest_node, model.decay, output.cutoff[m, 1], output.half_window)
            covariance_rows(state, u, rows)
            for side in range(2):
                z, d = read_out(rows[side], u, 0), read_out(rows[side], u, 1)
                output.variance[m, side] = z + (1.0 - 2.0 * side) * d
            if output.band_covariance.shape[0] > 0:
                output.band_covariance[m // VARIANCE_STRIDE] = rows
        else:
            output.variance[m] = output.variance[m - 1]
        next_station[0] += 1
