"""Smoother over the whole drive, in the backward form of de Jong and of Bryson and Frazier.

With r (n,) and N (n, n) accumulated from the innovations of all later blocks, the smoothed mean and
covariance at any moment are

    x + P r,     P - P N P

Only the covariances of the emitted heights with the state must be stored, and no matrix is
inverted. Through a prediction x' = F x both go back as r = F' r', N = F' N' F; through an update

    r = r' + H' (innovation - V r'),
    N = N' + H' H - H' (V N') - (N' V') H + H' (V N' V') H

with V and H whitened (de Jong 1989, J. Am. Stat. Assoc. 84, 1085; Durbin & Koopman, "Time Series
Analysis by State Space Methods", 2012, section 4.4).
"""

from typing import NamedTuple

import numpy as np

from estimators.kalman.profile_output import VARIANCE_STRIDE, ProfileOutput
from estimators.kalman.state import (
    BIAS,
    FORCE,
    RETIRED,
    FilterInputs,
    FilterModel,
    LinearizedBlock,
    get_block,
    node_index,
)
from road_envs._numba import kernel


class BackwardState(NamedTuple):
    """State of the backward recursion: `r` (n,) and `N` (n, n), the newest node `newest_node` (1,)
    at its moment, and `next_station` (1,), before which all stations are still to be smoothed.
    """

    r: np.ndarray
    N: np.ndarray
    newest_node: np.ndarray
    next_station: np.ndarray


@kernel(inline=False)
def smooth_backward(
    model: FilterModel,
    inputs: FilterInputs,
    adjoint: BackwardState,
    first,
    last,
    output: ProfileOutput,
    blocks: LinearizedBlock,
):
    """Run `adjoint` back from the block `last` to `first`, to which `blocks` belong in order.

    Stations emitted in between are smoothed: their heights and variances change in place, unless
    `output.height_covariance` has length 0.
    """
    r, N = adjoint.r, adjoint.N
    for j in range(last - 1, first - 1, -1):
        block = get_block(blocks, j - first)
        adjoint_predict(r, N, block)
        adjoint_update(r, N, block)
        for w in range(FORCE, BIAS):  # force residuals begin anew in each block
            r[w] = 0.0
            N[w] = 0.0
            N[:, w] = 0.0
        for _ in range(block.nodes_added[0]):
            adjoint.newest_node[0] -= 1
            middle = adjoint.newest_node[0] + 0.5
            free = inputs.free_range[0] < middle < inputs.free_range[1]
            adjoint_add_node(model, r, N, adjoint.newest_node[0], free)
            symmetrize(N)
        m = adjoint.next_station
        while m[0] > 0 and (output.emit_block[m[0] - 1] >= j or j == 0):
            m[0] -= 1
            smooth_output(r, N, output, m[0])


@kernel(inline=False)
def symmetrize(N):
    """Make `N` symmetric; the asymmetry of rounding would grow from block to block."""
    for i in range(N.shape[0]):
        for k in range(i):
            z = 0.5 * (N[i, k] + N[k, i])
            N[i, k] = z
            N[k, i] = z


