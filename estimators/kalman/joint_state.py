"""Compiled steps of a window: nodes enter and leave, heights are read, and the state is updated."""

import numpy as np

from estimators.kalman.filtered import BandVariance
from estimators.kalman.road_process import RoadProcess, add_node, node_entry
from estimators.kalman.state import N_SUMS, JointState, LocalState, WindowPart
from road_envs.kernels._numba import kernel


@kernel(inline=False)
def advance_nodes(
    road: RoadProcess, joint: JointState, bands: BandVariance, heights, window, nodes, scale
):
    """Add the oldest `nodes` to the `heights` of which they are a part, and replace them by new
    ones. Both are numbers from a first one to a last one (excluded). Heights of which the first
    nodes leave in this `window` begin.

    Return mean (4 + 2 M,) and rows of P (4 + 2 M, n + m) of the retired-node sums and these M nodes
    before, without the directions of the candidates that the new nodes replace.
    """
    n, columns, first_sum = joint.x.size, joint.P.shape[1], node_entry(road, 0) - N_SUMS
    count, m = nodes[1] - nodes[0], columns - n
    mean, rows = np.empty(N_SUMS + 2 * count), np.empty((N_SUMS + 2 * count, columns))
    for i in range(mean.size):
        at = first_sum + i
        if i >= N_SUMS:
            at = node_entry(road, nodes[0] + (i - N_SUMS) // 2) + i % 2
        mean[i] = joint.x[at]
        for k in range(columns):
            rows[i, k] = joint.P[at, k]
        for k in range(2 * count):
            rows[i, n + (2 * (nodes[0] + road.n_nodes) + k) % m] = 0.0
    _add_to_heights(road, joint, bands, heights, window, nodes)
    for node in range(nodes[0], nodes[1]):
        add_node(road, joint, node + road.n_nodes - 1, scale)
    return mean, rows


@kernel(inline=False)
def _add_to_heights(
    road: RoadProcess, joint: JointState, bands: BandVariance, heights, window, nodes
):
    """Add the `nodes` to the `heights`, and the retired-node sums to those of which no node has
    left before the `window`.
    """
    n, slots, first_node = joint.x.size, joint.variance.size // 2, node_entry(road, 0)
    for f in range(heights[0], heights[1]):
        row = n + 2 * (f % slots)
        if bands.times.first[f] >= window:
            for part in range(2):
                _add_pair(joint, row, first_node - N_SUMS + 2 * part, bands.weights[f, part])
        for k in range(nodes[0], nodes[1]):
            weight = bands.weights[f, 2 + k - bands.times.base[f]]
            _add_pair(joint, row, node_entry(road, k), weight)


@kernel
def _add_pair(joint: JointState, row, at, weight):
    """Add a node's or a sum's mean and half difference, the entry `at` and the next one, times the
    `weight` to the heights of the `row` and the next one.
    """
    P, n = joint.P, joint.x.size
    for side in range(2):
        sign, height = 1.0 - 2.0 * side, row + side
        own = P[at, at] + P[at + 1, at + 1] + 2.0 * sign * P[at, at + 1]
        both = P[height, at] + sign * P[height, at + 1]
        joint.variance[height - n] += weight * (2.0 * both + weight * own)
        for i in range(P.shape[1]):
            P[height, i] += weight * (P[at, i] + sign * P[at + 1, i])


@kernel
def _is_read(times, f, last):
    """Return whether the moment `f` is one before the block `last`, or the drive's end."""
    return f < times.block.size and (times.block[f] < last or last == times.n_blocks)


@kernel(inline=False)
def read_nodes(
    road: RoadProcess, joint: JointState, part: WindowPart, local: LocalState, P_local, nodes, last
):
    """Write the sums and nodes held at the moments of a part of a window up to the block `last` to
    `nodes` (NodesAtEmission). Of the first moment, the number is `part.moments[0]`.
    """
    n, size, oldest = joint.x.size, local.x.size, part.oldest
    first_sum = node_entry(road, 0) - N_SUMS
    while _is_read(nodes.times, part.moments[0], last):
        f = part.moments[0]
        part.moments[0] += 1
        rows, base, x = 3 * (nodes.times.block[f] - part.first), nodes.times.base[f], joint.x.copy()
        adjoint = nodes.adjoint[f]
        for r in range(rows):
            for i in range(size):
                adjoint[i] += local.innovation[r] * local.U[r, i]
        if rows > 0:
            for i in range(size):
                for k in range(n):
                    x[k] += adjoint[i] * P_local[i, k]
        for c in range(2):
            for k in range(oldest, oldest + road.n_nodes):
                nodes.c[f, 2 + k - base, c] = x[node_entry(road, k) + c]
            if base == oldest:
                nodes.c[f, 0, c], nodes.c[f, 1, c] = x[first_sum + c], x[first_sum + 2 + c]


@kernel(inline=False)
def read_heights(
    road: RoadProcess, joint: JointState, part: WindowPart, local: LocalState, bands, last
):
    """Write the variance of the heights that are read in a part of a window up to the block `last`
    to `bands` (BandVariance). Of the first of them, the number is `part.moments[1]`.
    """
    n, slots = joint.x.size, joint.variance.size // 2
    held = part.oldest, part.oldest + road.n_nodes
    while _is_read(bands.times, part.moments[1], last):
        f = part.moments[1]
        part.moments[1] += 1
        _add_to_heights(road, joint, bands, (f, f + 1), part.number + 1, held)
        for side in range(2):
            height = 2 * (f % slots) + side
            variance = joint.variance[height]
            for r in range(3 * (bands.times.block[f] - part.first)):
                known = 0.0
                for i in range(part.local.size):
                    known += local.U[r, i] * joint.P[n + height, part.local[i]]
                variance -= known**2
            bands.variance[f, side] = variance
            for k in range(n):
                if bands.covariance.shape[0] > 0:
                    bands.covariance[f, side, k] = joint.P[n + height, k]
            # what is no longer read would decay to denormals
            joint.P[n + height], joint.variance[height] = 0.0, 0.0


@kernel(inline=False)
def update_state(joint: JointState, part: WindowPart, local: LocalState, P_local, n_vehicle, rows):
    """Update `joint` by the first innovations of a window, so many `rows` R, but for
    P -= V' `W`, which is left to BLAS. Return V (R, n + 2 S) and W (R, n + m), the covariances of
    the innovations with the rows and columns of P, 0 for the vehicle.
    """
    x, P, n, size = joint.x, joint.P, joint.x.size, local.x.size
    U, heights = local.U[:rows], np.empty((P.shape[0] - n, size))
    for height in range(heights.shape[0]):
        for i in range(size):
            heights[height, i] = P[n + height, part.local[i]]
    W, of_heights, V = np.dot(U, P_local), np.dot(U, heights.T), np.empty((rows, P.shape[0]))
    for r in range(rows):
        for k in range(n):
            x[k] += local.innovation[r] * W[r, k]
            V[r, k] = W[r, k]
        for height in range(heights.shape[0]):
            V[r, n + height] = of_heights[r, height]
            joint.variance[height] -= of_heights[r, height] ** 2
        for k in range(n_vehicle):
            V[r, k] = W[r, k] = 0.0
    transition = local.rows[:n_vehicle, size:].copy()
    moved, moved_heights = np.dot(transition, P_local), np.dot(heights, transition.T)
    for i in range(n_vehicle):
        for k in range(n_vehicle):
            moved[i, k] = local.rows[i, k]
        for k in range(P.shape[1]):
            P[i, k] = moved[i, k]
        for k in range(n):
            P[k, i] = moved[i, k]
        for height in range(heights.shape[0]):
            P[n + height, i] = moved_heights[height, i]
    for i in range(size):
        x[part.local[i]] = local.x[i]
    return V, W
