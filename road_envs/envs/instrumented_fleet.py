"""Fleet of equal instrumented vehicles, each on its own road, advanced by control intervals.

It is the simulator behind the environments. The result of a vehicle does not depend on the other
vehicles, so single and vector environments agree to the bit.
"""

from collections.abc import Callable
from math import ceil

import numpy as np

from road_envs.analysis.comfort import wk_sos
from road_envs.core.config import ConfigError
from road_envs.envs.control_step import (
    DRIVE_START,
    N_PLANAR,
    N_STRUT_SIGNALS,
    N_TRUE,
    OUT_REWARD,
    OUT_UNRESOLVED,
    OUTPUT_COLUMNS,
    ROAD_OFFSET,
    ROAD_PER_DS,
    ROAD_SIZE,
    ROAD_START,
    SPEED,
    SPEED_GAIN,
    SPEED_KMH,
    STEPS_DONE,
    STEPS_TOTAL,
    ControlStepWorkspace,
    FleetParameters,
    FleetState,
    IntervalInputs,
    StepOutput,
    advance_blocks,
    allocate_workspace,
)
from road_envs.kernels.normal_numbers import generator_state
from road_envs.kernels.simd import LANES
from road_envs.roads.surface import PAD
from road_envs.sensing.data_logger import DataLogger, Instruments
from road_envs.simulation.drive import DriveSimulator, Trajectory
from road_envs.simulation.fleet import NO_MANOEUVRE, run_in_threads
from road_envs.simulation.lanes import aligned_copy, aligned_zeros, transpose_constants
from road_envs.simulation.manoeuvres import Manoeuvre
from road_envs.vehicle.equations import AXLE, PHI, THETA, Z_B, Plant, sensor_row
from road_envs.vehicle.parameters import VehicleParameters

COORDINATES = {None: [Z_B, PHI, THETA], 0: [AXLE, AXLE + 1, THETA], 1: [AXLE + 2, AXLE + 3, THETA]}
"""Coordinates that move a sensor on the body, the front and the rear axle; no axle pitches."""


def sensor_columns(logger: DataLogger) -> np.ndarray:
    """Return the coordinates (k, 3) whose accelerations each sensor measures."""
    return np.array([COORDINATES[location.axle] for location in logger.locations])


def sensor_rows(logger: DataLogger) -> np.ndarray:
    """Return the factors (k, 3) of these accelerations."""
    return np.array([sensor_row(*x)[COORDINATES[x.axle]] for x in logger.locations])