@kernel(inline=False)
def smooth_output(r, N, output: ProfileOutput, m):
    """Correct the height and variance of the station `m` by all later measurements."""
    if output.height_covariance.shape[0] == 0:
        return
    n = r.size
    for side in range(2):
        row = output.height_covariance[m, side]
        for k in range(n):
            output.z[m, side] += row[k] * r[k]
        if m % VARIANCE_STRIDE == 0:
            band, reduction = output.band_covariance[m // VARIANCE_STRIDE, side], 0.0
            for i in range(n):
                z = 0.0
                for k in range(n):
                    z += N[i, k] * band[k]
                reduction += band[i] * z
            output.variance[m, side] -= reduction
    if m % VARIANCE_STRIDE == 0:
        for k in range(m + 1, min(m + VARIANCE_STRIDE, output.node.size)):
            output.variance[k] = output.variance[m]


@kernel(inline=False)
def adjoint_predict(r, N, block: LinearizedBlock):
    """Apply the transpose of `filter.predict`."""
    n, size, A, columns = r.size, block.n_columns[0], block.A, block.columns
    first = n - A.shape[0]
    vehicle, rows = r[first:].copy(), N[first:].copy()
    r[first:] = 0.0
    N[first:] = 0.0
    for d in range(size):
        for i in range(A.shape[0]):
            r[columns[d]] += A[i, d] * vehicle[i]
            for k in range(n):
                N[columns[d], k] += A[i, d] * rows[i, k]
    for d in range(size):
        row = N[columns[d]]
        vehicle = row[first:].copy()
        row[first:] = 0.0
        for e in range(size):
            for i in range(A.shape[0]):
                row[columns[e]] += vehicle[i] * A[i, e]
    mirror_rows(N, columns, size)


@kernel(inline=False)
def mirror_rows(N, columns, size):
    """Copy the rows `columns` (size,) of `N` to its columns."""
    for d in range(size):
        i = columns[d]
        for k in range(N.shape[0]):
            N[k, i] = N[i, k]


@kernel(inline=False)
def adjoint_update(r, N, block: LinearizedBlock):
    """Apply the transpose of `filter.update`."""
    n, size, columns = r.size, block.n_columns[0], block.columns
    H, V, innovation = block.H, block.V, block.innovation
    smoothing_error, VN, VNV = np.empty(3), np.zeros((3, n)), np.zeros((3, 3))
    for s in range(3):
        smoothing_error[s] = innovation[s]
        for k in range(n):
            smoothing_error[s] -= V[s, k] * r[k]
        for i in range(n):
            for k in range(n):
                VN[s, k] += V[s, i] * N[i, k]
    for s in range(3):
        for t in range(3):
            for k in range(n):
                VNV[s, t] += VN[s, k] * V[t, k]
        VNV[s, s] += 1.0
    for d in range(size):
        row = N[columns[d]]
        for s in range(3):
            r[columns[d]] += H[s, d] * smoothing_error[s]
            for k in range(n):
                row[k] -= H[s, d] * VN[s, k]
        for e in range(size):
            for s in range(3):
                row[columns[e]] -= VN[s, columns[d]] * H[s, e]
                for t in range(3):
                    row[columns[e]] += H[s, d] * VNV[s, t] * H[t, e]
    mirror_rows(N, columns, size)


@kernel(inline=False)
def adjoint_add_node(model: FilterModel, r, N, newest_node, free):
    """Apply the transpose of `road_process.add_node`, which added a node ahead of `newest_node`."""
    n, K = r.size, model.n_nodes
    c, s = np.exp(-model.decay) * np.cos(model.decay), np.exp(-model.decay) * np.sin(model.decay)
    order = model.ar_weights.shape[1] if free else 1
    for component in (1, 0):
        new, M = node_index(newest_node + 1, K) + component, RETIRED + 2 * component
        for k in range(order):
            weight = model.ar_weights[component, k] if free else 1.0
            old = node_index(newest_node - k, K) + component
            r[old] += weight * r[new]
            for i in range(n):
                N[old, i] += weight * N[new, i]
        for k in range(order):
            weight = model.ar_weights[component, k] if free else 1.0
            old = node_index(newest_node - k, K) + component
            for i in range(n):
                N[i, old] += weight * N[i, new]
        r[M], r[M + 1] = c * r[M] + s * r[M + 1], c * r[M + 1] - s * r[M]
        r[new] = r[M]
        for i in range(n):
            N[M, i], N[M + 1, i] = c * N[M, i] + s * N[M + 1, i], c * N[M + 1, i] - s * N[M, i]
            N[new, i] = N[M, i]
        for i in range(n):
            N[i, M], N[i, M + 1] = c * N[i, M] + s * N[i, M + 1], c * N[i, M + 1] - s * N[i, M]
            N[i, new] = N[i, M]
