"""Fleet of different vehicles, each on its own drive, advanced by control intervals.

Every lane has its own car, surface, speed profile, manoeuvre and sensor faults. It has the
interface of `InstrumentedFleet`, so that the environments run on either.
"""

from math import ceil
from typing import Any, NamedTuple

import numpy as np
import scipy

from road_envs.analysis.comfort import wk_sos
from road_envs.envs.control_step import (
    MAX_EXTENSION,
    MAX_EXTENSION_RATE,
    MAX_PLANAR,
    N_PLANAR,
    N_STRUT_SIGNALS,
    N_TRUE,
    StepOutput,
)
from road_envs.envs.failures import END_OF_ROAD, NONFINITE_STEP
from road_envs.envs.instrumented_fleet import sensor_columns, sensor_rows
from road_envs.envs.safety_step import (
    A_X,
    COMFORT,
    COST,
    LIFT_OFF,
    LOAD_TRANSFER,
    N_SAFETY,
    ROLL,
    STOP,
    TYRE_LOAD,
    SafetyParameters,
    SafetyState,
    measure_block,
)
from road_envs.kernels.normal_numbers import generator_state
from road_envs.kernels.simd import LANES
from road_envs.sensing.data_logger import DataLogger, Instruments
from road_envs.simulation.drive import DriveInputs, DriveSimulator
from road_envs.simulation.fleet import (
    delay_commands,
    integrate_lanes,
    road_buffers,
    run_in_threads,
)
from road_envs.simulation.lanes import LaneBuffers, aligned_zeros, lane_buffers
from road_envs.simulation.rosenbrock import EXTENSION, N_SIGNALS
from road_envs.vehicle.equations import AXLE, N_DOF, PHI, THETA, Z_B
from road_envs.vehicle.force_curves import zero_force_range
from road_envs.vehicle.parameters import GRAVITY, VehicleParameters

SAFETY_COLUMNS = (
    "t", "station", "speed_kmh", "comfort", "tyre_load", "cost", "stop", "lift_off",
    "load_transfer", "roll", "reward",
)  # fmt: skip
"""Columns of `StepOutput.values`. `comfort` [m²/s³] is the time integral of the squared weighted
seat acceleration (W_k), `tyre_load` [s] that of the squared dynamic load coefficient; `cost`,
`stop` and `lift_off` are times [s]; `load_transfer` [-] and `roll` [rad] the extremes."""

SEAT = (0.30, 0.38)
"""Front seats: ahead of the centre of mass, and to either side of the middle [m, assumed]."""

HIGH_PASS_CORNER = 0.4
"""Corner [Hz] below which a tyre load is quasi-static: the lower band limit of W_k, ISO 2631-1."""


class LaneDrive(NamedTuple):
    """The drive of a lane: simulator at its start, and its inputs at every half step.

    `s`, `v` (2 T + 1,), `a_xy` (2 T + 1, 2) as `DriveSimulator.half_step_inputs`; `mounting` (k, 5)
    as in `safety_step`; `speed_gain` of the speed signal; `steps` T of the drive.
    """

    drive: DriveSimulator
    s: np.ndarray
    v: np.ndarray
    a_xy: np.ndarray
    mounting: np.ndarray
    speed_gain: float
    steps: int


