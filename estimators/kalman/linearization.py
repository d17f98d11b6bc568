"""Prediction of one block of measurements by the nonlinear vehicle, and its exact derivative.

The vehicle is simulated through the block by the simulator's own step over the mean of the road
nodes. `LinearizedBlock.factors` holds the two Jacobians of an extended Kalman filter, that of the
measurement above that of the transition: every column is the exact tangent of these steps
(`road_envs.simulation.sensitivity`).
"""

from typing import NamedTuple

import numpy as np

from estimators.common.spline import height_weights, slope_weights
from estimators.kalman.state import FilterInputs, FilterModel, LinearizedBlock, LocalState
from estimators.kalman.tuning import TUNING
from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import LANES, broadcast
from road_envs.kernels.simd_arrays import add, get, put, stack_array, stack_rows
from road_envs.simulation.rosenbrock import (
    ACCELERATION,
    N_SIDE_SIGNALS,
    SIDE_ACCELERATION,
    TWIST,
    WORKSPACE_ROWS,
    StepInputs,
    step_workspace,
    update_valves,
)
from road_envs.simulation.sensitivity import TAPE_ROW_SIZE, step_with_derivative, tangent_step
from road_envs.vehicle.equations import N_DOF, THETA, Z_B, Motion
from road_envs.vehicle.side_motion import side_size
from road_envs.vehicle.suspension import VehicleBuffers

_NODE_SPACING = TUNING.node_spacing


class _AxleWeights(NamedTuple):
    """Spline weights of both axles at both half steps of the steps of a block. `node` (steps, 2,
    2): the first of the four nodes that carry an axle; `height` and `slope` [1/s] (steps, 2, 2,
    4): their weights in the height under the axle and in the rate of that height.
    """

    node: np.ndarray
    height: np.ndarray
    slope: np.ndarray


@kernel(inline=False)
def _axle_spline_weights(inputs: FilterInputs, wheelbase_nodes, first, weights: _AxleWeights):
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
    model: FilterModel, inputs: FilterInputs, local: LocalState, j, block: LinearizedBlock
):
    """Fill the block `j`: factors and prediction. `local.strut_state` is advanced to the block's
    end; the vehicle part of `local.x` is not.
    """
    steps_per_block = model.steps_per_block
    first = j * steps_per_block
    node, shape = np.empty((steps_per_block, 2, 2), dtype=np.int64), (steps_per_block, 2, 2, 4)
    weights = _AxleWeights(node, np.empty(shape), np.empty(shape))
    _axle_spline_weights(inputs, model.wheelbase_nodes, first, weights)
    rows = np.empty((steps_per_block, TAPE_ROW_SIZE))
    _simulate_block(model, inputs, local, first, weights, rows, block)
    block.factors[:] = 0.0
    for s in range(3):
        block.factors[s, block.end_state.size + s] = 1.0
    _tangent_columns(model, inputs, local, first, rows, weights, block)


@kernel(inline=False)
def _simulate_block(
    model: FilterModel, inputs: FilterInputs, local: LocalState, first, weights, rows, block
):
    """Simulate the block: fill the tape `rows`, `block.end_state` and `block.predicted`."""
    p, work = model.constants[0], step_workspace(stack_array(WORKSPACE_ROWS))
    out = stack_array(N_SIDE_SIGNALS)
    n_dof = model.strut_rows.shape[1]
    end = block.end_state
    for i in range(end.size):
        end[i] = local.x[i]
    vehicle = VehicleBuffers(model.constants, model.velocity, model.displacement, local.strut_state)
    motion, bending = Motion(end[:n_dof], end[n_dof : 2 * n_dof]), end[2 * n_dof :]
    road, x, (node, height, slope) = np.empty(16), local.x, weights
    acceleration = np.empty(n_dof)
    no_manoeuvre, sensor_rows = np.zeros(4), model.sensor_rows
    predicted = np.zeros(3)
    alpha = 1.0 - np.exp(-model.h / model.valve_lag)
    samples = 0
    for k in range(rows.shape[0]):
        # the mean of the node k stands at nodes_at[axle] - 2 k in x, its half difference behind it.
        # `road` has, for either half step, the heights of four wheels, then their rates
        for half in range(2):
            for axle in range(2):
                for side in range(2):
                    z, rate = 0.0, 0.0
                    for m in range(4):
                        i = local.nodes_at[axle] - 2 * (node[k, half, axle] + m)
                        c = x[i] + (1.0 - 2.0 * side) * x[i + 1]
                        z += height[k, half, axle, m] * c
                        rate += slope[k, half, axle, m] * c
                    road[8 * half + 2 * axle + side] = z
                    road[8 * half + 4 + 2 * axle + side] = rate
        update_valves(p, local.strut_state, motion.q, inputs.commands[first + k], alpha, model.h)
        v = inputs.node_rate[2 * (first + k) + 1] * _NODE_SPACING
        step_inputs = StepInputs(road, no_manoeuvre, model.h, v)
        flags = model.flexible, model.side
        step_with_derivative(vehicle, motion, step_inputs, work, out, rows[k], *flags)
        if (first + k) % model.decimation == 0:
            samples += 1
            for i in range(N_DOF):
                acceleration[i] = out[ACCELERATION + i]
            if model.flexible is not None:
                acceleration[N_DOF] = out[TWIST + 2]
            if model.side is not None:
                for j in range(side_size(motion.q)):
                    acceleration[n_dof - side_size(motion.q) + j] = out[SIDE_ACCELERATION + j]
            bent = 0.0
            if bending.size > 0:
                bent = _bend(model, acceleration, bending)
            for s in range(3):
                predicted[s] += model.bending_shape[s] * bent
                for i in range(n_dof):
                    predicted[s] += sensor_rows[s, i] * acceleration[i]
    for s in range(3):
        block.predicted[s] = predicted[s] / samples + x[end.size + s]


