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
    RETIRED,
    FilterInputs,
    FilterModel,
    FilterState,
    LinearizedBlock,
    node_index,
)
from road_envs._numba import kernel
from road_envs.simulation.rosenbrock import (
    ACCELERATION,
    N_FLEXIBLE_SIGNALS,
    TWIST,
    WORKSPACE_ROWS,
    StepInputs,
    step_workspace,
    update_valves,
)
from road_envs.simulation.sensitivity import TAPE_ROW_SIZE, step_with_derivative, tangent_step
from road_envs.simulation.simd import LANES, broadcast
from road_envs.simulation.simd_arrays import add, get, put, stack_array, stack_rows
from road_envs.vehicle.equations import N_DOF, THETA, Z_B, Motion
from road_envs.vehicle.suspension import VehicleBuffers

N_OTHER = RETIRED
"""Columns of every block behind the vehicle's: strut force residuals and biases."""


class AxleWeights(NamedTuple):
    """Spline weights of both axles at both half steps of the steps of a block.

    `node` (steps, 2, 2): the first of the four nodes that carry an axle; `height` and `slope` [1/s]
    (steps, 2, 2, 4): their weights in the height under the axle and in the rate of that height.
    """

    node: np.ndarray
    height: np.ndarray
    slope: np.ndarray


def max_columns(n_vehicle: int, nodes_in_block: float) -> int:
    """Return the greatest number of columns of a block in which a wheel passes so many nodes."""
    return n_vehicle + N_OTHER + 4 * (int(np.ceil(nodes_in_block)) + 5)


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
    columns, A, H = block.columns, block.A, block.H
    size, n_vehicle = 0, A.shape[0]
    A[:] = 0.0
    H[:] = 0.0
    for i in range(state.x.size - n_vehicle, state.x.size):
        columns[size] = i
        size += 1
    for w in range(4):
        columns[size] = FORCE + w
        A[:, size] = model.force_to_state[:, w]
        H[:, size] = model.force_to_sensor[:, w]
        size += 1
    for s in range(3):
        columns[size] = BIAS + s
        H[s, size] = 1.0
        size += 1
    for axle in range(2):
        for k in range(node[0, 0, axle], node[steps_per_block - 1, 1, axle] + 4):
            for component in range(2):
                columns[size] = node_index(k, model.n_nodes) + component
                size += 1
    block.n_columns[0] = size
    tangent_columns(model, first, rows, weights, block)


@kernel(inline=False)
def simulate_block(
    model: FilterModel, inputs: FilterInputs, state: FilterState, first, weights, rows, block
):
    """Simulate the block: fill the tape `rows`, `block.end_state` and `block.predicted`."""
    p, work = model.constants[0], step_workspace(stack_array(WORKSPACE_ROWS))
    out = stack_array(N_FLEXIBLE_SIGNALS)
    n_dof = model.strut_rows.shape[1]
    end = block.end_state
    end[:] = state.x[state.x.size - end.size :]
    vehicle = VehicleBuffers(model.constants, model.velocity, model.displacement, state.strut_state)
    motion, bending = Motion(end[:n_dof], end[n_dof : 2 * n_dof]), end[2 * n_dof :]
    road, x, (node, height, slope) = np.empty(16), state.x, weights
    acceleration = np.empty(n_dof)
    step_inputs, sensor_rows = StepInputs(road, np.zeros(4)), model.sensor_rows
    predicted = np.zeros(3)
    alpha = 1.0 - np.exp(-model.h / model.valve_lag)
    samples = 0
    for k in range(rows.shape[0]):
        for half in range(2):
            for axle in range(2):
                for side in range(2):
                    z, rate = 0.0, 0.0
                    for m in range(4):
                        i = node_index(node[k, half, axle] + m, model.n_nodes)
                        c = x[i] + (1.0 - 2.0 * side) * x[i + 1]
                        z += height[k, half, axle, m] * c
                        rate += slope[k, half, axle, m] * c
                    road[8 * half + 2 * axle + side] = z
                    road[8 * half + 4 + 2 * axle + side] = rate
        update_valves(p, state.strut_state, motion.q, inputs.commands[first + k], alpha, model.h)
        step_with_derivative(
            vehicle, motion, step_inputs, model.h, work, out, rows[k], model.flexible
        )
        if (first + k) % model.decimation == 0:
            samples += 1
            acceleration[:N_DOF] = out[ACCELERATION : ACCELERATION + N_DOF]
            if n_dof > N_DOF:
                acceleration[N_DOF] = out[TWIST + 2]
            bent = 0.0
            if bending.size > 0:
                bent = bend(model, acceleration, bending)
            for s in range(3):
                predicted[s] += model.bending_shape[s] * bent
                for i in range(n_dof):
                    predicted[s] += sensor_rows[s, i] * acceleration[i]
    for s in range(3):
        block.predicted[s] = predicted[s] / samples + x[BIAS + s]