class _Block:
    """LANES vehicles: their buffers are built anew when a lane starts another drive."""

    def __init__(self, delay: int, parameters: SafetyParameters):
        k = parameters.range.size
        self.lane_drives: list[LaneDrive | None] = [None] * LANES
        self.lanes: LaneBuffers | None = None
        self.fresh: set[int] = set()
        self.done = np.zeros(LANES, dtype=np.int64)
        self.delay_line = np.zeros((delay, LANES), dtype=np.uint8)
        self.mounting = aligned_zeros(k, 5)
        self.state = SafetyState(
            aligned_zeros(len(parameters.antialias_sos), k, 2),
            aligned_zeros(len(parameters.wk_sos), 2, 2),
            aligned_zeros(len(parameters.high_pass_sos), 4, 2),
            np.zeros((4, LANES), dtype=np.uint64),
            aligned_zeros(2),
        )

    def start(self, k: int, lane_drive: LaneDrive, noise: np.ndarray) -> None:
        """Put lane `k` at the start of a drive, with the generator state `noise` (4,)."""
        self.lane_drives[k], self.done[k] = lane_drive, 0
        self.fresh.add(k)
        self.delay_line[:, k] = lane_drive.drive.delay_line
        self.mounting[..., k] = lane_drive.mounting
        for field in self.state:
            field[..., k] = 0
        self.state.noise[:, k] = noise

    def build(self, h: float) -> LaneBuffers:
        """Return the buffers of the lanes; lanes that go on keep their motion to the bit."""
        if self.lanes is None or self.fresh:
            some = next(one for one in self.lane_drives if one is not None)
            drives = [(one or some).drive for one in self.lane_drives]
            lanes = lane_buffers(
                [d.plant for d in drives], [d.state for d in drives],
                [d.strut_state for d in drives], [d.car.valve.lag for d in drives], h,
            )  # fmt: skip
            if self.lanes is not None:
                kept = [k for k in range(LANES) if k not in self.fresh]
                for new, old in zip(motion_of(lanes), motion_of(self.lanes), strict=True):
                    new[..., kept] = old[..., kept]
            self.lanes, self.roads = lanes, road_buffers([d.surface for d in drives])
            self.fresh = set()
        return self.lanes

    def inputs(self, n: int, delayed: np.ndarray, h: float) -> DriveInputs:
        """Return the inputs of the next n steps; a drive that has ended repeats its last ones."""
        s, v, a_xy = aligned_zeros(2 * n + 1), aligned_zeros(2 * n + 1), aligned_zeros(2 * n + 1, 2)
        for k, one in enumerate(self.lane_drives):
            if one is not None:
                first = min(2 * int(self.done[k]), one.s.size - (2 * n + 1))
                part = slice(first, first + 2 * n + 1)
                s[:, k], v[:, k], a_xy[..., k] = one.s[part], one.v[part], one.a_xy[part]
        return DriveInputs(s, v, a_xy.reshape(4 * n + 2, LANES), delayed, h)

    def arrays(self) -> list[np.ndarray]:
        """All arrays that change from interval to interval, lanes last."""
        assert self.lanes is not None
        return [*motion_of(self.lanes), self.done, self.delay_line, *self.state]


def motion_of(lanes: LaneBuffers) -> tuple[np.ndarray, ...]:
    """Return the arrays of the lanes that an integration changes."""
    return lanes.q, lanes.v, lanes.strut_state, lanes.valves


