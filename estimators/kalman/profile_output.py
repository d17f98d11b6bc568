"""Heights told while the drive goes on.

The filter knows heights about a datum that drifts, by centimetres over some ten metres, and from
telling to telling it learns where the datum was: each correction would stand as a step in a road
put together from such heights. So a station is told as what the road is there about its long waves,
and these are taken from what is held for true of the whole road at that moment,

    told(s) = E[(low * z)(s) - (long * z)(s)]

`low` is a windowed sinc (Hann) that ends at a frequency `top`; `long` the zero-phase low-pass with
the response 1 / (1 + (n / N_LONG)^4), whose kernel, with u = fade |s|,

    fade / 2 e^-u (cos u + sin u)           fade = sqrt 2 pi N_LONG

goes back over all the road by a sum of two numbers that fade (`state.py`).
"""

from typing import NamedTuple

import numpy as np

from estimators.kalman.state import FADING, NODES, Model, State
from road_envs._numba import kernel, separate

N_LONG = 0.1
"""Waves [cycles/m] at which half the height is told; the judged band begins at 0.2."""

WINDOW = 1.0
"""Half length [m] of `low`."""


EVERY = 8
"""Stations from one whose deviation is computed to the next."""


class Tells(NamedTuple):
    """What is told of M stations, in order.

    Node numbers `at` (M,); the block `due` (M,) before which each is told; `top` (M, 2)
    [cycles/node], where height and deviation end; `half` [nodes] the window; `about`: whether long
    waves are taken off the height. Told are heights `z` and the `variance` (M, 2) in the judged
    band, left and right; the `next` (1,) is the first not yet told. What hearing more will change:
    the covariance with all that is held of the heights, `rows` (M, 2, n), and of the band's part,
    `band` (M / EVERY, 2, n); both are of no length if nobody asks.
    """

    at: np.ndarray
    due: np.ndarray
    top: np.ndarray
    half: float
    about: bool
    z: np.ndarray
    variance: np.ndarray
    next: np.ndarray
    rows: np.ndarray
    band: np.ndarray


def fade(ds: float) -> float:
    """Decay of the fading sums per node, with nodes `ds` [m] apart."""
    return float(np.sqrt(2.0) * np.pi * N_LONG * ds)


@kernel
def sinc(x):
    """sin(pi x) / (pi x)."""
    return 1.0 if abs(x) < 1e-9 else np.sin(np.pi * x) / (np.pi * x)


@kernel
def windowed(d, top, half):
    """The low-pass at `d` nodes from its middle; it ends at `top` cycles/node and `half` nodes."""
    if abs(d) >= half:
        return 0.0
    return 2.0 * top * sinc(2.0 * top * d) * np.cos(0.5 * np.pi * d / half) ** 2


@kernel
def low_pass(d, top, half):
    """The same of the curve that the coefficients carry, whose value at a node is (1, 4, 1) / 6."""
    sides = windowed(d - 1.0, top, half) + windowed(d + 1.0, top, half)
    return (4.0 * windowed(d, top, half) + sides) / 6.0


@separate
def weigh(u, at, newest, fade, top, half):
    """Shares `u` (2 + K,) of fading sums and nodes in what is told at the node number `at`.

    What lies beyond the nodes counts as level with the nearest. Without `fade` nothing is taken
    off.
    """
    u[:] = 0.0
    K = u.size - 2
    oldest, sum_low = newest - K + 1, 0.0
    low, high = int(np.floor(at - half)) - 1, int(np.ceil(at + half)) + 1
    for k in range(low, high + 1):
        share = low_pass(k - at, top, half)
        u[2 + min(max(k, oldest), newest) % K] += share
        sum_low += share
    u /= sum_low
    if fade == 0.0:
        return
    for k in range(oldest, newest + 1):
        x = fade * abs(k - at)
        u[2 + k % K] -= 0.5 * fade * np.exp(-x) * (np.cos(x) + np.sin(x))
    x = fade * (newest + 0.5 - at)
    u[2 + newest % K] -= 0.5 * np.exp(-x) * np.cos(x)
    x = fade * (at - oldest)
    u[0] = -0.5 * fade * np.exp(-x) * (np.cos(x) + np.sin(x))
    u[1] = -0.5 * fade * np.exp(-x) * (np.cos(x) - np.sin(x))


@separate
def gather(P, u, part, out):
    """Rows of `P` (n, n) of mean or half difference, with the weights `u`, to `out` (n,)."""
    out[:] = u[0] * P[FADING + 2 * part] + u[1] * P[FADING + 2 * part + 1]
    for k in range(u.size - 2):
        if u[2 + k] != 0.0:
            out += u[2 + k] * P[NODES + 2 * k + part]


@separate
def told(x, u, part):
    """The sum of the vector `x` (n,) with the weights `u` of mean or half difference."""
    z = u[0] * x[FADING + 2 * part] + u[1] * x[FADING + 2 * part + 1]
    for k in range(u.size - 2):
        z += u[2 + k] * x[NODES + 2 * k + part]
    return z


@separate
def gather_sides(P, u, out):
    """Rows (2, n) of `P` (n, n) of the left and the right wheel path, with the weights `u`."""
    mean, half = np.empty(P.shape[0]), np.empty(P.shape[0])
    gather(P, u, 0, mean)
    gather(P, u, 1, half)
    out[0] = mean + half
    out[1] = mean - half


@separate
def tell(model: Model, state: State, tells: Tells, j):
    """Tell the stations whose time has come before the block `j`."""
    n = state.x.size
    u, rows = np.empty(2 + (n - NODES) // 2), np.empty((2, n))
    while tells.next[0] < tells.at.size and tells.due[tells.next[0]] <= j:
        m, newest = tells.next[0], state.newest[0]
        at = min(max(tells.at[m], float(newest - u.size + 3)), float(newest))
        weigh(u, at, newest, model.fade if tells.about else 0.0, tells.top[m, 0], tells.half)
        z, d = told(state.x, u, 0), told(state.x, u, 1)
        tells.z[m, 0], tells.z[m, 1] = z + d, z - d
        if tells.rows.shape[0] > 0:
            gather_sides(state.P, u, tells.rows[m])
        if m % EVERY == 0:
            weigh(u, at, newest, model.fade, tells.top[m, 1], tells.half)
            gather_sides(state.P, u, rows)
            for side in range(2):
                sign = 1.0 - 2.0 * side
                tells.variance[m, side] = told(rows[side], u, 0) + sign * told(rows[side], u, 1)
            if tells.band.shape[0] > 0:
                tells.band[m // EVERY] = rows
        else:
            tells.variance[m] = tells.variance[m - 1]
        tells.next[0] += 1
