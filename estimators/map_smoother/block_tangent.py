"""Tangent of a drive as one matrix for each short chunk of blocks.

Conjugate gradients apply tangent and adjoint dozens of times about one motion. Most of that work is
the same each time and is done once. Over a chunk of some hundredths of a second, the change of the
vehicle state y and of the block means m is

    (y after, m) = P (y before, c)        c: the spline's coefficients under the four wheels

The columns of P are unit changes, propagated through the chunk by `tangent_step`, LANES at a time.
A tangent is then one product with each P from the first chunk to the last, an adjoint one with each
P' from the last to the first. Both are more than ten times as fast as the steps themselves.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from estimators.common.block_means import BlockMeans
from estimators.common.model_inputs import ModelInputs
from estimators.common.spline import height_weights, locate_node, slope_weights
from estimators.map_smoother.road_prior import RoadTransform
from road_envs._numba import kernel
from road_envs.simulation.rosenbrock import WORKSPACE_ROWS, step_workspace
from road_envs.simulation.sensitivity import tangent_step
from road_envs.simulation.simd import LANES, broadcast, extract_lane, get, put
from road_envs.simulation.tape import Tape
from road_envs.vehicle.equations import Motion

N_ROWS = 32
"""Rows of P at most: vehicle state and block means."""


class NodeTrack(NamedTuple):
    """Nodes under the axles in N steps and M chunks.

    At each half step (2 N,): node number `front_node` of the front axle and `node_rate` [nodes/s].
    `first` (M, 2): the first of `width` nodes that each axle passes in a chunk, of `size` in all.
    `n_states` of the vehicle: 14, or 16 with a flexible frame.
    """

    front_node: np.ndarray
    node_rate: np.ndarray
    wheelbase_nodes: float
    first: np.ndarray
    width: int
    size: int
    n_states: int


@kernel
def road_derivatives(track: NodeTrack, n, m, road):
    """Write the derivative of heights and rates under the wheels to `road` (G, 16, LANES).

    For the step `n` of the chunk `m`. Rows 0 to 7 are heights and rates at the first half step,
    rows 8 to 15 at the second; lanes are columns of P.
    """
    road[:] = 0.0
    for half in range(2):
        now = 2 * n + half
        for axle in range(2):
            i, t = locate_node(track.front_node[now] - axle * track.wheelbase_nodes, track.size)
            z, w = height_weights(t), slope_weights(t)
            for side in range(2):
                wheel = 2 * axle + side
                column = track.n_states + wheel * track.width + i - 1 - track.first[m, axle]
                for k in range(4):
                    group, at = (column + k) // LANES, (column + k) % LANES
                    road[group, 8 * half + wheel, at] = z[k]
                    road[group, 8 * half + 4 + wheel, at] = w[k] * track.node_rate[now]


class Sampling(NamedTuple):
    """`sample_weight` (S, J, b) of the samples, one in `decimation` steps, in their block means;
    `sensor_rows` (S, 7).
    """

    decimation: int
    sample_weight: np.ndarray
    sensor_rows: np.ndarray


@kernel
def fill_chunk_matrices(constants, rows, h, track: NodeTrack, sampling: Sampling, P, flexible=None):
    """Write the matrices of all chunks to `P` (M, C, N_ROWS), transposed: a column in each row.

    `rows` of the tape; `flexible` as of `sensitivity.tangent_step`.
    """
    n_states, n_dof = track.n_states, track.n_states // 2
    decimation, sample_weight, sensor_rows = sampling
    p, groups = constants[0], P.shape[1] // LANES
    work = step_workspace(np.empty((WORKSPACE_ROWS, LANES)))
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
            road_derivatives(track, n, m, road)
            sample = n // decimation
            at = sample // block
            for group in range(groups):
                motion = Motion(y[group, :n_dof], y[group, n_dof:])
                tangent_step(p, rows[n], motion, road[group], h, work, a, flexible)
                if n % decimation == 0:
                    for i in range(sensors):
                        sensed = broadcast(0.0)
                        for j in range(n_dof):
                            sensed = sensed + sensor_rows[i, j] * get(a, j)
                        k = i * blocks_per_chunk + at - m * blocks_per_chunk
                        weight = sample_weight[i, at, sample % block]
                        put(means[group], k, get(means, group, k) + weight * sensed)
        for column in range(P.shape[1]):
            group, at = column // LANES, column % LANES
            for j in range(n_states):
                P[m, column, j] = y[group, j, at]
            for k in range(sensors * blocks_per_chunk):
                P[m, column, n_states + k] = means[group, k, at]
            for k in range(n_states + sensors * blocks_per_chunk, N_ROWS):
                P[m, column, k] = 0.0


@kernel
def apply_chunks(P, first, width, c, y, means):
    """Propagate a change `y` (14,) of the first state and `c` (2, K) of the road to `means` (S, J).

    `P` (M, C, N_ROWS // LANES, LANES); `y` ends as the change of the last state.
    """
    n_states = y.size
    x, out = np.zeros(P.shape[1]), np.empty((P.shape[2], LANES))
    flat, blocks_per_chunk = out.ravel(), (N_ROWS - n_states) // means.shape[0]
    used = n_states + 4 * width
    for m in range(P.shape[0]):
        x[:n_states] = y
        for wheel in range(4):
            for k in range(width):
                x[n_states + wheel * width + k] = c[wheel % 2, first[m, wheel // 2] + k]
        for group in range(P.shape[2]):
            total = broadcast(0.0)
            for column in range(used):
                total = total + x[column] * get(P, m, column, group)
            put(out, group, total)
        y[:] = flat[:n_states]
        for i in range(means.shape[0]):
            for j in range(m * blocks_per_chunk, min((m + 1) * blocks_per_chunk, means.shape[1])):
                means[i, j] = flat[n_states + i * blocks_per_chunk + j - m * blocks_per_chunk]


@kernel
def apply_chunks_transpose(P, first, width, means, y, c):
    """Apply the transpose of `apply_chunks`: from `means` (S, J) and the adjoint `y` (14,) of the
    last state to that of the first and to coefficients `c` (2, K).
    """
    n_states = y.size
    inside, out = np.zeros((P.shape[2], LANES)), np.empty(P.shape[1])
    flat, blocks_per_chunk = inside.ravel(), (N_ROWS - n_states) // means.shape[0]
    used = n_states + 4 * width
    c[:] = 0.0
    for m in range(P.shape[0] - 1, -1, -1):
        flat[:] = 0.0
        flat[:n_states] = y
        for i in range(means.shape[0]):
            for j in range(m * blocks_per_chunk, min((m + 1) * blocks_per_chunk, means.shape[1])):
                flat[n_states + i * blocks_per_chunk + j - m * blocks_per_chunk] = means[i, j]
        for column in range(used):
            total = broadcast(0.0)
            for group in range(P.shape[2]):
                total = total + get(inside, group) * get(P, m, column, group)
            x = extract_lane(total, 0)
            for k in range(1, LANES):
                x += extract_lane(total, k)
            out[column] = x
        y[:] = out[:n_states]
        for wheel in range(4):
            for k in range(width):
                c[wheel % 2, first[m, wheel // 2] + k] += out[n_states + wheel * width + k]


@dataclass(frozen=True, eq=False)
class BlockTangent:
    """Tangent of one motion: matrices `P` (M, C, N_ROWS // LANES, LANES), each for `width` nodes
    from `first` (M, 2) on under front and rear axle, of `n_nodes` in all; `shape` (S, J) of block
    means.
    """

    P: np.ndarray
    first: np.ndarray
    width: int
    n_nodes: int
    shape: tuple[int, int]
    n_states: int

    def apply(self, start: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Return the change (S, J) of the block means by one of the first state (14,) and of `c`
        (2, K).
        """
        means, y = np.empty(self.shape), start.copy()
        apply_chunks(self.P, self.first, self.width, c, y, means)
        return means

    def apply_transpose(self, means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply the transpose: from block means (S, J) to the first state (14,) and `c` (2, K)."""
        y, c = np.zeros(self.n_states), np.empty((2, self.n_nodes))
        apply_chunks_transpose(self.P, self.first, self.width, means, y, c)
        return y, c


def build_block_tangent(
    tape: Tape,
    road: RoadTransform,
    inputs: ModelInputs,
    measurements: BlockMeans,
    sensor_rows: np.ndarray,
    wheelbase: float,
) -> BlockTangent:
    """Return the tangent of a taped motion, measured by sensors of `sensor_rows` (S, 7)."""
    sensors, blocks, block = measurements.sample_weight.shape
    n_states = tape.end.size
    blocks_per_chunk = (N_ROWS - n_states) // sensors
    steps_per_block = block * inputs.decimation
    x, wheelbase_nodes = (inputs.s - road.origin) / road.ds, wheelbase / road.ds
    half_steps = 2 * steps_per_block * blocks_per_chunk
    begin = half_steps * np.arange(-(-blocks // blocks_per_chunk))
    end = np.minimum(begin + half_steps, 2 * steps_per_block * blocks) - 1
    axles = (np.stack([x[at], x[at] - wheelbase_nodes], axis=1) for at in (begin, end))
    low, high = (np.clip(node, 1.0, road.size - 2.001).astype(int) for node in axles)
    width = int((high - low).max()) + 4
    first = np.minimum(low - 1, road.size - width)
    columns = -(-(n_states + 4 * width) // LANES) * LANES
    P = np.empty((begin.size, columns, N_ROWS))
    track = NodeTrack(x, inputs.v / road.ds, wheelbase_nodes, first, width, road.size, n_states)
    sampling = Sampling(inputs.decimation, measurements.sample_weight, sensor_rows)
    flexible = (True,) if tape.plant.flexible else ()
    fill_chunk_matrices(tape.plant.constants, tape.rows, tape.h, track, sampling, P, *flexible)
    P = P.reshape(begin.size, columns, N_ROWS // LANES, LANES)
    return BlockTangent(P, first, width, road.size, (sensors, blocks), n_states)