class IndividualFleet:
    """`n_vehicles` different vehicles: `start` begins a drive, `advance` moves all.

    A control interval has `steps` steps of `step` [s], a whole number of samples of the
    `instruments`. `car` is the described vehicle, whose geometry all share. Output as in
    `InstrumentedFleet`, with SAFETY_COLUMNS and without truth; the reward is minus `comfort`.
    `signals` (blocks, n, 29, LANES) holds those of the last interval, columns as in `rosenbrock`.
    """

    def __init__(
        self,
        car: VehicleParameters,
        instruments: Instruments,
        *,
        step: float,
        steps: int,
        n_vehicles: int = 1,
        top_speed: float = np.inf,
        threads: int = 1,
    ):
        logger = DataLogger(instruments, car, step, np.random.default_rng(0))
        self.car, self.instruments, self.step, self.steps = car, instruments, step, steps
        self.n_vehicles, self.threads, self.top_speed = n_vehicles, threads, top_speed
        self.samples = steps // logger.decimation
        self.sensors = logger.range.size
        stops = [zero_force_range(curve) for curve in car.bump_stops for _ in range(2)]
        self.parameters = SafetyParameters(
            antialias_sos=logger.sos,
            wk_sos=wk_sos(1.0 / step),
            high_pass_sos=scipy.signal.butter(
                2, HIGH_PASS_CORNER, "highpass", fs=1.0 / step, output="sos"
            ),
            noise_std=logger.noise_std,
            range=logger.range,
            sensor_columns=sensor_columns(logger),
            seat=np.array(SEAT),
            stops=np.array(stops),
            per_static_load=1.0 / np.repeat(car.tyre_loads, 2),
            h=step,
            decimation=logger.decimation,
        )
        self.delay = round(car.valve.delay / step)
        blocks = ceil(n_vehicles / LANES)
        self.blocks = [_Block(self.delay, self.parameters) for _ in range(blocks)]
        self.signals = aligned_zeros(blocks, steps, N_SIGNALS)
        self.observation_size = self.sensors * self.samples + 5 + N_PLANAR + N_STRUT_SIGNALS
        self._signal_columns = np.arange(N_SIGNALS)
        # rates of extension (4, 7): height of the body above each strut less that of the axle
        self._extension = np.zeros((4, N_DOF))
        for w in range(4):
            axle, a, side = car.axles[w // 2], AXLE + 2 * (w // 2), (1.0, -1.0)[w % 2]
            self._extension[w, [Z_B, PHI, THETA]] = 1.0, side * axle.y_s, -axle.x
            self._extension[w, [a, a + 1]] = -1.0, -side * axle.y_s

    def start(self, i: int, drive: DriveSimulator, logger: DataLogger, speed_kmh: float) -> None:
        """Start vehicle `i` on a `drive`, measured by `logger`; its manoeuvre is the drive's."""
        steps = drive.steps_left
        s, v, a_xy = drive.half_step_inputs(steps)
        gain, tilt, offset = (
            logger.faults.per_sensor(name, self.sensors) for name in ("gain", "tilt", "offset")
        )
        constant = gain * GRAVITY * (np.cos(tilt) - 1.0) + offset
        mounting = np.column_stack([sensor_rows(logger), gain * np.cos(tilt), constant])
        lane_drive = LaneDrive(drive, s, v, a_xy, mounting, logger.speed_gain, steps)
        b, k = divmod(i, LANES)
        self.blocks[b].start(k, lane_drive, generator_state(logger.rng))

    def share(self, i: int, other: int) -> None:
        """Start vehicle `other` on the drive of vehicle `i`, whose inputs both then share."""
        block, (b, k) = self.blocks[i // LANES], divmod(other, LANES)
        lane_drive = block.lane_drives[i % LANES]
        assert lane_drive is not None
        self.blocks[b].start(k, lane_drive, block.state.noise[:, i % LANES])

    def advance(self, commands: np.ndarray | int, mask: np.ndarray | None = None) -> StepOutput:
        """Advance by one interval under `commands` (N,) uint8 or one for all vehicles.

        With a `mask` (N,) only the vehicles in it advance; output rows outside it are undefined.
        """
        N, n = self.n_vehicles, self.steps
        chosen = np.ones(N, dtype=bool) if mask is None else mask
        bytes_ = np.zeros((len(self.blocks), LANES), dtype=np.uint8)
        bytes_.reshape(-1)[:N] = commands
        moving = np.unique(np.flatnonzero(chosen) // LANES).tolist()
        for b in moving:
            self.blocks[b].build(self.step)
        saved = {} if mask is None else {b: self.arrays_of(b) for b in moving}
        samples = np.zeros((len(self.blocks), self.sensors, self.samples, LANES), np.float32)
        sums = aligned_zeros(len(self.blocks), N_SAFETY)
        events = np.zeros((len(self.blocks), LANES, 3), dtype=np.int64)

        def run(numbers: list[int]) -> None:
            noise, delayed = aligned_zeros(self.sensors, n), np.zeros((n, LANES), np.uint8)
            delay = np.full(LANES, self.delay)
            for b in numbers:
                block, signals = self.blocks[b], self.signals[b]
                delay_commands(block.delay_line, delay, bytes_[b : b + 1], delayed)
                inputs = block.inputs(n, delayed, self.step)
                lanes = block.build(self.step)
                integrate_lanes(lanes, block.roads, inputs, self._signal_columns, signals)
                measure_block(
                    signals, inputs.a_xy, block.mounting, self.parameters, block.state, noise,
                    samples[b], sums[b], events[b],
                )  # fmt: skip
                block.done += n

        threads = min(self.threads, len(moving))
        run_in_threads(run, [(moving[i::threads],) for i in range(threads)])
        output = self._output(bytes_, samples, sums, events)
        unmasked = np.ones(len(self.blocks) * LANES, dtype=bool)
        unmasked[:N] = ~chosen
        for b, arrays in saved.items():
            kept = unmasked[b * LANES : (b + 1) * LANES]
            for now, before in zip(self.blocks[b].arrays(), arrays, strict=True):
                now[..., kept] = before[..., kept]
        return output

    def arrays_of(self, b: int) -> list[np.ndarray]:
        """Return copies of the arrays of block `b` that change from interval to interval."""
        self.blocks[b].build(self.step)
        return [array.copy() for array in self.blocks[b].arrays()]

    def copy_vehicles(self, source: np.ndarray) -> None:
        """Overwrite the motion of vehicle k by that of vehicle source[k], on an equal drive."""
        columns = [self.arrays_of(b) for b in range(len(self.blocks))]
        for k, j in enumerate(source.tolist()):
            if k != j:
                block = self.blocks[k // LANES]
                for array, old in zip(block.arrays(), columns[j // LANES], strict=True):
                    array[..., k % LANES] = old[..., j % LANES]

    @property
    def steps_left(self) -> np.ndarray:
        """Number of steps until the drives are finished (N,)."""
        left = [
            0 if one is None else one.steps - int(done)
            for block in self.blocks
            for one, done in zip(block.lane_drives, block.done, strict=True)
        ]
        return np.array(left[: self.n_vehicles])

    def _output(self, bytes_, samples, sums, events) -> StepOutput:
        """Return the output of an interval from the arrays of its blocks."""
        N = self.n_vehicles
        rows = np.moveaxis(sums, 1, 0).reshape(N_SAFETY, -1)[:, :N]
        last = np.moveaxis(self.signals[:, -1], 1, 0).reshape(N_SIGNALS, -1)[:, :N]
        failures = events.reshape(-1, 3)[:N].copy()
        diverged = failures[:, NONFINITE_STEP] >= 0
        rows = np.where(diverged, 0.0, rows)
        lanes: list[Any] = [one for block in self.blocks for one in block.lane_drives][:N]
        done = np.concatenate([block.done for block in self.blocks])[:N]
        at = [min(2 * int(d), one.s.size - 1) for one, d in zip(lanes, done, strict=True)]
        s, v = (
            np.array([getattr(one, x)[i] for one, i in zip(lanes, at, strict=True)]) for x in "sv"
        )
        gain = np.array([one.speed_gain for one in lanes])
        failures[:, END_OF_ROAD] = self.steps_left <= 0
        values = np.column_stack(
            [
                self.step * done, s, 3.6 * v, rows[COMFORT], rows[TYRE_LOAD], rows[COST],
                rows[STOP], rows[LIFT_OFF], rows[LOAD_TRANSFER], rows[ROLL], -rows[COMFORT],
            ]
        )  # fmt: skip
        commands = bytes_.reshape(-1)[:N]
        accelerations = np.moveaxis(samples, 3, 1).reshape(-1, self.sensors * self.samples)[:N]
        planar = rows[A_X : A_X + 2] / (self.steps * self.step)
        rate = self._extension @ last[N_DOF : 2 * N_DOF]
        observation = np.concatenate(
            [
                accelerations,
                np.clip(gain * v, 0.0, self.top_speed)[:, None],
                *(((commands >> shift) & 1)[:, None] for shift in (0, 4, 2, 6)),
                np.clip(planar, -MAX_PLANAR, MAX_PLANAR).T,
                np.clip(last[EXTENSION : EXTENSION + 4], -MAX_EXTENSION, MAX_EXTENSION).T,
                np.clip(rate, -MAX_EXTENSION_RATE, MAX_EXTENSION_RATE).T,
            ],
            axis=1,
            dtype=np.float32,
        )
        return StepOutput(observation, values, failures, np.zeros((N, N_TRUE * 0, self.samples)))
