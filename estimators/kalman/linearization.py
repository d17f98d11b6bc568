"""Prediction of one block of measurements by the nonlinear vehicle, and its exact derivative.

The vehicle is simulated through the block by the simulator's own step over the mean of the road
nodes. Every column of `A` and `H` is the exact tangent of these steps
(`road_envs.simulation.sensitivity`). A strut force residual acts as a constant force all through
the block.
"""

from typing import NamedTuple

import numpy as np

from estimators.common.spline import height_weights, slope_weights
from estimators.kalman.state import (
    BIAS,
    FORCE,
    N_VEHICLE,
    FilterInputs,
    FilterModel,
    FilterState,
    LinearizedBlock,
    node_index,
)
from road_envs._numba import kernel
from road_envs.simulation.rosenbrock import (
    ACCELERATION,
    N_SIGNALS,
    StepInputs,
    update_valves,
    workspace,
)
from road_envs.simulation.sensitivity import TAPE_ROW_SIZE, step_with_derivative, tangent_step
from road_envs.vehicle.equations import N_DOF, Motion
from road_envs.vehicle.suspension import VehicleBuffers

N_COMMON_COLUMNS = BIAS + 3
"""Columns of every block: vehicle, strut force residuals, biases."""


class AxleWeights(NamedTuple):
    """Spline weights of both axles at both half steps of the steps of a block.

    `node` (steps, 2, 2): the first of the four nodes that carry an axle; `height` and `slope` [1/s]
    (steps, 2, 2, 4): their weights in the height under the axle and in the rate of that height.
    """

    node: np.ndarray
    height: np.ndarray
    slope: np.ndarray


def max_columns(nodes_in_block: float) -> int:
    """Return the greatest number of columns of a block in which a wheel passes so many nodes."""
    return N_COMMON_COLUMNS + 4 * (int(np.ceil(nodes_in_block)) + 5)


@kernel(inline=False)
def axle_spline_weights(inputs: FilterInputs, wheelbase_nodes, first, weights: AxleWeights):
    """Fill the spline weights of a block's steps, from the step `first` on."""
    for k in range(weights.node.shape[0]):
        for half in range(2):
            for axle in range(2):
                now = 2 * (first + k) + half
                x = inputs.front_node[now] - axle * wheelbase_nodes
                i = int(np.floor(x))
                weights.node[k, half, axle] = i - 1
                a, b = height_weights(x - i), slope_weights(x - i)
                for m in range(4):
                    weights.height[k, half, axle, m] = a[m]
                    weights.slope[k, half, axle, m] = b[m] * inputs.node_rate[now]


@kernel(inline=False)
def linearize_block(
    model: FilterModel, inputs: FilterInputs, state: FilterState, j, block: LinearizedBlock
):
    """Fill the block `j`: columns, `A`, `H` and prediction. `state.strut_state` is advanced to the
    block's end; the vehicle part of `state.x` is not.
    """
    steps_per_block = model.steps_per_block
    first = j * steps_per_block
    node = np.empty((steps_per_block, 2, 2), dtype=np.int64)
    heights, slopes = np.empty((steps_per_block, 2, 2, 4)), np.empty((steps_per_block, 2, 2, 4))
    weights = AxleWeights(node, heights, slopes)
    axle_spline_weights(inputs, model.wheelbase_nodes, first, weights)
    rows = np.empty((steps_per_block, TAPE_ROW_SIZE))
    simulate_block(model, inputs, state, first, weights, rows, block)
    n, size = state.x.size, N_COMMON_COLUMNS
    block.A[:] = 0.0
    block.H[:] = 0.0
    for i in range(N_COMMON_COLUMNS):
        block.columns[i] = i
    for i in range(N_VEHICLE):
        tangent_column(model, first, rows, weights, i, (0, 0, 0), block)
    time = steps_per_block * model.h
    # a constant force over so short a time moves the vehicle like free masses
    for w in range(4):
        for i in range(N_DOF):
            block.A[i, FORCE + w] = 0.5 * time * time * model.force_to_accel[w, i]
            block.A[N_DOF + i, FORCE + w] = time * model.force_to_accel[w, i]
        for s in range(3):
            block.H[s, FORCE + w] = model.force_to_sensor[s, w]
    for s in range(3):
        block.H[s, BIAS + s] = 1.0
    for axle in range(2):
        for k in range(node[0, 0, axle], node[steps_per_block - 1, 1, axle] + 4):
            for component in range(2):
                block.columns[size] = node_index(k, n) + component
                tangent_column(model, first, rows, weights, size, (axle, k, component), block)
                size += 1
    block.n_columns[0] = size


