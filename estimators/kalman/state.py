"""State vector of the filter, constants of a run, and the part of the state that a window changes.

    x = [vehicle (N), biases (3), retired-node sums (4), nodes (2 K)]

The vehicle part holds the coordinates of the 7-DOF model and their rates, N = 14. A frame that
twists and side motion (`road_envs.vehicle.side_motion`) add coordinates and their rates; a body
that bends adds the two states of its filter (`estimators.common.bending`). The biases [m/s²] are
the offsets of the sensors. The road is K nodes of a cubic B-spline, fixed in space, each as mean
and half difference of the wheel paths: node k is the pair of the number k modulo K, so a new node
takes the entries of the oldest one. Retired nodes remain in decaying sums, the real parts of both,
then the imaginary ones,

    sum over k < oldest of c_k exp((i - 1) decay (oldest - k))

which is all that the detrending needs of the road behind (`profile_output.py`).
"""

from typing import NamedTuple

import numpy as np

N_BIAS, N_SUMS = 3, 4  # entries of the biases and of the retired-node sums
# Entries of `adaptive`: road PSD relative to the prior, the weighted sum and the weight whose
# ratio it is, the factor on the measurement noise variance, and the mean square of the
# measurements over that variance
ROUGHNESS_SCALE, ROUGHNESS_SUM, ROUGHNESS_WEIGHT, NOISE_SCALE, SIGNAL_POWER = range(5)


class FilterModel(NamedTuple):
    """Constants of a run.

    Vehicle, of D coordinates and N states: `constants`, `velocity` and `displacement` of the plant;
    `velocity` holds the tables once for each of W standard deviations of a strut's rate, and
    `first_table` (4,) is each strut's number among the tables of one. `force_variance` (W, K, V)
    [N²]: variance of the strut force about its linearization. `strut_rows` (4, D), `sensor_rows`
    (3, D): strut extension and sensor acceleration per unit of each coordinate. `force_effect`
    (4, 3 + N): means of the sensors and states at the end of a block per unit strut force, which is
    constant over a block. `valve_lag` [s]: time constant of the valves. Bending of the body: modal
    force per heave and pitch acceleration `bending_force` (2,), shape at the sensors
    `bending_shape` (3,), and the coefficients `bending_section` (6,) of its filter, (0,) if the
    body is stiff. `flexible`: True if the frame twists, else None; `side`: the same of side motion.

    Road: `wheelbase_nodes`, the wheelbase in nodes.

    Measurements: step `h` [s], `steps_per_block`, one sample in `decimation` steps,
    `noise_variance` [(m/s²)²] of a sample, whose factor adapts over `noise_time` blocks.
    """

    constants: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray
    first_table: np.ndarray
    force_variance: np.ndarray
    strut_rows: np.ndarray
    sensor_rows: np.ndarray
    force_effect: np.ndarray
    h: float
    steps_per_block: int
    decimation: int
    valve_lag: float
    bending_force: np.ndarray
    bending_shape: np.ndarray
    bending_section: np.ndarray
    flexible: bool | None
    side: bool | None
    wheelbase_nodes: float
    noise_variance: float
    noise_time: float


class FilterInputs(NamedTuple):
    """Inputs and measurements of a drive of N steps and J blocks.

    Each half step: `front_node` (2 N,), the (fractional) node number of the front axle, and its
    `node_rate` (2 N,) [nodes/s]. Each step: the command byte `commands` (N,). Each block: means `y`
    (3, J) [m/s²] of `sample_count` (3, J) samples. Where `censored` (3, J) is 1 or -1, the true
    mean is beyond y, above or below it; else it is 0.
    """

    front_node: np.ndarray
    node_rate: np.ndarray
    commands: np.ndarray
    y: np.ndarray
    sample_count: np.ndarray
    censored: np.ndarray


class LocalState(NamedTuple):
    """The L entries of the state vector that a window of B blocks measures or moves.

    They are [vehicle, biases, nodes under the front axle, nodes under the rear axle]; the mean of
    node k has the index `nodes_at` - 2 k, for each axle (2,). Mean `x` (L,); `rows` (L, 2 L) the
    covariance and, beside it, the closed-loop transition: derivative of the error by the error at
    the window's start. Valve states of the struts `strut_state` (4, 3); parameters `adaptive` (5,).

    Of each measurement: its `innovation` (3 B,) and its derivative `U` (3 B, L) by the error at the
    window's start, both whitened. Of each block: the normalized innovation squared per measurement
    `nis` (B,), `noise_scale` (B,) and `signal_power` (B,).
    """

    x: np.ndarray
    rows: np.ndarray
    nodes_at: np.ndarray
    strut_state: np.ndarray
    adaptive: np.ndarray
    innovation: np.ndarray
    U: np.ndarray
    nis: np.ndarray
    noise_scale: np.ndarray
    signal_power: np.ndarray


class StepTest(NamedTuple):
    """Test for m candidate steps of the road in a window of B blocks (`jumps.py`): `direction`
    (L, m), error of the local state at the window's start per unit step; `score` (m,) and
    `information` (m, m) so far. Of each block: the newest node that the front axle has touched
    `reached` (B,), and whether the rear axle is near an accepted step, `near_step` (B,). `n_nodes`
    nodes are candidates at a time.
    """

    direction: np.ndarray
    score: np.ndarray
    information: np.ndarray
    reached: np.ndarray
    near_step: np.ndarray
    n_nodes: int


class LinearizedBlock(NamedTuple):
    """Linearization of one block: derivatives `factors` (3 + N, L) of the means of the sensors and
    of the vehicle state at the block's end by the local state; both by nonlinear simulation,
    `predicted` (3,) and `end_state` (N,); `force_variance` (4,) [N²] of the struts' residuals.
    """

    factors: np.ndarray
    predicted: np.ndarray
    end_state: np.ndarray
    force_variance: np.ndarray