@kernel
def bend(model: FilterModel, acceleration, bending):
    """Return the acceleration of the body's bending, and advance its filter by one sample.

    `acceleration` (D,) of the coordinates; `bending` (2,): state of the filter. Both may have the
    lanes as their last axis.
    """
    b = model.bending_section
    force = model.bending_force[0] * get(acceleration, Z_B)
    force = force + model.bending_force[1] * get(acceleration, THETA)
    bent = b[0] * force + get(bending, 0)
    put(bending, 0, b[1] * force - b[4] * bent + get(bending, 1))
    put(bending, 1, b[2] * force - b[5] * bent)
    return bent


@kernel(inline=False)
def node_derivatives(weights: AxleWeights, i, direction, road):
    """Write the derivatives of heights and rates under the wheels at the step `i` by the block's
    nodes to `road` (G, 16, LANES), in the layout of `rosenbrock.step`.

    A lane of a group is a direction: from `direction` on, behind the vehicle states, mean and half
    difference of the nodes under the front axle, then under the rear axle.
    """
    node, height, slope = weights
    road[:] = 0.0
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
    n_dof, n_vehicle = model.strut_rows.shape[1], block.A.shape[0]
    directions = block.n_columns[0] - N_OTHER
    groups, samples = (directions + LANES - 1) // LANES, 0
    p, h, sensor_rows, A, H = model.constants[0], model.h, model.sensor_rows, block.A, block.H
    work = step_workspace(stack_rows(WORKSPACE_ROWS))
    y, a = np.zeros((groups, n_vehicle, LANES)), np.empty((n_dof, LANES))
    road, sums = np.empty((groups, 16, LANES)), np.zeros((3 * groups, LANES))
    for j in range(n_vehicle):
        y[j // LANES, j, j % LANES] = 1.0
    for i in range(rows.shape[0]):
        node_derivatives(weights, i, n_vehicle, road)
        sampled = (first + i) % model.decimation == 0
        samples += sampled
        for group in range(groups):
            motion = Motion(y[group, :n_dof], y[group, n_dof : 2 * n_dof])
            tangent_step(p, rows[i], motion, road[group], h, work, a, model.flexible)
            if sampled:
                bent = broadcast(0.0)
                if n_vehicle > 2 * n_dof:
                    bent = bend(model, a, y[group, 2 * n_dof :])
                for s in range(3):
                    sensed = model.bending_shape[s] * bent
                    for j in range(n_dof):
                        sensed = sensed + sensor_rows[s, j] * get(a, j)
                    add(sums, 3 * group + s, sensed)
    for direction in range(directions):
        group, lane = direction // LANES, direction % LANES
        column = direction
        if direction >= n_vehicle:
            column += N_OTHER
        for s in range(3):
            H[s, column] = sums[3 * group + s, lane] / samples
        for j in range(n_vehicle):
            A[j, column] = y[group, j, lane]
