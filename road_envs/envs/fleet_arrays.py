"""Arrays of an instrumented fleet: state, cars, parameters, inputs and output of an interval; LANES
are their last axis, which the shapes below omit, blocks B their first.
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
the strut states leave unresolved, a fourth cost that `InstrumentedFleet` adds."""

N_PLANAR, N_STRUT_SIGNALS = 2, 8
"""Sizes of the optional observation groups: horizontal accelerations; extensions and rates."""
MAX_PLANAR, MAX_EXTENSION, MAX_EXTENSION_RATE = 20.0, 0.5, 10.0
"""Limits of the observed values of these groups [m/s², m, m/s]."""

STEPS_DONE, STEPS_TOTAL, PROFILE = range(3)  # rows of `FleetState.counts`
DRIVE_START, SPEED, SPEED_KMH, SPEED_GAIN = range(4)  # rows of `FleetState.kinematics`
ROAD_OFFSET, ROAD_SIZE, ROAD_START, ROAD_PER_DS = 0, 2, 3, 4  # rows of `FleetState.road_layout`
TRUE_S, TRUE_PROFILE, TRUE_LOADS, N_TRUE = 0, 1, 3, 7  # rows of `StepOutput.truth`, their number
SUM_COMFORT, SUM_RATTLE, SUM_TYRE_LOAD, SUM_A_X, SUM_A_Y, N_SUMS = range(6)  # rows of the sums


class FleetState(NamedTuple):
    """State that every vehicle keeps between control intervals; blocks first, lanes last."""

    q: np.ndarray  # (B, 7), these four as in `lanes.LaneBuffers`
    v: np.ndarray  # (B, 7)
    strut_state: np.ndarray  # (B, 4, 3)
    valves: np.ndarray  # (B, 2)
    delay_line: np.ndarray  # (B, D): commands on their way
    antialias_state: np.ndarray  # (B, n, k, 2) of the filters of k sensors
    wk_state: np.ndarray  # (B, m, 1, 2); with `safety` (B, m, 2, 2)
    high_pass_state: np.ndarray  # (B, j, 4, 2) of the tyre loads; empty without `safety`
    off: np.ndarray  # (B, 2) [s] for which a side is off the ground; empty without `safety`
    mounting: np.ndarray  # (B, k, 5): factors of the three `sensor_columns`, gain, offset
    noise_state: np.ndarray  # (B, 4) as `normal_numbers.generator_state`
    counts: np.ndarray  # (B, 3): steps done, steps in total, row of the profiles
    kinematics: np.ndarray  # (B, 4): start [m], speed [m/s], speed [km/h], gain of its signal
    road_layout: np.ndarray  # (B, 5): fields of `fleet.RoadBuffers` other than the heights


class FleetParameters(NamedTuple):
    """Parameters common to all vehicles, which have k accelerometers."""

    delay: np.ndarray  # of commands, in steps
    per_static_load: np.ndarray  # (4,) [1/N]
    weights: np.ndarray  # (3,) of the costs
    antialias_sos: np.ndarray
    wk_sos: np.ndarray
    noise_std: np.ndarray  # (k,) [m/s²]
    range: np.ndarray  # (k,) [m/s²]
    noisy: int  # whether any sensor is
    sensor_columns: np.ndarray  # (k, 3): coordinates that the sensors measure
    top_speed: float  # [m/s]
    h: float  # step [s]
    decimation: int  # steps per sample
    planar: int  # flags of the optional observation groups
    struts: int


class _CarBuffers(NamedTuple):
    """Vehicles of B blocks, or of one block whose vehicles all blocks have; see LaneBuffers."""

    lane_constants: np.ndarray  # (B,)
    constants: np.ndarray  # (B, LANES)
    alpha: np.ndarray  # (B, LANES)
    velocity: np.ndarray  # force tables of all vehicles, as is `displacement`
    displacement: np.ndarray


TABLES = {"velocity_table": ("velocity", 8), "displacement_table": ("displacement", 4)}
"""Fields of a plant's constants that number its force tables, these tables, and the most of them:
one for each strut and, by velocity, damper valve."""


class LaneCars:
    """Cars of the lanes of `blocks` blocks as the kernels read them, in `buffers`. All lanes have
    `plant` and `car` at first, in one block that every block reads unless they are `individual`;
    then there is room for the tables of every lane behind its own.
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
        room = [(getattr(plant, name), most * lanes) for name, most in TABLES.values()]
        tables = (np.pad(table, ((0, more), (0, 0), (0, 0))) for table, more in room)
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
    """Inputs of B blocks in one control interval."""

    road_heights: np.ndarray  # of all vehicles; offsets of `FleetState.road_layout` count in it
    commands: np.ndarray  # (B, LANES)
    a_xy: np.ndarray  # (B, 4 n + 2): a_x, a_y in turn at every half step; (1, ...): NO_MANOEUVRE
    # (R, 4, M): station, speed, a_x and a_y [m/s²] of R drives at every half step; if not empty,
    # in place of a constant speed and `a_xy`
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
    """Output of one control interval with k samples, of N vehicles with S accelerometers."""

    observation: np.ndarray  # (N, S k + 5 or more) float32, see `RoadReconEnv`
    values: np.ndarray  # (N, 8), see OUTPUT_COLUMNS
    events: np.ndarray  # (N, 3), columns as in `failures`
    truth: np.ndarray  # (N, 7, k), rows as of TRUE_S ..., or (N, 0, k) unless requested

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
        """At the samples: stations (N, k) [m] of the front axles, heights (N, 2, k) [m] under their
        wheels, tyre loads (N, 4, k) [N].
        """
        s, profile = self.truth[:, TRUE_S], self.truth[:, TRUE_PROFILE:TRUE_LOADS]
        return {"s": s, "profile": profile, "loads": self.truth[:, TRUE_LOADS:]}
