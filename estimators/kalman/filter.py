"""Extended Kalman filter over a window of blocks of measurements: linearize, update, predict.

The means of a block depend on the vehicle state at the block's start, the road nodes passed in it
and the strut force residuals, which are independent from block to block. The update corrects all of
them; the prediction then propagates the vehicle state to the block's end by the linearization of
the same steps. Nothing but the vehicle moves. Both axles measure the same road nodes: what a rear
wheel measures corrects the node that the front wheel passed before. (Kailath, Sayed & Hassibi,
"Linear Estimation", 2000, chapter 9; Jazwinski, "Stochastic Processes and Filtering Theory", 1970,
section 8.3.)

In a window of some blocks only the local state is filtered (`state.LocalState`), together with its
closed-loop transition. The other nodes are corrected once, after the window (`forward.py`): the
compressed filter of Guivant & Nebot (IEEE Transactions on Robotics and Automation 17, 2001, 242).
"""

import math

import numpy as np

from estimators.kalman.friction_linearization import choose_linearization
from estimators.kalman.jumps import step_is_likely
from estimators.kalman.linearization import linearize_block
from estimators.kalman.state import (
    NOISE_SCALE,
    SIGNAL_POWER,
    FilterInputs,
    FilterModel,
    LinearizedBlock,
    LocalState,
    StepTest,
)
from road_envs._numba import kernel

MAX_NIS = 16.0
"""Greatest normalized innovation squared per measurement; greater innovations are scaled down to
it."""

MAX_LIMIT = 1.5
"""Standard deviations by which a clipped sample exceeds its prediction, at most: clipping may be a
fault of the sensor."""


@kernel(inline=False)
def filter_window(
    model: FilterModel, inputs: FilterInputs, local: LocalState, test: StepTest, first, last
):
    """Filter the blocks from `first` on, to `last` (excluded) or until a step of the road is
    likely. Return the number of blocks, and whether one is likely.
    """
    size, n_vehicle = local.x.size, model.force_to_state.shape[0]
    block = LinearizedBlock(np.empty((3 + n_vehicle, size)), np.empty(3), np.empty(n_vehicle))
    force_variance = np.empty(4)
    for j in range(first, last):
        choose_linearization(model, local, force_variance)
        linearize_block(model, inputs, local, j, block)
        update_block(model, inputs, local, block, force_variance, j, j - first)
        if step_is_likely(test, local, j - first):
            return j - first + 1, True
    return last - first, False


@kernel
def normal_hazard(x):
    """Return the standard normal density at `x` over the probability of more; E[X | X > x]."""
    if x > 8.0:
        return x + 1.0 / x - 2.0 / x**3
    return np.exp(-0.5 * x * x) / (np.sqrt(0.5 * np.pi) * math.erfc(x / np.sqrt(2.0)))


@kernel(inline=False)
def update_block(
    model: FilterModel,
    inputs: FilterInputs,
    local: LocalState,
    block: LinearizedBlock,
    force_variance,
    j,
    i,
):
    """Update by the measurements of the block `j`, the window's `i`-th, and predict to its end.

    The vehicle is propagated by simulation from the mean before the update, and by the transition
    matrix for the correction of the update.
    """
    size, n_vehicle = local.x.size, block.end_state.size
    moved, x, rows = np.dot(block.factors, local.rows), local.x, local.rows
    # all covariances of the means and of the vehicle's next state
    both = np.dot(np.ascontiguousarray(moved[:, :size]), block.factors.T)
    cross = both[:, :3].copy()
    for r in range(3 + n_vehicle):
        effect = model.force_to_sensor[r] if r < 3 else model.force_to_state[r - 3]
        for s in range(3):
            for w in range(4):
                cross[r, s] += effect[w] * force_variance[w] * model.force_to_sensor[s, w]
    innovation, T = local.innovation[3 * i : 3 * i + 3], np.zeros((3, 3))
    whiten(model, inputs, local, block, cross, T, innovation, j, i)
    V, G = np.dot(T, moved[:3]), np.dot(cross[3:], T.T)
    local.U[3 * i : 3 * i + 3] = V[:, size:]
    x[:n_vehicle], rows[:n_vehicle] = block.end_state, moved[3:]
    for a in range(size):
        gain = G[a] if a < n_vehicle else V[:, a]
        subtract_rows(rows[a], gain[0], gain[1], gain[2], V)
        x[a] += gain[0] * innovation[0] + gain[1] * innovation[1] + gain[2] * innovation[2]
    for a in range(n_vehicle):
        for b in range(size):
            rows[b, a] = rows[a, b]
    for a in range(n_vehicle):
        for b in range(n_vehicle):
            z = both[3 + a, 3 + b]
            for w in range(4):
                effect = model.force_to_state[a, w] * model.force_to_state[b, w]
                z += effect * force_variance[w]
            for s in range(3):
                z -= G[a, s] * G[b, s]
            rows[a, b] = z