@kernel(inline=False)
def simulate_block(
    model: FilterModel, inputs: FilterInputs, state: FilterState, first, weights, rows, block
):
    """Simulate the block: fill the tape `rows`, `block.end_state` and `block.predicted`."""
    p, work, out = model.constants[0], workspace(), np.empty(N_SIGNALS)
    vehicle = VehicleBuffers(model.constants, model.velocity, model.displacement, state.strut_state)
    motion = Motion(state.x[:N_DOF].copy(), state.x[N_DOF:N_VEHICLE].copy())
    road = np.empty(16)
    step_inputs = StepInputs(road, np.zeros(4))
    alpha = 1.0 - np.exp(-model.h / model.valve_lag)
    n, samples = state.x.size, 0
    block.predicted[:] = 0.0
    for k in range(rows.shape[0]):
        for half in range(2):
            for axle in range(2):
                for side in range(2):
                    z, rate = 0.0, 0.0
                    for m in range(4):
                        i = node_index(weights.node[k, half, axle] + m, n)
                        c = state.x[i] + (1.0 - 2.0 * side) * state.x[i + 1]
                        z += weights.height[k, half, axle, m] * c
                        rate += weights.slope[k, half, axle, m] * c
                    road[8 * half + 2 * axle + side] = z
                    road[8 * half + 4 + 2 * axle + side] = rate
        update_valves(p, state.strut_state, motion.q, inputs.commands[first + k], alpha, model.h)
        step_with_derivative(vehicle, motion, step_inputs, model.h, work, out, rows[k])
        if (first + k) % model.decimation == 0:
            samples += 1
            for s in range(3):
                for i in range(N_DOF):
                    block.predicted[s] += model.sensor_rows[s, i] * out[ACCELERATION + i]
    for s in range(3):
        block.predicted[s] = block.predicted[s] / samples + state.x[BIAS + s]
    block.end_state[:N_DOF] = motion.q
    block.end_state[N_DOF:] = motion.v


@kernel(inline=False)
def tangent_column(model: FilterModel, first, rows, weights: AxleWeights, column, node, block):
    """Write the tangent along one unit direction to a `column` of `A` and `H`. Below N_VEHICLE the
    direction is that entry of the vehicle state, else of a `node`: (axle, number, component), where
    the component is 0 for the mean and 1 for the half difference.
    """
    axle, k, component = node
    p, work, a = model.constants[0], workspace(), np.empty(N_DOF)
    q, v, road = np.zeros(N_DOF), np.zeros(N_DOF), np.zeros(16)
    motion = Motion(q, v)
    if column < N_DOF:
        q[column] = 1.0
    elif column < N_VEHICLE:
        v[column - N_DOF] = 1.0
    samples = 0
    for i in range(rows.shape[0]):
        if column >= N_VEHICLE:
            for half in range(2):
                m = k - weights.node[i, half, axle]
                inside = 0 <= m < 4
                for side in range(2):
                    sign = -1.0 if component == 1 and side == 1 else 1.0
                    wheel = 8 * half + 2 * axle + side
                    road[wheel] = sign * weights.height[i, half, axle, m] if inside else 0.0
                    road[4 + wheel] = sign * weights.slope[i, half, axle, m] if inside else 0.0
        tangent_step(p, rows[i], motion, road, model.h, work, a)
        if (first + i) % model.decimation == 0:
            samples += 1
            for s in range(3):
                for d in range(N_DOF):
                    block.H[s, column] += model.sensor_rows[s, d] * a[d]
    for s in range(3):
        block.H[s, column] /= samples
    block.A[:N_DOF, column] = q
    block.A[N_DOF:, column] = v