class InstrumentedFleet:
    """`n_vehicles` equal instrumented vehicles: `start` begins a drive, `advance` moves all.

    A control interval has `steps` steps of `step` [s], a whole number of samples of the
    `instruments`. With `truth`, `StepOutput` holds the road and the tyre loads; with `keep_signals`
    `last_interval` returns the motion. Blocks are spread over `threads`. The state is plain NumPy,
    so copies and pickles work. Raises ConfigError if the instruments cannot sample at these steps,
    and on a flexible frame.

    `weights` are those of the three costs in the reward; `top_speed` [m/s] is the highest speed
    observed; `planar` and `struts` add these groups to the observation. `unresolved_variance`
    returns, for a speed [m/s], the share (256,) [-] of the road's variance that each command byte
    leaves unresolved, a fourth cost with the weight `unresolved_variance_weight`.
    """

    def __init__(
        self,
        plant: Plant,
        car: VehicleParameters,
        instruments: Instruments,
        *,
        step: float,
        steps: int,
        n_vehicles: int = 1,
        manoeuvre: Manoeuvre | None = None,
        weights: tuple[float, float, float] = (0.0, 0.0, 0.0),
        top_speed: float = np.inf,
        planar: bool = False,
        struts: bool = False,
        unresolved_variance: Callable[[float], np.ndarray] | None = None,
        unresolved_variance_weight: float = 0.0,
        truth: bool = True,
        keep_signals: bool = False,
        threads: int = 1,
    ):
        if plant.flexible:
            raise ConfigError(
                "an instrumented fleet does not support a flexible frame; use a vehicle variation "
                "without one"
            )
        logger = DataLogger(instruments, car, step, np.random.default_rng(0))
        if steps % logger.decimation:
            raise ConfigError(
                f"an interval of {steps} steps of {step} s must hold a whole number of samples at "
                f"{instruments.fs} Hz"
            )
        self.plant, self.car, self.manoeuvre = plant, car, manoeuvre
        self.step, self.steps, self.n_vehicles, self.truth = step, steps, n_vehicles, truth
        self.threads, self.samples = threads, steps // logger.decimation
        blocks = ceil(n_vehicles / LANES)
        delay, constants = round(car.valve.delay / step), np.repeat(plant.constants, LANES)
        self.parameters = FleetParameters(
            lane_constants=transpose_constants(constants),
            constants=constants,
            velocity=plant.velocity,
            displacement=plant.displacement,
            delay=np.full(LANES, delay),
            alpha=aligned_copy(np.full(LANES, 1.0 - np.exp(-step / car.valve.lag))),
            per_static_load=1.0 / np.repeat(car.tyre_loads, 2),
            weights=np.array(weights, dtype=float),
            antialias_sos=logger.sos,
            wk_sos=wk_sos(1.0 / step),
            noise_std=logger.noise_std,
            range=logger.range,
            noisy=int(logger.noise_std.any()),
            sensor_columns=sensor_columns(logger),
            top_speed=float(top_speed),
            h=step,
            decimation=logger.decimation,
            planar=int(planar),
            struts=int(struts),
        )
        k = logger.range.size
        self.observation_size = k * self.samples + 5
        self.observation_size += planar * N_PLANAR + struts * N_STRUT_SIGNALS
        self.unresolved_variance = unresolved_variance
        self.unresolved_variance_weight = unresolved_variance_weight
        self.unresolved = np.zeros((n_vehicles, 256 if unresolved_variance else 0))
        sections = len(logger.sos), len(self.parameters.wk_sos)
        self.state = _initial_state(blocks, plant.n_dof, delay, *sections, k)
        self.road_heights = np.zeros((blocks, LANES * 2 * (4 + 2 * PAD)))
        self._resize_roads(4 + 2 * PAD)
        self._moving = np.arange(blocks)
        self._commands = np.zeros(blocks * LANES, dtype=np.uint8)
        self._workspaces = [
            allocate_workspace(steps, self.samples, k, keep_signals)
            for _ in range(min(threads, blocks))
        ]

    def start(self, i: int, drive: DriveSimulator, logger: DataLogger, speed_kmh: float) -> None:
        """Start vehicle `i` on a `drive` at constant speed, measured by `logger`.

        `speed_kmh` is the speed reported in the output.
        """
        b, k = divmod(i, LANES)
        self._set_road(b, k, drive)
        state = self.state
        state.q[b, :, k], state.v[b, :, k] = np.split(drive.state, 2)
        state.strut_state[b, :, :, k], state.valves[b, 0, k] = drive.strut_state, 1.0
        state.delay_line[b, :, k] = drive.delay_line
        state.antialias_state[b, ..., k], state.wk_state[b, ..., k] = 0.0, 0.0
        state.sensor_rows[b, ..., k] = sensor_rows(logger)
        kinematics, counts = state.kinematics[b, :, k], state.counts[b, :, k]
        kinematics[DRIVE_START], kinematics[SPEED] = drive.start, drive.speed
        kinematics[SPEED_GAIN], kinematics[SPEED_KMH] = logger.speed_gain, speed_kmh
        counts[STEPS_DONE], counts[STEPS_TOTAL] = 0, drive.steps_left
        state.noise_state[b, :, k] = generator_state(logger.rng)
        if self.unresolved_variance is not None:
            self.unresolved[i] = self.unresolved_variance(drive.speed)

    def advance(self, commands: np.ndarray | int, mask: np.ndarray | None = None) -> StepOutput:
        """Advance by one interval under `commands` (N,) uint8 or one for all vehicles.

        With a `mask` (N,) only the vehicles in it advance.

        Output rows outside the mask are undefined.
        """
        self._commands[: self.n_vehicles] = commands
        moving = self._moving if mask is None else np.unique(np.flatnonzero(mask) // LANES)
        # blocks advance as a whole: lanes outside the mask are restored afterwards
        saved = None if mask is None else [field[moving] for field in self.state]
        output, a_xy = self._allocate_output(), self._manoeuvre_inputs()
        inputs = IntervalInputs(self.road_heights, self._commands.reshape(-1, LANES), a_xy)

        side = self.plant.kernel_flags[1:]

        def run(job: np.ndarray, workspace: ControlStepWorkspace) -> None:
            advance_blocks(job, self.state, self.parameters, inputs, workspace, output, *side)

        n = len(self._workspaces)
        jobs = [moving] if n == 1 else np.array_split(moving, n)
        run_in_threads(run, list(zip(jobs, self._workspaces, strict=True)))
        if mask is not None and saved is not None:
            self._restore_unmasked(moving, mask, saved)
        if self.unresolved_variance is not None:
            self._subtract_information_cost(commands, output.values)
        return output

    def _subtract_information_cost(self, commands: np.ndarray | int, values: np.ndarray) -> None:
        """Subtract the cost of the road variance that the commanded states leave unresolved."""
        interval = self.steps * self.step
        unresolved = self.unresolved[np.arange(self.n_vehicles), commands]
        values[:, OUT_UNRESOLVED] = unresolved
        values[:, OUT_REWARD] -= interval * self.unresolved_variance_weight * unresolved

    @property
    def steps_left(self) -> np.ndarray:
        """Number of steps until the drives are finished (N,)."""
        left = self.state.counts[:, STEPS_TOTAL] - self.state.counts[:, STEPS_DONE]
        return left.ravel()[: self.n_vehicles]

    def write_back(self, i: int, drive: DriveSimulator) -> None:
        """Copy the motion of vehicle `i` into `drive`."""
        b, k = divmod(i, LANES)
        drive.state[:] = np.concatenate([self.state.q[b, :, k], self.state.v[b, :, k]])
        drive.strut_state[:] = self.state.strut_state[b, :, :, k]
        drive.steps = int(self.state.counts[b, STEPS_DONE, k])
        drive.delay_line = self.state.delay_line[b, :, k].copy()

    def last_interval(self, i: int, byte: int) -> Trajectory:
        """Return the motion of vehicle `i` in the last interval, under the command `byte`.

        The fleet must keep its signals and be of one block, since a thread keeps only its last
        block. Raises ValueError.
        """
        last = self._workspaces[0]
        if len(self.road_heights) > 1 or not last.signals.size:
            raise ValueError(
                f"the last interval is kept in fleets of at most {LANES} vehicles, got "
                f"{self.n_vehicles}, and only with keep_signals; make such a fleet"
            )
        first = int(self.state.counts[0, STEPS_DONE, i]) - self.steps
        t = self.step * (first + np.arange(self.steps))
        commands = np.full(self.steps, byte, dtype=np.uint8)
        s, v = last.s[:-1:2, i].copy(), last.v[:-1:2, i].copy()
        return Trajectory(t, s, v, commands, last.signals[:, :, i].copy())

    def _set_road(self, b: int, k: int, drive: DriveSimulator) -> None:
        """Set the road of lane `k` in block `b` to the surface of `drive`."""
        z = drive.surface.z
        size = z.shape[1] + 2 * PAD
        if size > self.road_heights.shape[1] // (2 * LANES):
            self._resize_roads(size)
        capacity = self.road_heights.shape[1] // (2 * LANES)
        for side in range(2):
            offset = (2 * k + side) * capacity
            path = self.road_heights[b, offset : offset + size]
            path[:PAD], path[PAD:-PAD], path[-PAD:] = z[side, 0], z[side], z[side, -1]
        layout = self.state.road_layout[b, :, k]
        layout[ROAD_SIZE] = size
        layout[ROAD_START], layout[ROAD_PER_DS] = drive.surface.start, 1.0 / drive.surface.ds

    def _resize_roads(self, capacity: int) -> None:
        """Reallocate the roads with `capacity` samples per wheel path of every lane."""
        blocks, old = len(self.road_heights), self.road_heights.shape[1] // (2 * LANES)
        heights = np.zeros((blocks, 2 * LANES, capacity))
        common = min(old, capacity)
        heights[:, :, :common] = self.road_heights.reshape(blocks, 2 * LANES, old)[:, :, :common]
        self.road_heights = heights.reshape(blocks, 2 * LANES * capacity)
        offsets = capacity * np.arange(2.0 * LANES).reshape(LANES, 2)
        self.state.road_layout[:, ROAD_OFFSET:ROAD_SIZE] = offsets.T

    def _manoeuvre_inputs(self) -> np.ndarray:
        """Return alternating a_x, a_y (B or 1, ..., LANES) for the next interval."""
        if self.manoeuvre is None:
            return NO_MANOEUVRE[None]
        done = self.state.counts[:, STEPS_DONE]
        instants = 0.5 * self.step * (2 * done[:, None] + np.arange(2 * self.steps + 1)[:, None])
        a_xy = self.manoeuvre.at(instants)
        return np.moveaxis(a_xy, -1, 2).reshape(len(done), 4 * self.steps + 2, LANES)

    def _allocate_output(self) -> StepOutput:
        size = self.n_vehicles
        return StepOutput(
            np.empty((size, self.observation_size), dtype=np.float32),
            np.empty((size, len(OUTPUT_COLUMNS))),
            np.empty((size, 3), dtype=np.int64),
            np.empty((size, N_TRUE * self.truth, self.samples)),
        )

    def _restore_unmasked(
        self, moving: np.ndarray, mask: np.ndarray, saved: list[np.ndarray]
    ) -> None:
        """Restore the state of the vehicles outside the `mask` after an interval."""
        unmasked = np.ones(len(self.road_heights) * LANES, dtype=bool)
        unmasked[: self.n_vehicles] = ~mask
        for field, before in zip(self.state, saved, strict=True):
            for j, b in enumerate(moving):
                lanes = unmasked[b * LANES : (b + 1) * LANES]
                field[b][..., lanes] = before[j][..., lanes]


def _initial_state(
    blocks: int,
    n_dof: int,
    delay: int,
    antialias_sections: int,
    wk_sections: int,
    sensors: int,
) -> FleetState:
    """Return the state of vehicles at rest on level ground, in all lanes of every block."""
    state = FleetState(
        q=aligned_zeros(blocks, n_dof),
        v=aligned_zeros(blocks, n_dof),
        strut_state=aligned_zeros(blocks, 4, 3),
        valves=aligned_zeros(blocks, 2),
        delay_line=np.zeros((blocks, delay, LANES), dtype=np.uint8),
        antialias_state=aligned_zeros(blocks, antialias_sections, sensors, 2),
        wk_state=aligned_zeros(blocks, wk_sections, 1, 2),
        sensor_rows=aligned_zeros(blocks, sensors, 3),
        noise_state=np.zeros((blocks, 4, LANES), dtype=np.uint64),
        counts=np.zeros((blocks, 2, LANES), dtype=np.int64),
        kinematics=aligned_zeros(blocks, 4),
        road_layout=aligned_zeros(blocks, 5),
    )
    state.valves[:, 0] = 1.0
    state.road_layout[:, ROAD_SIZE], state.road_layout[:, ROAD_PER_DS] = 4.0 + 2.0 * PAD, 1.0
    return state
