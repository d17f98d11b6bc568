"""State vector of the filter, constants of a run, and the record of one filtered block.

    x = [strut force residuals (4), biases (3), retired-node sums (4), nodes (2 K), vehicle (N)]

The vehicle part holds the coordinates of the 7-DOF model and their rates, N = 14; with a frame that
twists, its twist as the eighth, and with a body that bends, the two states of its filter
(`estimators.common.bending`), N = 18. The strut force residuals [N] are the parts of the strut
forces that the linearized force laws leave out; each is constant over a block and independent from
block to block. The biases [m/s²] are the offsets of the sensors. The road is K nodes of a cubic
B-spline, fixed in space, as mean and half difference of the wheel paths. Node k has the index
NODES + 2 (k mod K): a ring buffer, in which a new node overwrites the oldest one and no entry
moves. Retired nodes remain in decaying sums, real and imaginary part for the mean, then for the
half difference,

    sum over k < oldest of c_k exp(-(1 + i) decay (oldest - k))

which is all that the detrending needs of the road behind (`profile_output.py`).
"""

from typing import NamedTuple

import numpy as np

from road_envs._numba import kernel

FORCE, BIAS, RETIRED, NODES = 0, 4, 7, 11
"""Index of the first entry of each part of the state vector."""

MAX_PENDING = 96
"""Rows of the updates that are not yet subtracted from the covariance, at most."""

TILE = 64
"""Rows and columns of the covariance that are updated together, within the fastest cache."""

ROUGHNESS_SCALE, ROUGHNESS_SUM, ROUGHNESS_WEIGHT, NOISE_SCALE, SIGNAL_POWER = range(5)
"""Entries of `FilterState.adaptive`: road PSD relative to the prior, the weighted sum and the
weight whose ratio it is, the factor on the measurement noise variance, and the mean square of the
measurements over that variance."""


class FilterModel(NamedTuple):
    """Constants of a run. Lengths along the road are in nodes.

    Vehicle, of D coordinates and N states: `constants`, `velocity` and `displacement` of the plant;
    `velocity` holds the tables once for each rate standard deviation in `rate_stds` (W,) [m/s], and
    `first_table` (4,) is each strut's number among the tables of one. `force_variance` (W, K, V)
    [N²]: variance of the strut force about its linearization. `strut_rows` (4, D), `sensor_rows`
    (3, D): strut extension and sensor acceleration per unit of each coordinate. `force_to_state`
    (N, 4), `force_to_sensor` (3, 4): states at the end of a block and means of the sensors per unit
    strut force. `valve_lag` [s]. Bending of the body: modal force per heave and pitch acceleration
    `bending_force` (2,), shape at the sensors `bending_shape` (3,), and the coefficients
    `bending_section` (6,) of its filter, (0,) if the body is stiff. `flexible`: True of a frame
    that twists, else None.

    Road, of `n_nodes` K: `ar_weights` (2, order) and `prediction_variance` (2,) [m²] of the model
    of the next node; prior `increment_variance` (2,) [m²] over `increment_span` nodes;
    `roughness_memory`, over which roughness is averaged; `jump_reach`, as REAR_REACH of `jumps.py`;
    `wheelbase_nodes`; `decay` of the
    retired-node sums per node.

    Measurements: step `h` [s], `steps_per_block`, one sample in `decimation` steps,
    `noise_variance` [(m/s²)²] of a sample, whose factor adapts over `noise_time` blocks.
    """

    constants: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray
    first_table: np.ndarray
    rate_stds: np.ndarray
    force_variance: np.ndarray
    strut_rows: np.ndarray
    sensor_rows: np.ndarray
    force_to_state: np.ndarray
    force_to_sensor: np.ndarray
    n_nodes: int
    ar_weights: np.ndarray
    prediction_variance: np.ndarray
    increment_variance: np.ndarray
    increment_span: int
    roughness_memory: float
    jump_reach: int
    h: float
    steps_per_block: int
    decimation: int
    valve_lag: float
    bending_force: np.ndarray
    bending_shape: np.ndarray
    bending_section: np.ndarray
    flexible: bool | None
    wheelbase_nodes: float
    decay: float
    noise_variance: float
    noise_time: float


class FilterInputs(NamedTuple):
    """Inputs and measurements of a drive of N steps and J blocks.

    Each half step: `front_node` (2 N,), the (fractional) node number of the front axle, and its
    `node_rate` (2 N,) [nodes/s]. Each step: the command byte `commands` (N,). Each block: means `y`
    (3, J) [m/s²] of `sample_count` (3, J) samples. Where `censored` (3, J) is 1 or -1, the true
    mean is beyond y, above or below it; else it is 0. The road is level outside the node numbers
    `free_range` (2,).
    """

    front_node: np.ndarray
    node_rate: np.ndarray
    commands: np.ndarray
    y: np.ndarray
    sample_count: np.ndarray
    censored: np.ndarray
    free_range: np.ndarray


