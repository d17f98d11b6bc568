"""Tangent of a drive as one matrix for each short chunk of blocks.

Conjugate gradients apply tangent and adjoint dozens of times about one motion, and most of that
work is the same each time. Over a chunk of some hundredths of a second, the change of the vehicle
state y and of the block means m is

    (y after, m) = P (c, y before)        c: the spline's coefficients under the four wheels

The columns of P are unit changes, propagated through the chunk by `tangent_step`, LANES at a time,
each from the step on at which it begins. A tangent is then one product with each P in turn, an
adjoint one with each P' in reverse, more than ten times as fast as the steps themselves; both take
as long as P takes to be read. It is therefore kept in single precision: a tangent with a relative
error of 1e-7 leads to the same road, and its adjoint is exactly its transpose.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estimators.common.model_inputs import ModelInputs
from estimators.common.spline import height_weights, locate_node, slope_weights
from estimators.map_smoother.road_prior import RoadNodes
from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import LANES, broadcast, sum_lanes
from road_envs.kernels.simd_arrays import get, put, stack_rows
from road_envs.simulation.rosenbrock import WORKSPACE_ROWS, StepInputs, step_workspace
from road_envs.simulation.sensitivity import tangent_step
from road_envs.simulation.tape import Tape
from road_envs.vehicle.equations import Motion

N_ROWS = 4 * LANES
"""Rows of P at most: vehicle state and block means. Four registers hold them."""


class _Track(NamedTuple):
    """Nodes under the axles, and samples, in N steps and M chunks. At each half step (2 N,): node
    number `front_node` of the front axle and `node_rate` [nodes/s]. `first` (M, 2): the first node
    that each axle passes in a chunk, of `size` in all, `ds` [m] apart. `n_states`: 14, or 16 with a
    flexible frame, four more with side motion. `sample_weight` (S, J, b) of samples, one in
    `decimation` steps, in their block means; `sensor_rows` (S, 7).
    """

    front_node: np.ndarray
    node_rate: np.ndarray
    wheelbase_nodes: float
    first: np.ndarray
    size: int
    n_states: int
    ds: float
    decimation: int
    sample_weight: np.ndarray
    sensor_rows: np.ndarray


@kernel
def _road_derivatives(track: _Track, n, m, road):
    """Write the derivative of heights and rates under the wheels in the step `n` of the chunk `m`
    to `road` (G, 16, LANES): rows 0 to 7 at the first half step, rows 8 to 15 at the second; lanes
    are unit changes of the states, then of the nodes. Return the number of changes begun by then.
    """
    road[:] = 0.0
    begun = 0
    for half in range(2):
        now = 2 * n + half
        for axle in range(2):
            i, t = locate_node(track.front_node[now] - axle * track.wheelbase_nodes, track.size)
            z, w = height_weights(t), slope_weights(t)
            for k in range(4):
                change = track.n_states + 4 * (i - 1 + k - track.first[m, axle]) + 2 * axle
                begun = max(begun, change + 2)
                for side in range(2):
                    row = 8 * half + 2 * axle + side
                    group, at = (change + side) // LANES, (change + side) % LANES
                    road[group, row, at] = z[k]
                    road[group, row + 4, at] = w[k] * track.node_rate[now]
    return begun


@kernel
def _fill_chunk_matrices(constants, rows, h, track: _Track, P, flexible=None, side=None):
    """Write the matrices of all chunks to `P` (M, C, N_ROWS), transposed: a column in each row,
    those of the nodes before those of the states. `rows` of the tape; `flexible`, `side` as of
    `sensitivity.tangent_step`.
    """
    n_states, n_dof = track.n_states, track.n_states // 2
    decimation, sensor_rows = track.decimation, track.sensor_rows
    sample_weight = track.sample_weight
    p, changes = constants[0], P.shape[1]
    groups = -(-changes // LANES)
    work = step_workspace(stack_rows(WORKSPACE_ROWS))
    sensors, blocks, block = sample_weight.shape
    blocks_per_chunk = (N_ROWS - n_states) // sensors
    y, a = np.empty((groups, n_states, LANES)), np.empty((n_dof, LANES))
    means = np.empty((groups, sensors * blocks_per_chunk, LANES))
    road = np.empty((groups, 16, LANES))
    for m in range(P.shape[0]):
        y[:], means[:] = 0.0, 0.0
        for j in range(n_states):
            y[j // LANES, j, j % LANES] = 1.0
        last = min((m + 1) * blocks_per_chunk, blocks)
        for n in range(m * blocks_per_chunk * block * decimation, last * block * decimation):
            begun = _road_derivatives(track, n, m, road)
            sample = n // decimation
            at = sample // block
            for group in range((begun + LANES - 1) // LANES):
                motion = Motion(y[group, :n_dof], y[group, n_dof:])
                v = track.node_rate[2 * n + 1] * track.ds
                step_inputs = StepInputs(road[group], None, h, v)
                tangent_step(p, rows[n], motion, step_inputs, work, a, flexible, side)
                if n % decimation == 0:
                    for i in range(sensors):
                        sensed = broadcast(0.0)
                        for j in range(n_dof):
                            sensed = sensed + sensor_rows[i, j] * get(a, j)
                        k = i * blocks_per_chunk + at - m * blocks_per_chunk
                        weight = sample_weight[i, at, sample % block]
                        put(means[group], k, get(means, group, k) + weight * sensed)
        for change in range(changes):
            group, at, column = change // LANES, change % LANES, (change - n_states) % changes
            for j in range(n_states):
                P[m, column, j] = y[group, j, at]
            for k in range(sensors * blocks_per_chunk):
                P[m, column, n_states + k] = means[group, k, at]
            for k in range(n_states + sensors * blocks_per_chunk, N_ROWS):
                P[m, column, k] = 0.0


@kernel
def _apply_chunks(P, first, width, c, y, means):
    """Propagate a change `y` (14,) of the first state and `c` (2, K) of the road by `P`, as of
    `BlockTangent`, to `means` (S, J); `y` ends as the change of the last state.
    """
    n_states = y.size
    x, out = np.empty(P.shape[1]), np.empty((P.shape[2], LANES))
    flat, blocks_per_chunk = out.ravel(), (N_ROWS - n_states) // means.shape[0]
    for m in range(P.shape[0]):
        for k in range(width):
            for wheel in range(4):
                x[4 * k + wheel] = c[wheel % 2, first[m, wheel // 2] + k]
        for j in range(n_states):  # element by element: an assignment of slices takes longer
            x[4 * width + j] = y[j]
        r0, r1, r2, r3 = broadcast(0.0), broadcast(0.0), broadcast(0.0), broadcast(0.0)
        for column in range(P.shape[1]):  # the nodes first: they do not wait for the last chunk
            r0 = r0 + x[column] * get(P, m, column, 0)
            r1 = r1 + x[column] * get(P, m, column, 1)
            r2 = r2 + x[column] * get(P, m, column, 2)
            r3 = r3 + x[column] * get(P, m, column, 3)
        put(out, 0, r0)
        put(out, 1, r1)
        put(out, 2, r2)
        put(out, 3, r3)
        for j in range(n_states):
            y[j] = flat[j]
        for i in range(means.shape[0]):
            for j in range(m * blocks_per_chunk, min((m + 1) * blocks_per_chunk, means.shape[1])):
                means[i, j] = flat[n_states + i * blocks_per_chunk + j - m * blocks_per_chunk]


@kernel
def _apply_chunks_transpose(P, first, width, means, y, c):
    """Apply the transpose of `_apply_chunks`: from `means` (S, J) and the adjoint `y` (14,) of the
    last state to that of the first, and to the coefficients `c` (2, K).
    """
    n_states = y.size
    inside, out = np.zeros((P.shape[2], LANES)), np.empty(P.shape[1])
    flat, blocks_per_chunk = inside.ravel(), (N_ROWS - n_states) // means.shape[0]
    c[:] = 0.0
    for m in range(P.shape[0] - 1, -1, -1):
        flat[:] = 0.0
        for j in range(n_states):
            flat[j] = y[j]
        for i in range(means.shape[0]):
            for j in range(m * blocks_per_chunk, min((m + 1) * blocks_per_chunk, means.shape[1])):
                flat[n_states + i * blocks_per_chunk + j - m * blocks_per_chunk] = means[i, j]
        r0, r1, r2, r3 = get(inside, 0), get(inside, 1), get(inside, 2), get(inside, 3)
        for column in range(P.shape[1]):
            total = r0 * get(P, m, column, 0) + r1 * get(P, m, column, 1)
            total = total + r2 * get(P, m, column, 2) + r3 * get(P, m, column, 3)
            out[column] = sum_lanes(total)
        for j in range(n_states):
            y[j] = out[4 * width + j]
        for k in range(width):
            for wheel in range(4):
                c[wheel % 2, first[m, wheel // 2] + k] += out[4 * k + wheel]


@dataclass(frozen=True, eq=False)
class BlockTangent:
    """Tangent of one motion: matrices `P` (M, C, N_ROWS // LANES, LANES), each of `width` nodes
    from `first` (M, 2) under front and rear axle, of `n_nodes`; `shape` (S, J) of the block means.
    """

    P: np.ndarray
    first: np.ndarray
    width: int
    n_nodes: int
    shape: tuple[int, int]

    def apply(self, start: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Return the change (S, J) of the means by one of the first state (14,) and `c` (2, K)."""
        means, y = np.empty(self.shape), start.copy()
        _apply_chunks(self.P, self.first, self.width, c, y, means)
        return means

    def apply_transpose(self, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply the transpose: from block means (S, J) to the first state (14,) and `c` (2, K)."""
        y, c = np.zeros(self.P.shape[1] - 4 * self.width), np.empty((2, self.n_nodes))
        _apply_chunks_transpose(self.P, self.first, self.width, means, y, c)
        return y, c


def build_block_tangent(
    tape: Tape,
    nodes: RoadNodes,
    inputs: ModelInputs,
    sample_weight: np.ndarray,
    sensor_rows: np.ndarray,
    wheelbase: float,
) -> BlockTangent:
    """Return the tangent of a taped motion, by weights (S, J, b) and rows (S, 7) of sensors."""
    (sensors, blocks, block), n_states = sample_weight.shape, tape.end.size
    blocks_per_chunk = (N_ROWS - n_states) // sensors
    steps_per_block = block * inputs.decimation
    x, wheelbase_nodes = (inputs.s - nodes.origin) / nodes.ds, wheelbase / nodes.ds
    half_steps = 2 * steps_per_block * blocks_per_chunk
    begin = half_steps * np.arange(-(-blocks // blocks_per_chunk))
    end = np.minimum(begin + half_steps, 2 * steps_per_block * blocks) - 1
    axles = (np.stack([x[at], x[at] - wheelbase_nodes], axis=1) for at in (begin, end))
    low, high = (np.clip(node, 1.0, nodes.size - 2.001).astype(int) for node in axles)
    width = int((high - low).max()) + 4
    first = np.minimum(low - 1, nodes.size - width)
    P = np.empty((begin.size, 4 * width + n_states, N_ROWS), dtype=np.float32)
    track = _Track(
        x, inputs.v / nodes.ds, wheelbase_nodes, first, nodes.size, n_states, nodes.ds,
        inputs.decimation, sample_weight, sensor_rows,
    )  # fmt: skip
    flags = tape.plant.kernel_flags
    _fill_chunk_matrices(tape.plant.constants, tape.rows, tape.h, track, P, *flags)
    P = P.reshape(*P.shape[:2], N_ROWS // LANES, LANES)
    return BlockTangent(P, first, width, nodes.size, (sensors, blocks))