@kernel
def _bend(model: FilterModel, acceleration, bending):
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
def _node_derivatives(weights: _AxleWeights, i, direction, road):
    """Write the derivatives of heights and rates under the wheels at the step `i` by the block's
    nodes to `road` (G, 16, LANES), in the layout of `rosenbrock.step`. A lane of a group is a
    direction: from `direction` on, behind the vehicle states, mean and half difference of the
    nodes under the front axle, then under the rear axle.
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
def _tangent_columns(
    model: FilterModel, inputs: FilterInputs, local: LocalState, first, rows, weights, block
):
    """Write the tangents along the vehicle states and the nodes to `block.factors`."""
    n_dof, n_vehicle, node = model.strut_rows.shape[1], block.end_state.size, weights.node
    oldest, end = node[0, 0], node[-1, 1] + 4  # of the nodes under each axle
    directions = n_vehicle + 2 * (end[0] - oldest[0] + end[1] - oldest[1])
    groups, samples = (directions + LANES - 1) // LANES, 0
    p, h, sensor_rows = model.constants[0], model.h, model.sensor_rows
    work = step_workspace(stack_rows(WORKSPACE_ROWS))
    y, a = np.zeros((groups, n_vehicle, LANES)), np.empty((n_dof, LANES))
    road, sums = np.empty((groups, 16, LANES)), np.zeros((3 * groups, LANES))
    for j in range(n_vehicle):
        y[j // LANES, j, j % LANES] = 1.0
    for i in range(rows.shape[0]):
        _node_derivatives(weights, i, n_vehicle, road)
        sampled = (first + i) % model.decimation == 0
        samples += sampled
        for group in range(groups):
            motion = Motion(y[group, :n_dof], y[group, n_dof : 2 * n_dof])
            v = inputs.node_rate[2 * (first + i) + 1] * _NODE_SPACING
            changes = StepInputs(road[group], None, h, v)
            tangent_step(p, rows[i], motion, changes, work, a, model.flexible, model.side)
            if sampled:
                bent = broadcast(0.0)
                if n_vehicle > 2 * n_dof:
                    bent = _bend(model, a, y[group, 2 * n_dof :])
                for s in range(3):
                    sensed = model.bending_shape[s] * bent
                    for j in range(n_dof):
                        sensed = sensed + sensor_rows[s, j] * get(a, j)
                    add(sums, 3 * group + s, sensed)
    direction = 0
    for part in range(3):  # the vehicle's states, then the nodes of each axle
        entries = n_vehicle if part == 0 else 2 * (end[part - 1] - oldest[part - 1])
        for i in range(entries):
            column = i
            if part > 0:
                column = local.nodes_at[part - 1] - 2 * (oldest[part - 1] + i // 2) + i % 2
            group, lane = direction // LANES, direction % LANES
            block.factors[:3, column] = sums[3 * group : 3 * group + 3, lane] / samples
            block.factors[3:, column] = y[group, :, lane]
            direction += 1
