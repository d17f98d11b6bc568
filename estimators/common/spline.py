"""Both wheel paths as cubic B-splines, and their heights under the wheels of a moving vehicle.

    z(s) = sum_k c_k B((s - s_0) / ds - k)          B: the uniform cubic B-spline, of width 4

The coefficients `c` (2, K) belong to even nodes; slope and curvature are continuous. Stations are
node numbers x = (s - s_0) / ds, from the second node to the last but two.
"""

import numpy as np

from road_envs.kernels._numba import kernel


@kernel
def locate_node(x, size):
    """Return the node before `x` and the fraction of the way to the next node."""
    x = min(max(x, 1.0), size - 2.001)  # a height needs one node before and two behind
    i = int(x)
    return i, x - i


@kernel
def height_weights(t):
    """Return the weights of the four nodes about the fraction `t` in the height."""
    r = 1.0 - t
    inner, outer = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0, t * t * t / 6.0
    return r * r * r / 6.0, inner, 1.0 - inner - outer - r * r * r / 6.0, outer


@kernel
def slope_weights(t):
    """Return the weights of the four nodes about the fraction `t` in the slope per node."""
    r = 1.0 - t
    return -0.5 * r * r, t * (1.5 * t - 2.0), r * (2.0 - 1.5 * r), 0.5 * t * t


@kernel
def sample_under_wheels(c, x, node_rate, wheelbase_nodes, out):
    """Write heights and their rates under FL, FR, RL, RR at each of M instants to `out` (M, 2, 4).

    `x` (M,): node number of the front axle, `wheelbase_nodes` ahead of the rear one; `node_rate`
    (M,) [nodes/s].
    """
    for m in range(x.size):
        for axle in range(2):
            i, t = locate_node(x[m] - axle * wheelbase_nodes, c.shape[1])
            a0, a1, a2, a3 = height_weights(t)
            b0, b1, b2, b3 = slope_weights(t)
            for side in range(2):
                c0, c1, c2, c3 = c[side, i - 1], c[side, i], c[side, i + 1], c[side, i + 2]
                out[m, 0, 2 * axle + side] = a0 * c0 + a1 * c1 + a2 * c2 + a3 * c3
                out[m, 1, 2 * axle + side] = (b0 * c0 + b1 * c1 + b2 * c2 + b3 * c3) * node_rate[m]


def evaluate_spline(c: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the heights (2, M) [m] of coefficients `c` (2, K) at node numbers `x` (M,)."""
    road = np.empty((x.size, 2, 4))
    sample_under_wheels(c, np.ascontiguousarray(x, dtype=float), np.zeros(x.size), 0.0, road)
    return road[:, 0, :2].T.copy()
