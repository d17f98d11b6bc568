"""What the filter holds for true, and where in its vector each part of it stands.

    x = [car (14), forces (4), zeros (3), fading sums (4), nodes (2 K)]

The car is its coordinates and rates. Forces [N] are what the struts hold beside their linearised
laws in the block of readings at hand. Zeros [m/s²] are the sensors' offsets. The road is K nodes of
a spline, fixed in space: mean and half difference of the wheel paths side by side, node k at
NODES + 2 (k mod K), so that a new node takes the place of the oldest and nothing is moved. What
leaves goes on in fading sums, real and imaginary part for the mean, then for the half difference,

    sum over k < oldest of c_k exp(-(1 + i) fade (oldest - k))

which is all that long waves need to know of the road behind (`telling.py`).
"""

from typing import NamedTuple

import numpy as np

from road_envs._numba import kernel
from road_envs.vehicle.equations import N_DOF

N_VEHICLE = 2 * N_DOF
FORCE, BIAS, RETIRED, NODES = N_VEHICLE, N_VEHICLE + 4, N_VEHICLE + 7, N_VEHICLE + 11
ROUGHNESS_SCALE, ROUGHNESS_SUM, ROUGHNESS_WEIGHT, NOISE_SCALE = 0, 1, 2, 3
"""What is learnt on the way: roughness over the prior's, the sums it comes from, and how many times
the noise that the model expects the readings seem to hold."""


class FilterModel(NamedTuple):
    """What does not change on the way. Lengths along the road are in nodes.

    A plant's `constants`, `velocity` (one set of tables after the other for each of the `rate_stds`
    (W,) [m/s]), `displacement`; `first_table` (4,) the number of each strut's table;
    `force_variance` (W, K, V) [N²] what is not linear in the force over a rate that is `rate_stds`
    uncertain. Levers over the coordinates: `struts` (4, 7), `sensor_rows` (3, 7). `force_to_accel`
    (4, 7): accelerations by a strut's force; `force_to_sensor` (3, 4): the sensors' share of it.
    `ar_weights` (2, order), `prediction_variance` (2,) [m²]: the next node from the last ones;
    `increment_variance` (2,) [m²]: variance of the rise over `increment_span` nodes;
    `roughness_memory`: nodes over which roughness is taken together. `h` [s], `steps_per_block`
    steps a block, a sample `decimation` so many; `valve_lag` [s] of the valves; `wheelbase_nodes`:
    wheelbase; `decay`, per node; `noise_variance` [(m/s²)²] of a sample, found greater over
    `noise_time` blocks.
    """

    constants: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray
    first_table: np.ndarray
    rate_stds: np.ndarray
    force_variance: np.ndarray
    strut_rows: np.ndarray
    sensor_rows: np.ndarray
    force_to_accel: np.ndarray
    force_to_sensor: np.ndarray
    ar_weights: np.ndarray
    prediction_variance: np.ndarray
    increment_variance: np.ndarray
    increment_span: int
    roughness_memory: float
    h: float
    steps_per_block: int
    decimation: int
    valve_lag: float
    wheelbase_nodes: float
    decay: float
    noise_variance: float
    noise_time: float


class FilterInputs(NamedTuple):
    """The drive: at every half step `front_node` (2 N,), the node number of the front axle, and
    `node_rate` (2 N,) nodes passed in a second; `commands` (N,); block means `y` (3, J) [m/s²] of
    so many `sample_count` (3, J); between the node numbers `free_range` (2,) the road may rise or
    fall.
    """

    front_node: np.ndarray
    node_rate: np.ndarray
    commands: np.ndarray
    y: np.ndarray
    sample_count: np.ndarray
    free_range: np.ndarray


class FilterState(NamedTuple):
    """Mean `x` (n,) and covariance `P` (n, n); `strut_state` (4, 3), the struts' memory;
    `newest_node` (1,), the number of the last node; `adaptive` (4,).
    """

    x: np.ndarray
    P: np.ndarray
    strut_state: np.ndarray
    newest_node: np.ndarray
    adaptive: np.ndarray


class LinearizedBlock(NamedTuple):
    """One block of readings, linearised, and what was learnt from it.

    On the `size` (1,) entries `at` (D,) of the vector: `A` (14, D), what the car will be; `H` (3,
    D), what the sensors hear, in units of the readings' own deviation once `heard` has seen them;
    `V` (3, n) and `innovation` (3,): x' = x + V' news, P' = P - V' V. `end` (14,): the car by the
    full equations; `mean` (3,): the readings they foretell. `nodes_added` (1,): nodes new in the
    block.
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


def empty_blocks(n: int, max_columns: int, blocks: int) -> LinearizedBlock:
    """Blocks, one behind the other along the first axis."""
    return LinearizedBlock(
        n_columns=np.zeros((blocks, 1), dtype=np.int64),
        columns=np.zeros((blocks, max_columns), dtype=np.int64),
        A=np.zeros((blocks, N_VEHICLE, max_columns)),
        H=np.zeros((blocks, 3, max_columns)),
        V=np.zeros((blocks, 3, n)),
        innovation=np.zeros((blocks, 3)),
        end_state=np.zeros((blocks, N_VEHICLE)),
        predicted=np.zeros((blocks, 3)),
        nodes_added=np.zeros((blocks, 1), dtype=np.int64),
    )


@kernel
def node_index(k, n):
    """Where in a vector of `n` the mean of node `k` stands; the half difference stands behind."""
    return NODES + 2 * (k % ((n - NODES) // 2))


@kernel
def get_block(blocks, j):
    """The block `j` of many, as views."""
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
    )
