"""Steps of the road that its stationary prior does not expect: edges of obstacles.

The increments of the road are Gaussian but for a few, whose variance is larger by JUMP_STD². Which
ones is decided by the log likelihood ratio of the innovations (generalized likelihood ratio test:
Willsky & Jones, IEEE Trans. Automatic Control 21, 1976, doi:10.1109/TAC.1976.1101146). Each recent
node of each wheel path is a candidate. Had it a step b, the state would err by the `direction` f
times b and the whitened innovation e would have the mean g b with g = H f, so

    score l = sum g' e     information C = sum g' g     b ~ N(v l, v), v = 1 / (C + 1 / JUMP_STD²)

is exact for the linearized vehicle (Friedland, IEEE Trans. Automatic Control 14, 1969,
doi:10.1109/TAC.1969.1099223), and the log likelihood ratio of a step to none is

    (v l² - log(JUMP_STD² / v)) / 2

The most likely candidate enters the state, as if its increment had had that variance from the
beginning, and the others are conditioned on it, until none exceeds MIN_LOG_RATIO.
"""

import numpy as np

from estimators.kalman.state import (
    BIAS,
    NOISE_SCALE,
    FilterModel,
    FilterState,
    LinearizedBlock,
    RoadJumps,
)
from road_envs._numba import kernel

JUMP_LENGTH = 0.3
"""Length [m] of road behind the newest node on which nodes are candidates."""

JUMP_STD = 0.04
"""Prior standard deviation [m] of a step: edges of bumps and potholes of 25 to 100 mm, over one to
three nodes."""

MIN_LOG_RATIO = 8.0
"""Log likelihood ratio, in units of the noise scale, above which a step is accepted: the prior odds
against one at a node. On a vehicle that is not the one described, much is unexplained that is no
obstacle."""

MIN_INFORMATION = 10.0
"""Information of the innovations on a step, relative to its prior's, below which it is not yet
accepted: the step of a node that the wheel has hardly reached would be taken far too high."""

RELATIVE_ERROR = 0.4
"""Relative error of an accepted step, which is added to its variance: tyre and friction are
linearized about the road without it, and the wheel may lift off."""

REAR_REACH = 0.2
"""Distance [m] of the rear axle from an accepted step within which none is accepted: the innovation
is the error of that step, not another one under the front axle."""

MAX_JUMPS = 4
"""Steps accepted in one block, at most."""


def empty_jumps(n: int, n_candidates: int, n_nodes: int) -> RoadJumps:
    """Return no steps, for a state of size `n` and `n_nodes` nodes in the whole drive."""
    m = 2 * n_candidates
    return RoadJumps(np.zeros((m, n)), np.zeros(m), np.zeros((m, m)), np.zeros((n_nodes, 2)))


@kernel(inline=False)
def add_candidates(jumps: RoadJumps, node, index, free):
    """Replace the oldest candidates by those of the new `node`, whose mean has the `index` in the
    state; on a level road, which is not `free`, there are none.
    """
    for side in range(2):
        i = (2 * node + side) % jumps.score.size
        jumps.direction[i] = 0.0
        if free:
            jumps.direction[i, index] = 0.5
            jumps.direction[i, index + 1] = 0.5 - side
        jumps.score[i] = 0.0
        jumps.information[i] = 0.0
        jumps.information[:, i] = 0.0


@kernel(inline=False)
def update_candidates(jumps: RoadJumps, block: LinearizedBlock):
    """Update the candidates by the whitened innovation of `block`."""
    direction, score, information, _ = jumps
    size = block.n_columns[0]
    entries = np.empty((size, score.size))
    for d in range(size):
        entries[d] = direction[:, block.columns[d]]
    g = np.ascontiguousarray(np.dot(np.ascontiguousarray(block.H[:, :size]), entries).T)
    block.jump_response[:] = g
    direction -= np.dot(g, block.V)
    score += np.dot(g, block.innovation)
    information += np.dot(g, g.T)


@kernel(inline=False)
def predict_candidates(jumps: RoadJumps, block: LinearizedBlock):
    """Propagate the candidates to the end of `block`; force residuals begin anew."""
    direction, size = jumps.direction, block.n_columns[0]
    entries = np.empty((size, direction.shape[0]))
    for d in range(size):
        entries[d] = direction[:, block.columns[d]]
    first = direction.shape[1] - block.A.shape[0]
    direction[:, first:] = np.dot(np.ascontiguousarray(block.A[:, :size]), entries).T
    direction[:, :BIAS] = 0.0


@kernel(inline=False)
def accept_jumps(model: FilterModel, state: FilterState, blocks: LinearizedBlock, j):
    """Add the steps that are likely to the `state`, unless the rear axle is near an earlier one.

    The innovations of the entry `j` of `blocks` and of those before it, for the smoother, are
    corrected to what they would have been with these steps.
    """
    direction, score, information, square = state.jumps
    x, P, newest_node, reach = state.x, state.P, state.newest_node[0], model.jump_reach
    rear = int(newest_node - 2 - model.wheelbase_nodes)
    if square[max(rear - reach, 0) : max(rear + reach, 0)].any():
        return
    m, prior = score.size, JUMP_STD**2
    least = MIN_LOG_RATIO * state.adaptive[NOISE_SCALE]
    for _ in range(MAX_JUMPS):
        best, most = -1, least
        for i in range(m):
            ratio = prior * information[i, i]
            if ratio < MIN_INFORMATION:
                continue
            gain = 0.5 * (prior * score[i] ** 2 / (1.0 + ratio) - np.log1p(ratio))
            if gain > most:
                best, most = i, gain
        if best < 0:
            return
        variance = prior / (1.0 + prior * information[best, best])
        step = variance * score[best]
        f, cross = direction[best].copy(), information[best].copy()
        added = variance + (RELATIVE_ERROR * step) ** 2
        x += step * f
        for i in range(f.size):
            if f[i] != 0.0:
                P[i] += (added * f[i]) * f
        score -= step * cross
        for k in range(m):
            direction[k] -= (variance * cross[k]) * f
            information[k] -= (variance * cross[k]) * cross
        node = newest_node - (newest_node - best // 2) % (m // 2)
        square[node, best % 2] += step**2
        newest, k = newest_node, j
        while k >= 0 and newest >= node:  # the blocks since the node is in the state
            response = blocks.jump_response[k]
            g = response[best].copy()
            blocks.innovation[k] -= step * g
            for i in range(m):
                response[i] -= (variance * cross[i]) * g
            newest -= blocks.nodes_added[k, 0]
            k -= 1