class RoadJumps(NamedTuple):
    """Candidates and accepted steps; candidate 2 k + side, modulo their number m, is that of node k
    in the left (0) or right (1) wheel path.

    `direction` (m, n): error of the state per unit step; `score` (m,) [1/m]; `information` (m, m)
    [1/m²]; `square` (N, 2) [m²]: squares of the accepted steps of each node of the drive.
    """

    direction: np.ndarray
    score: np.ndarray
    information: np.ndarray
    square: np.ndarray


class FilterState(NamedTuple):
    """Mean `x` (n,), valve states of the struts `strut_state` (4, 3), number of the newest node
    `newest_node` (1,) and the parameters `adaptive` (5,). `nis` (J,): the normalized innovation
    squared, per measurement, of the blocks so far. `jumps`: steps of the road.

    The covariance is P - W' W with `P` (n, n) and the first `n_pending` (1,) rows W of `pending`
    (MAX_PENDING, n): the whitened gains of the last updates. A linear change x' = F x turns it into
    F P F' - (W F')' (W F'), so every step changes a few rows of P and columns of W only, and the
    product of all n x n entries is taken once for many updates (`subtract_pending`).
    """

    x: np.ndarray
    P: np.ndarray
    pending: np.ndarray
    n_pending: np.ndarray
    strut_state: np.ndarray
    newest_node: np.ndarray
    adaptive: np.ndarray
    nis: np.ndarray
    jumps: RoadJumps


class LinearizedBlock(NamedTuple):
    """Linearization of one block of measurements and the result of its update.

    The measurements and the vehicle state at the block's end depend on the `n_columns` (1,) entries
    `columns` (C,) of the state vector, the vehicle first: `A` (N, C) is the transition of the
    vehicle, `H` (3, C) the measurement matrix, which the update whitens in place. Whitened gain `V`
    (3, n) and `innovation` (3,): x' = x + V' innovation, P' = P - V' V. By nonlinear simulation:
    vehicle state `end_state` (N,) and block means `predicted` (3,). `nodes_added` (1,): new nodes.
    `jump_response` (m, 3): mean of the innovation per unit step of each candidate (`jumps.py`).
    """

    n_columns: np.ndarray
    columns: np.ndarray
    A: np.ndarray
    H: np.ndarray
    V: np.ndarray
    innovation: np.ndarray
    end_state: np.ndarray
    predicted: np.ndarray
    nodes_added: np.ndarray
    jump_response: np.ndarray


def empty_blocks(
    n: int, n_vehicle: int, max_columns: int, n_candidates: int, blocks: int
) -> LinearizedBlock:
    """Return `blocks` blocks of zeros, stacked along the first axis of each field."""
    return LinearizedBlock(
        n_columns=np.zeros((blocks, 1), dtype=np.int64),
        columns=np.zeros((blocks, max_columns), dtype=np.int64),
        A=np.zeros((blocks, n_vehicle, max_columns)),
        H=np.zeros((blocks, 3, max_columns)),
        V=np.zeros((blocks, 3, n)),
        innovation=np.zeros((blocks, 3)),
        end_state=np.zeros((blocks, n_vehicle)),
        predicted=np.zeros((blocks, 3)),
        nodes_added=np.zeros((blocks, 1), dtype=np.int64),
        jump_response=np.zeros((blocks, n_candidates, 3)),
    )


@kernel
def node_index(k, n_nodes):
    """Return the index of the mean of node `k`; that of the half difference follows."""
    return NODES + 2 * (k % n_nodes)


@kernel(inline=False)
def subtract_pending(state: FilterState):
    """Subtract the pending updates from `state.P`, tile by tile of its lower triangle."""
    P, pending = state.P, state.pending[: state.n_pending[0]]
    transposed = np.ascontiguousarray(pending.T)
    for k in range(0, P.shape[0], TILE):
        columns = np.ascontiguousarray(pending[:, k : k + TILE])
        for i in range(k, P.shape[0], TILE):
            tile = P[i : i + TILE, k : k + TILE]
            tile -= np.dot(transposed[i : i + TILE], columns)
            if i > k:
                P[k : k + TILE, i : i + TILE] = tile.T
    state.n_pending[0] = 0


@kernel
def get_block(blocks, j):
    """Return the block `j` of `blocks` as views."""
    return LinearizedBlock(
        blocks.n_columns[j],
        blocks.columns[j],
        blocks.A[j],
        blocks.H[j],
        blocks.V[j],
        blocks.innovation[j],
        blocks.end_state[j],
        blocks.predicted[j],
        blocks.nodes_added[j],
        blocks.jump_response[j],
    )
