"""Extended Kalman filter over blocks of measurements: linearize, update, predict.

The means of a block depend on the vehicle state at the block's start, the road nodes passed in it
and the strut force residuals. The update corrects all of them; the prediction then propagates the
vehicle state to the block's end by the linearization of the same steps. Nothing but the vehicle
moves, so a prediction changes the vehicle's rows and columns of P alone. Both axles measure the
same road nodes: what a rear wheel measures corrects the node that the front wheel passed before.
(Kailath, Sayed & Hassibi, "Linear Estimation", 2000, chapter 9; Jazwinski, "Stochastic Processes
and Filtering Theory", 1970, section 8.3.)
"""

import math
from typing import NamedTuple

import numpy as np

from estimators.kalman.friction_linearization import choose_linearization
from estimators.kalman.jumps import accept_jumps, predict_candidates, update_candidates
from estimators.kalman.linearization import linearize_block
from estimators.kalman.profile_output import emit, lost_noise_scale
from estimators.kalman.road_process import add_node, update_roughness
from estimators.kalman.state import (
    BIAS,
    FORCE,
    NOISE_SCALE,
    SIGNAL_POWER,
    FilterInputs,
    FilterModel,
    FilterState,
    LinearizedBlock,
    get_block,
    subtract_pending,
)
from road_envs._numba import kernel

MAX_NIS = 16.0
"""Greatest normalized innovation squared per measurement; greater innovations are scaled down to
it."""

MAX_LIMIT = 1.5
"""Standard deviations by which a clipped sample exceeds its prediction, at most: clipping may be a
fault of the sensor."""


@kernel(inline=False)
def filter_forward(
    model: FilterModel,
    inputs: FilterInputs,
    state: FilterState,
    first,
    last,
    output,
    blocks: LinearizedBlock,
):
    """Filter the blocks `first` to `last` (excluded) and emit each station before its block.

    `blocks` holds one entry, which every block overwrites, or one entry per block for the smoother.
    `output`: the stations, as in `emit`.
    """
    keep_all = blocks.n_columns.shape[0] > 1
    for j in range(first, last):
        block = get_block(blocks, j - first if keep_all else 0)
        front = inputs.front_node[2 * (j + 1) * model.steps_per_block - 1]
        emit(model, state, output, j)  # before new nodes overwrite the oldest ones
        block.nodes_added[0] = 0
        # the spline under the front axle needs two nodes beyond it
        while np.floor(front) + 2 > state.newest_node[0]:
            middle = state.newest_node[0] + 0.5
            add_node(model, state, inputs.free_range[0] < middle < inputs.free_range[1])
            rear = inputs.front_node[2 * j * model.steps_per_block] - model.wheelbase_nodes
            if state.adaptive[NOISE_SCALE] <= lost_noise_scale(state.adaptive):
                update_roughness(model, state, int(np.floor(rear)) - 1, inputs.free_range)
            block.nodes_added[0] += 1
        choose_linearization(model, state)
        linearize_block(model, inputs, state, j, block)
        measured = inputs.y[:, j], inputs.sample_count[:, j], inputs.censored[:, j]
        if state.n_pending[0] + 3 > state.pending.shape[0]:
            subtract_pending(state)
        projection = project(state, block)
        state.nis[j] = update(model, state, measured, block, projection)
        update_candidates(state.jumps, block)
        predict(state, block, projection)
        predict_candidates(state.jumps, block)
        accept_jumps(model, state, blocks, j - first if keep_all else 0)


class Projection(NamedTuple):
    """Products of H and A, one below the other (3 + N rows), with the covariance P - W' W of a
    `FilterState`: `rows` (3 + N, n) with P and `pending` (3 + N, n_pending) with W'.
    """

    rows: np.ndarray
    pending: np.ndarray


@kernel(inline=False)
def project(state: FilterState, block: LinearizedBlock):
    """Return the Projection of a linearized block."""
    n, size, rank = state.x.size, block.n_columns[0], state.n_pending[0]
    factors, rows = np.empty((3 + block.A.shape[0], size)), np.empty((size, n))
    factors[:3], factors[3:] = block.H[:, :size], block.A[:, :size]
    pending, P, W = np.empty((size, rank)), state.P, state.pending
    for d in range(size):
        i = block.columns[d]
        rows[d] = P[i]
        for r in range(rank):
            pending[d, r] = W[r, i]
    return Projection(np.dot(factors, rows), np.dot(factors, pending))


@kernel
def gather_dot(weights, row, columns, size):
    """Return the sum of the entries `columns` (size,) of `row` (n,), times `weights`."""
    z = 0.0
    for d in range(size):
        z += weights[d] * row[columns[d]]
    return z


@kernel
def normal_hazard(x):
    """Return the standard normal density at `x` over the probability of more; E[X | X > x]."""
    if x > 8.0:
        return x + 1.0 / x - 2.0 / x**3
    return np.exp(-0.5 * x * x) / (np.sqrt(0.5 * np.pi) * math.erfc(x / np.sqrt(2.0)))