@kernel
def subtract_rows(row, a, b, c, V):
    """Subtract `a` V[0] + `b` V[1] + `c` V[2] from `row` (M,), of rows `V` (3, M)."""
    first, second, third = V[0], V[1], V[2]
    for k in range(row.size):
        row[k] -= a * first[k] + b * second[k] + c * third[k]


@kernel(inline=False)
def whiten(
    model: FilterModel,
    inputs: FilterInputs,
    local: LocalState,
    block: LinearizedBlock,
    covariance,
    T,
    innovation,
    j,
    i,
):
    """Write the matrix `T` (3, 3) that whitens the measurements and the whitened `innovation` (3,),
    and adapt the noise scale. `covariance` (3, 3), or more rows: of the means without their noise.

    The measurements are processed one after the other. Each is decorrelated from those before it
    and scaled to unit variance: a Cholesky factorization of the innovation covariance, row by row.
    A censored one has the mean and the variance of a truncated normal distribution, as a
    measurement by which the update has both (Tobit filter). A lost one has a row of zeros.
    """
    y, count, censored = inputs.y[:, j], inputs.sample_count[:, j], inputs.censored[:, j]
    noise_scale, n_measured, power, cross = local.adaptive[NOISE_SCALE], 0, 0.0, np.empty(3)
    for s in range(3):
        innovation[s] = 0.0
        T[s] = 0.0
        if count[s] == 0.0:
            continue
        n_measured += 1
        noise_variance = model.noise_variance / count[s]
        power += y[s] ** 2 / noise_variance
        noise_variance *= noise_scale
        variance = noise_variance + covariance[s, s]
        innovation[s] = y[s] - block.predicted[s]
        T[s, s] = 1.0
        for r in range(s):
            cross[r] = 0.0
            for t in range(r + 1):
                cross[r] += T[r, t] * covariance[s, t]
            variance -= cross[r] ** 2
        for r in range(s):
            innovation[s] -= cross[r] * innovation[r]
            for t in range(r + 1):
                T[s, t] -= cross[r] * T[r, t]
        # rounding must not make the variance less than that of the noise
        inverse_std = 1.0 / np.sqrt(max(variance, noise_variance))
        innovation[s] *= inverse_std
        if censored[s] != 0.0:
            limit = min(censored[s] * innovation[s], MAX_LIMIT)
            hazard = normal_hazard(limit)
            innovation[s] = censored[s] * np.sqrt(hazard / (hazard - limit))
            inverse_std *= np.sqrt(hazard * (hazard - limit))
        for t in range(s + 1):
            T[s, t] *= inverse_std
    nis = innovation[0] ** 2 + innovation[1] ** 2 + innovation[2] ** 2
    local.nis[i] = nis / max(n_measured, 1)
    if n_measured > 0:
        mean = min(local.nis[i], MAX_NIS)  # one outlier must not raise the noise much
        local.adaptive[NOISE_SCALE] = max(
            1.0, noise_scale * (1.0 + (mean - 1.0) / model.noise_time)
        )
        power -= n_measured * local.adaptive[SIGNAL_POWER]
        local.adaptive[SIGNAL_POWER] += power / (n_measured * model.noise_time)
    local.noise_scale[i] = local.adaptive[NOISE_SCALE]
    local.signal_power[i] = local.adaptive[SIGNAL_POWER]
    if nis > MAX_NIS * n_measured:
        innovation *= np.sqrt(MAX_NIS * n_measured / nis)
