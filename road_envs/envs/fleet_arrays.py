"""Arrays of an instrumented fleet: state, cars, parameters, inputs and output of an interval.

Arrays have the blocks as first axis and LANES as last axis, which the shapes below omit.
"""

from typing import NamedTuple

import numpy as np

from road_envs.envs.failures import END_OF_ROAD, NONFINITE_STEP, ROLLOVER
from road_envs.kernels.simd import LANES
from road_envs.simulation.lanes import aligned_zeros, transpose_constants
from road_envs.vehicle.equations import Plant
from road_envs.vehicle.parameters import VehicleParameters

OUTPUT_COLUMNS = (
    "t", "station", "speed_kmh", "comfort", "rattle", "tyre_load", "reward", "unresolved_variance",
)  # fmt: skip
OUT_T, OUT_STATION, OUT_SPEED_KMH, OUT_COMFORT = range(4)
OUT_RATTLE, OUT_TYRE_LOAD, OUT_REWARD, OUT_UNRESOLVED = range(4, 8)
"""Columns of `StepOutput.values`: time since the start [s], station of the front axle [m], speed
[km/h], the three costs and the reward of the interval, and the share of the road's variance that
the strut states leave unresolved. The last one is a fourth cost that `InstrumentedFleet` adds."""

N_PLANAR, N_STRUT_SIGNALS = 2, 8
"""Sizes of the optional observation groups: horizontal accelerations; extensions and rates."""
MAX_PLANAR, MAX_EXTENSION, MAX_EXTENSION_RATE = 20.0, 0.5, 10.0
"""Limits of the observed values of these groups [m/s², m, m/s]."""

STEPS_DONE, STEPS_TOTAL, PROFILE = range(3)
DRIVE_START, SPEED, SPEED_KMH, SPEED_GAIN = range(4)
ROAD_OFFSET, ROAD_SIZE, ROAD_START, ROAD_PER_DS = 0, 2, 3, 4
"""Rows of `FleetState.counts`, `FleetState.kinematics` and `FleetState.road_layout`."""

TRUE_S, TRUE_PROFILE, TRUE_LOADS, N_TRUE = 0, 1, 3, 7
"""Rows of `StepOutput.truth`, and their number."""

SUM_COMFORT, SUM_RATTLE, SUM_TYRE_LOAD, SUM_A_X, SUM_A_Y, N_SUMS = range(6)
"""Rows of the sums over an interval."""


class FleetState(NamedTuple):
    """State that every vehicle keeps between control intervals; blocks first, lanes last.

    Coordinates `q` and rates `v` (B, 7), `strut_state` (B, 4, 3) and `valves` (B, 2) as in
    `lanes.LaneBuffers`, command `delay_line` (B, D),
    filter states `antialias_state` (B, n, k, 2), `wk_state` (B, m, 1, 2) and `high_pass_state`
    (B, j, 4, 2) of the tyre loads, times `off` (B, 2) [s] for which the sides have been off the
    ground, `mounting` (B, k, 5) of k sensors: factors of their three `sensor_columns`, gain and
    offset; `noise_state` (B, 4) as `normal_numbers.generator_state`.
    `counts` (B, 3): steps done, steps in total, row of the profiles. `kinematics` (B, 4): station
    at the start [m], speed [m/s], speed [km/h], gain of the speed signal. `road_layout` (B, 5): the
    fields of `fleet.RoadBuffers` other than the heights. With `safety`, `wk_state` is (B, m, 2, 2);
    else `high_pass_state` and `off` are empty.
    """

    q: np.ndarray
    v: np.ndarray
    strut_state: np.ndarray
    valves: np.ndarray
    delay_line: np.ndarray
    antialias_state: np.ndarray
    wk_state: np.ndarray
    high_pass_state: np.ndarray
    off: np.ndarray
    mounting: np.ndarray
    noise_state: np.ndarray
    counts: np.ndarray
    kinematics: np.ndarray
    road_layout: np.ndarray


class FleetParameters(NamedTuple):
    """Parameters common to all vehicles.

    Command `delay` in steps, `per_static_load` (4,) [1/N], cost `weights` (3,), filters, noise and
    range (k,) [m/s²] of the accelerometers, whether they are `noisy`, and the coordinates
    `sensor_columns` (k, 3) that they measure, `top_speed` [m/s], step `h` [s], steps per sample
    (`decimation`), and flags of the optional observation groups.
    """

    delay: np.ndarray
    per_static_load: np.ndarray
    weights: np.ndarray
    antialias_sos: np.ndarray
    wk_sos: np.ndarray
    noise_std: np.ndarray
    range: np.ndarray
    noisy: int
    sensor_columns: np.ndarray
    top_speed: float
    h: float
    decimation: int
    planar: int
    struts: int


class _CarBuffers(NamedTuple):
    """Vehicles of B blocks, or of one block whose vehicles all blocks have.

    Fields as of `lanes.LaneBuffers`: `lane_constants` (B,), `constants` (B, LANES), `alpha`
    (B, LANES), and the force tables of all vehicles.
    """

    lane_constants: np.ndarray
    constants: np.ndarray
    alpha: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray


