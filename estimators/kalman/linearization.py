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
    WORKSPACE_ROWS,
    StepInputs,
    step_workspace,
    update_valves,
    workspace,
)
from road_envs.simulation.sensitivity import TAPE_ROW_SIZE, step_with_derivative, tangent_step
from road_envs.simulation.simd import LANES, add, get
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
    node, height, slope = weights
    for k in range(node.shape[0]):
        for half in range(2):
            now = 2 * (first + k) + half
            front, rate = inputs.front_node[now], inputs.node_rate[now]
            for axle in range(2):
                x = front - axle * wheelbase_nodes
                i = int(np.floor(x))
                node[k, half, axle] = i - 1
                a, b = height_weights(x - i), slope_weights(x - i)
                for m in range(4):
                    height[k, half, axle, m] = a[m]
                    slope[k, half, axle, m] = b[m] * rate


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
    n, size, columns, A, H = state.x.size, N_COMMON_COLUMNS, block.columns, block.A, block.H
    A[:] = 0.0
    H[:] = 0.0
    for i in range(N_COMMON_COLUMNS):
        columns[i] = i
    time = steps_per_block * model.h
    # a constant force over so short a time moves the vehicle like free masses
    to_accel, to_sensor = model.force_to_accel, model.force_to_sensor
    for w in range(4):
        for i in range(N_DOF):
            A[i, FORCE + w] = 0.5 * time * time * to_accel[w, i]
            A[N_DOF + i, FORCE + w] = time * to_accel[w, i]
        for s in range(3):
            H[s, FORCE + w] = to_sensor[s, w]
    for s in range(3):
        H[s, BIAS + s] = 1.0
    for axle in range(2):
        for k in range(node[0, 0, axle], node[steps_per_block - 1, 1, axle] + 4):
            for component in range(2):
                columns[size] = node_index(k, n) + component
                size += 1
    block.n_columns[0] = size
    tangent_columns(model, first, rows, weights, block)


@kernel(inline=False)
def simulate_block(
    model: FilterModel, inputs: FilterInputs, state: FilterState, first, weights, rows, block
):
    """Simulate the block: fill the tape `rows`, `block.end_state` and `block.predicted`."""
    p, work, out = model.constants[0], workspace(), np.empty(N_SIGNALS)
    vehicle = VehicleBuffers(model.constants, model.velocity, model.displacement, state.strut_state)
    motion = Motion(state.x[:N_DOF].copy(), state.x[N_DOF:N_VEHICLE].copy())
    road, x, (node, height, slope) = np.empty(16), state.x, weights
    step_inputs, sensor_rows, predicted = (
        StepInputs(road, np.zeros(4)),
        model.sensor_rows,
        np.zeros(3),
    )
    alpha = 1.0 - np.exp(-model.h / model.valve_lag)
    n, samples = x.size, 0
    for k in range(rows.shape[0]):
        for half in range(2):
            for axle in range(2):
                for side in range(2):
                    z, rate = 0.0, 0.0
                    for m in range(4):
                        i = node_index(node[k, half, axle] + m, n)
                        c = x[i] + (1.0 - 2.0 * side) * x[i + 1]
                        z += height[k, half, axle, m] * c
                        rate += slope[k, half, axle, m] * c
                    road[8 * half + 2 * axle + side] = z
                    road[8 * half + 4 + 2 * axle + side] = rate
        update_valves(p, state.strut_state, motion.q, inputs.commands[first + k], alpha, model.h)
        step_with_derivative(vehicle, motion, step_inputs, model.h, work, out, rows[k])
        if (first + k) % model.decimation == 0:
            samples += 1
            for s in range(3):
                for i in range(N_DOF):
                    predicted[s] += sensor_rows[s, i] * out[ACCELERATION + i]
    for s in range(3):
        block.predicted[s] = predicted[s] / samples + x[BIAS + s]
    block.end_state[:N_DOF] = motion.q
    block.end_state[N_DOF:] = motion.v


@kernel(inline=False)
def node_derivatives(weights: AxleWeights, i, road):
    """Write the derivatives of heights and rates under the wheels at the step `i` by the block's
    nodes to `road` (G, 16, LANES), in the layout of `rosenbrock.step`.

    A lane of a group is a direction: after the vehicle states, mean and half difference of the
    nodes under the front axle, then under the rear axle.
    """
    node, height, slope = weights
    road[:] = 0.0
    direction = N_VEHICLE
    for axle in range(2):
        oldest, end = node[0, 0, axle], node[-1, 1, axle] + 4
        for half in range(2):
            for m in range(4):
                k = node[i, half, axle] + m
                if not oldest <= k < end:
                    continue
                for component in range(2):
                    group, lane = divmod(direction + 2 * (k - oldest) + component, LANES)
                    for side in range(2):
                        sign = -1.0 if component == 1 and side == 1 else 1.0
                        wheel = 8 * half + 2 * axle + side
                        road[group, wheel, lane] = sign * height[i, half, axle, m]
                        road[group, 4 + wheel, lane] = sign * slope[i, half, axle, m]
        direction += 2 * (end - oldest)


@kernel(inline=False)
def tangent_columns(model: FilterModel, first, rows, weights: AxleWeights, block):
    """Write the tangents along the vehicle states and the nodes to the columns of `A` and `H`."""
    directions = N_VEHICLE + block.n_columns[0] - N_COMMON_COLUMNS
    groups, samples = (directions + LANES - 1) // LANES, 0
    p, h, sensor_rows, A, H = model.constants[0], model.h, model.sensor_rows, block.A, block.H
    work = step_workspace(np.empty((WORKSPACE_ROWS, LANES)))
    y, a = np.zeros((groups, N_VEHICLE, LANES)), np.empty((N_DOF, LANES))
    road, sums = np.empty((groups, 16, LANES)), np.zeros((3 * groups, LANES))
    for j in range(N_VEHICLE):
        y[j // LANES, j, j % LANES] = 1.0
    for i in range(rows.shape[0]):
        node_derivatives(weights, i, road)
        sampled = (first + i) % model.decimation == 0
        samples += sampled
        for group in range(groups):
            motion = Motion(y[group, :N_DOF], y[group, N_DOF:])
            tangent_step(p, rows[i], motion, road[group], h, work, a)
            if sampled:
                for s in range(3):
                    sensed = sensor_rows[s, 0] * get(a, 0)
                    for j in range(1, N_DOF):
                        sensed = sensed + sensor_rows[s, j] * get(a, j)
                    add(sums, 3 * group + s, sensed)
    for direction in range(directions):
        group, lane = direction // LANES, direction % LANES
        column = direction
        if direction >= N_VEHICLE:
            column += N_COMMON_COLUMNS - N_VEHICLE
        for s in range(3):
            H[s, column] = sums[3 * group + s, lane] / samples
        for j in range(N_VEHICLE):
            A[j, column] = y[group, j, lane]
