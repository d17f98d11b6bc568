"""Extended Kalman filter over a window of blocks of measurements: linearize, update, predict.

The means of a block depend on the vehicle state at the block's start, the road nodes passed in it
and the strut force residuals, which are independent from block to block. The update corrects all of
them; the prediction then propagates the vehicle state to the block's end by the linearization of
the same steps. Biases and road nodes are constant. Both axles measure the same road nodes: what a
rear wheel measures corrects the node that the front wheel passed before. (Kailath, Sayed & Hassibi,
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
from estimators.kalman.tuning import TUNING
from road_envs.kernels._numba import kernel

_MAX_LIMIT, _MAX_NIS = TUNING.max_limit, TUNING.max_nis


@kernel(inline=False)
def filter_blocks(
    model: FilterModel, inputs: FilterInputs, local: LocalState, test: StepTest, first, last
):
    """Filter the blocks from `first` on, to `last` (excluded) or until a step of the road is
    likely. Return the block behind the last one, and whether one is likely.
    """
    size, n_vehicle = local.x.size, model.force_effect.shape[1] - 3
    factors, end_state = np.empty((3 + n_vehicle, size)), np.empty(n_vehicle)
    block = LinearizedBlock(factors, np.empty(3), end_state, np.empty(4))
    for j in range(first, last):
        choose_linearization(model, local, block.force_variance)
        linearize_block(model, inputs, local, j, block)
        _update_block(model, inputs, local, block, j, j - first)
        if step_is_likely(test, local, j - first):
            return j + 1, True
    return last, False


@kernel
def _normal_hazard(x):
    """Return the standard normal density at `x` over the probability of more; E[X | X > x]."""
    if x > 8.0:
        return x + 1.0 / x - 2.0 / x**3
    return np.exp(-0.5 * x * x) / (np.sqrt(0.5 * np.pi) * math.erfc(x / np.sqrt(2.0)))


@kernel(inline=False)
def _update_block(
    model: FilterModel, inputs: FilterInputs, local: LocalState, block: LinearizedBlock, j, i
):
    """Update by the measurements of the block `j`, the window's `i`-th, and predict to its end.

    The vehicle is propagated by simulation from the mean before the update, and by the transition
    matrix for the correction of the update.
    """
    size, n_vehicle, x, rows = local.x.size, block.end_state.size, local.x, local.rows
    moved = np.dot(block.factors, rows)
    # of the means and of the vehicle's next state, with the residual forces
    covariance = np.dot(np.ascontiguousarray(moved[:, :size]), block.factors.T)
    for w in range(4):
        for r in range(3 + n_vehicle):
            effect = block.force_variance[w] * model.force_effect[w, r]
            for c in range(3 + n_vehicle):
                covariance[r, c] += effect * model.force_effect[w, c]
    T, innovation = _whiten(model, inputs, local, block.predicted, covariance, j, i)
    # covariance of the whitened innovations with the local state, and beside it their derivative
    V, gain = np.empty((3, 2 * size)), np.empty((size, 3))
    for k in range(2 * size):
        V[0, k] = T[0, 0] * moved[0, k]
        V[1, k] = T[1, 0] * moved[0, k] + T[1, 1] * moved[1, k]
        V[2, k] = T[2, 0] * moved[0, k] + T[2, 1] * moved[1, k] + T[2, 2] * moved[2, k]
    for s in range(3):
        for a in range(size):
            local.U[3 * i + s, a], gain[a, s] = V[s, size + a], V[s, a]
        for a in range(n_vehicle):
            gain[a, s] = 0.0
            for t in range(s + 1):
                gain[a, s] += T[s, t] * covariance[3 + a, t]
    for a in range(n_vehicle):
        x[a] = block.end_state[a]
        for k in range(2 * size):
            rows[a, k] = moved[3 + a, k]
    for a in range(size):
        first, second, third = gain[a, 0], gain[a, 1], gain[a, 2]
        x[a] += first * innovation[0] + second * innovation[1] + third * innovation[2]
        for k in range(2 * size):
            rows[a, k] -= first * V[0, k] + second * V[1, k] + third * V[2, k]
    for a in range(n_vehicle):
        for b in range(n_vehicle, size):
            rows[b, a] = rows[a, b]
        for b in range(n_vehicle):
            known = gain[a, 0] * gain[b, 0] + gain[a, 1] * gain[b, 1] + gain[a, 2] * gain[b, 2]
            rows[a, b] = covariance[3 + a, 3 + b] - known


@kernel(inline=False)
def _whiten(
    model: FilterModel, inputs: FilterInputs, local: LocalState, predicted, covariance, j, i
):
    """Return the matrix T (3, 3) that whitens the measurements and the whitened innovation (3,),
    and adapt the noise scale. `covariance` (3, 3) or larger: of the means without their noise.

    The measurements are processed one after the other. Each is decorrelated from those before it
    and scaled to unit variance: a Cholesky factorization of the innovation covariance, row by row.
    A censored one has the mean and the variance of a truncated normal distribution, as a
    measurement by which the update has both (Tobit filter). A lost one has a row of zeros.
    """
    y, count, censored = inputs.y[:, j], inputs.sample_count[:, j], inputs.censored[:, j]
    noise_scale, n_measured, power, cross = local.adaptive[NOISE_SCALE], 0, 0.0, np.empty(3)
    T, innovation = np.zeros((3, 3)), local.innovation[3 * i : 3 * i + 3]
    for s in range(3):
        innovation[s] = 0.0
        if count[s] == 0.0:
            continue
        n_measured += 1
        noise_variance = model.noise_variance / count[s]
        power += y[s] ** 2 / noise_variance
        noise_variance *= noise_scale
        variance = noise_variance + covariance[s, s]
        innovation[s] = y[s] - predicted[s]
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
            limit = min(censored[s] * innovation[s], _MAX_LIMIT)
            hazard = _normal_hazard(limit)
            innovation[s] = censored[s] * np.sqrt(hazard / (hazard - limit))
            inverse_std *= np.sqrt(hazard * (hazard - limit))
        for t in range(s + 1):
            T[s, t] *= inverse_std
    nis = innovation[0] ** 2 + innovation[1] ** 2 + innovation[2] ** 2
    local.nis[i] = nis / max(n_measured, 1)
    if n_measured > 0:
        mean = min(local.nis[i], _MAX_NIS)  # one outlier must not raise the noise much
        noise_scale *= 1.0 + (mean - 1.0) / model.noise_time
        local.adaptive[NOISE_SCALE] = max(1.0, noise_scale)
        power -= n_measured * local.adaptive[SIGNAL_POWER]
        local.adaptive[SIGNAL_POWER] += power / (n_measured * model.noise_time)
    local.noise_scale[i] = local.adaptive[NOISE_SCALE]
    local.signal_power[i] = local.adaptive[SIGNAL_POWER]
    if nis > _MAX_NIS * n_measured:
        reduction = np.sqrt(_MAX_NIS * n_measured / nis)
        for s in range(3):
            innovation[s] *= reduction
    return T, innovation