TABLES = {"velocity_table": ("velocity", 8), "displacement_table": ("displacement", 4)}
"""Fields of a plant's constants that number its force tables, these tables, and the most of them:
one for each strut and, by velocity, damper valve."""


class LaneCars:
    """Cars of the lanes of `blocks` blocks as the kernels read them, in `buffers`.

    All lanes have `plant` and `car` at first, in one block that every block reads unless they are
    `individual`. Behind its tables there is then room for those of every lane.
    """

    def __init__(
        self, plant: Plant, car: VehicleParameters, step: float, blocks: int, individual: bool
    ):
        self.plant, self.step, lanes = plant, step, blocks * LANES * individual
        size, common = (blocks if individual else 1), np.repeat(plant.constants, LANES)
        one = transpose_constants(common)
        lane_constants = aligned_zeros(size, one.dtype.itemsize // (8 * LANES))
        lane_constants = lane_constants.reshape(-1).view(one.dtype)
        lane_constants[:] = one[0]
        alpha = aligned_zeros(size)
        alpha[:] = 1.0 - np.exp(-step / car.valve.lag)
        tables = []
        for name, most in TABLES.values():
            table = getattr(plant, name)
            tables.append(np.concatenate([table, np.zeros((most * lanes, *table.shape[1:]))]))
        constants = np.repeat(common[None], size, axis=0)
        self.buffers = _CarBuffers(lane_constants, constants, alpha, *tables)

    def put(self, i: int, plant: Plant, car: VehicleParameters) -> None:
        """Give lane `i` (over all blocks) another plant."""
        constants, alpha = plant.constants[0].copy(), 1.0 - np.exp(-self.step / car.valve.lag)
        for numbers, (name, most) in TABLES.items():
            table, first = getattr(plant, name), len(getattr(self.plant, name)) + most * i
            getattr(self.buffers, name)[first : first + len(table)] = table
            constants[numbers] += first
        self._write_lane(i, constants, alpha)

    def share(self, i: int, other: int) -> None:
        """Give lane `other` the car of lane `i`."""
        b, k = divmod(i, LANES)
        self._write_lane(other, self.buffers.constants[b, k], self.buffers.alpha[b, k])

    def _write_lane(self, i: int, constants: np.void, alpha: float) -> None:
        b, k = divmod(i, LANES)
        self.buffers.constants[b, k], self.buffers.alpha[b, k] = constants, alpha
        for name in self.buffers.lane_constants.dtype.names or ():
            self.buffers.lane_constants[name][b, ..., k] = constants[name]


class IntervalInputs(NamedTuple):
    """Inputs of B blocks in one control interval.

    `road_heights` of all vehicles, from which the offsets of `FleetState.road_layout` count;
    `commands` (B, LANES); `a_xy` (B, 4 n + 2), a_x and a_y [m/s²] of a manoeuvre in turn at every
    half step, or (1, ...) of `fleet.NO_MANOEUVRE`. `profiles` (R, 4, M), if not empty: station,
    speed, a_x and a_y of R drives at every half step, in place of a constant speed and `a_xy`.
    """

    road_heights: np.ndarray
    commands: np.ndarray
    a_xy: np.ndarray
    profiles: np.ndarray


class ControlStepWorkspace(NamedTuple):
    """Scratch of one thread for the n steps of a block."""

    delayed: np.ndarray  # (n,): command bytes
    s: np.ndarray  # (2 n + 1,)
    v: np.ndarray  # (2 n + 1,)
    a_xy: np.ndarray  # (4 n + 2,)
    noise: np.ndarray  # (k, n)
    samples: np.ndarray  # (k, n / decimation) float32: readings of the accelerometers
    signals: np.ndarray  # (n, 29) of each step if they are kept, else (0, 29)


class StepOutput(NamedTuple):
    """Output of one control interval with k samples, of N vehicles with S accelerometers.

    `observation` (N, S k + 5 or more) float32, see `RoadReconEnv`; `values` (N, 8), see
    OUTPUT_COLUMNS; `events` (N, 3), columns as in `failures`; ground truth `truth` (N, 7, k), the
    rows below, or (N, 0, k) unless requested.
    """

    observation: np.ndarray
    values: np.ndarray
    events: np.ndarray
    truth: np.ndarray

    @property
    def failed(self) -> np.ndarray:
        """Whether the motion of the vehicles has failed (N,)."""
        return (self.events[:, NONFINITE_STEP] >= 0) | (self.events[:, ROLLOVER] >= 0)

    @property
    def end_of_road(self) -> np.ndarray:
        """Whether the vehicles have left their roads (N,)."""
        return self.events[:, END_OF_ROAD] > 0

    @property
    def truths(self) -> dict[str, np.ndarray]:
        """Stations (N, k) [m] of the front axles at the samples, heights (N, 2, k) [m] under their
        wheels, and tyre loads (N, 4, k) [N].
        """
        s, profile = self.truth[:, TRUE_S], self.truth[:, TRUE_PROFILE:TRUE_LOADS]
        return {"s": s, "profile": profile, "loads": self.truth[:, TRUE_LOADS:]}