@kernel(inline=False)
def update(
    model: FilterModel,
    state: FilterState,
    measured,
    block: LinearizedBlock,
    projection: Projection,
):
    """Update mean and covariance by `measured`: means y (3,) of so many samples (3,), which may be
    0, censored as in `FilterInputs` (3,). Return the normalized innovation squared per measurement.

    The covariance changes by three pending rows, for which there must be room.

    The measurements are processed one after the other. Each is decorrelated from those before it
    and scaled to unit variance: a Cholesky factorization of the innovation covariance, row by row.
    `block.H` is whitened alike. A censored one has the mean and the variance of a truncated normal
    distribution, as a measurement by which the update has both (Tobit filter).
    """
    y, count, censored = measured
    x, size = state.x, block.n_columns[0]
    V, H, innovation, columns = block.V, block.H, block.innovation, block.columns
    noise_scale, n_measured, power = state.adaptive[NOISE_SCALE], 0, 0.0
    first, pending = state.n_pending[0], state.pending
    V[:] = projection.rows[:3] - np.dot(projection.pending[:3], pending[:first])
    cross = np.empty(3)
    for s in range(3):
        innovation[s] = 0.0
        if count[s] == 0.0:
            H[s], V[s] = 0.0, 0.0
            continue
        n_measured += 1
        noise_variance = model.noise_variance / count[s]
        power += y[s] ** 2 / noise_variance
        noise_variance *= noise_scale
        variance = noise_variance + gather_dot(H[s], V[s], columns, size)
        for r in range(s):
            cross[r] = gather_dot(H[s], V[r], columns, size)
            variance -= cross[r] ** 2
        innovation[s] = y[s] - block.predicted[s]
        for r in range(s):
            V[s] -= cross[r] * V[r]
            H[s] -= cross[r] * H[r]
            innovation[s] -= cross[r] * innovation[r]
        # rounding must not make the variance less than that of the noise
        inverse_std = 1.0 / np.sqrt(max(variance, noise_variance))
        innovation[s] *= inverse_std
        if censored[s] != 0.0:
            limit = min(censored[s] * innovation[s], MAX_LIMIT)
            hazard = normal_hazard(limit)
            innovation[s] = censored[s] * np.sqrt(hazard / (hazard - limit))
            inverse_std *= np.sqrt(hazard * (hazard - limit))
        V[s] *= inverse_std
        H[s] *= inverse_std  # for the smoother
    nis = innovation[0] ** 2 + innovation[1] ** 2 + innovation[2] ** 2
    mean_nis = nis / max(n_measured, 1)
    if n_measured > 0:
        mean = min(mean_nis, MAX_NIS)  # one outlier must not raise the noise much
        state.adaptive[NOISE_SCALE] = max(
            1.0, noise_scale * (1.0 + (mean - 1.0) / model.noise_time)
        )
        power -= n_measured * state.adaptive[SIGNAL_POWER]
        state.adaptive[SIGNAL_POWER] += power / (n_measured * model.noise_time)
    if nis > MAX_NIS * n_measured:
        innovation *= np.sqrt(MAX_NIS * n_measured / nis)
    for s in range(3):
        x += innovation[s] * V[s]
        pending[first + s] = V[s]
    state.n_pending[0] = first + 3
    return mean_nis


@kernel(inline=False)
def predict(state: FilterState, block: LinearizedBlock, projection: Projection):
    """Propagate the vehicle to the block's end: by simulation from the mean before the update, by
    the transition matrix for the correction of the update.
    """
    x, P, n, size = state.x, state.P, state.x.size, block.n_columns[0]
    A, innovation, columns = block.A, block.innovation, block.columns
    rank, rows = state.n_pending[0], projection.rows[3:]
    pending, moved, V = state.pending, projection.pending, block.V
    first, n_vehicle = n - A.shape[0], A.shape[0]
    pending[:rank, FORCE:BIAS] = 0.0
    for i in range(n_vehicle):
        x[first + i] = block.end_state[i]
        for r in range(rank - 3):
            pending[r, first + i] = moved[3 + i, r]
    for s in range(3):  # the rows of this block's update follow them
        for i in range(n_vehicle):
            z = gather_dot(A[i], V[s], columns, size)
            x[first + i] += innovation[s] * z
            pending[rank - 3 + s, first + i] = z
    for i in range(n_vehicle):
        for k in range(i + 1):
            z = gather_dot(A[k], rows[i], columns, size)
            P[first + i, first + k] = z
            P[first + k, first + i] = z
    rows[:, FORCE:BIAS] = 0.0  # force residuals begin anew in each block
    P[FORCE:BIAS], P[:, FORCE:BIAS] = 0.0, 0.0
    P[first:, :first] = rows[:, :first]
    P[:first, first:] = rows[:, :first].T
