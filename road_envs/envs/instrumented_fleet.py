"""Fleet of instrumented vehicles, each on its own road, advanced by control intervals.

It is the simulator behind the environments, recordings and comparisons of policies. The result of
a vehicle does not depend on the other vehicles, so single and vector environments agree to the bit.
"""

from collections.abc import Callable
from math import ceil
from typing import NamedTuple

import numpy as np

from road_envs.analysis.comfort import wk_sos
from road_envs.core.config import ConfigError
from road_envs.envs import fleet_arrays as fa
from road_envs.envs.control_step import advance_blocks
from road_envs.envs.safety_step import SAFETY_COLUMNS, safety_parameters
from road_envs.kernels.normal_numbers import generator_state
from road_envs.kernels.simd import LANES
from road_envs.roads.surface import PAD
from road_envs.sensing.data_logger import DataLogger, Instruments
from road_envs.simulation.drive import DriveSimulator, Trajectory
from road_envs.simulation.fleet import NO_MANOEUVRE, run_in_threads
from road_envs.simulation.lanes import aligned_zeros
from road_envs.simulation.manoeuvres import Manoeuvre
from road_envs.simulation.rosenbrock import N_SIGNALS
from road_envs.vehicle.equations import AXLE, PHI, THETA, Z_B, Plant, sensor_row
from road_envs.vehicle.parameters import VehicleParameters

COORDINATES = {None: [Z_B, PHI, THETA], 0: [AXLE, AXLE + 1, THETA], 1: [AXLE + 2, AXLE + 3, THETA]}
"""Coordinates that move a sensor on the body, the front and the rear axle; no axle pitches."""


class FleetSettings(NamedTuple):
    """Settings that all vehicles of a fleet share.

    A control interval has `steps` steps of `step` [s], a whole number of samples of the
    `instruments`. `top_speed` [m/s] is the highest speed observed; `planar` and `struts` add these
    groups to the observation. With `truth`, `StepOutput` holds the road and the tyre loads.

    All drive at constant speed in the same `manoeuvre`; `weights` are those of the three costs in
    the reward. `unresolved_variance` returns, for a speed [m/s], the share (256,) [-] of the road's
    variance that each command byte leaves unresolved, a fourth cost of its own weight. With
    `individual`, every drive has its own car, speed profile, manoeuvre and sensor faults, and the
    output has SAFETY_COLUMNS; weights and `manoeuvre` have no effect.
    """

    instruments: Instruments
    step: float
    steps: int
    manoeuvre: Manoeuvre | None = None
    weights: tuple[float, float, float] = (0.0, 0.0, 0.0)
    top_speed: float = np.inf
    planar: bool = False
    struts: bool = False
    unresolved_variance: Callable[[float], np.ndarray] | None = None
    unresolved_variance_weight: float = 0.0
    truth: bool = True
    individual: bool = False


class InstrumentedFleet:
    """`n_vehicles` instrumented vehicles: `start` begins a drive, `advance` moves all.

    `plant` and `car` are the described vehicle. At most `distinct` vehicles, by default all, are
    started by `start`, and others by `share`. With `keep_signals` `last_interval` returns the
    motion. Blocks are spread over `threads`. Copies and pickles work. Raises ConfigError if the
    instruments cannot sample at these steps, on a flexible frame, and when two threads advance one
    fleet at once.
    """

    def __init__(
        self,
        plant: Plant,
        car: VehicleParameters,
        settings: FleetSettings,
        n_vehicles: int = 1,
        *,
        distinct: int | None = None,
        keep_signals: bool = False,
        threads: int = 1,
    ):
        if plant.flexible:
            raise ConfigError(
                "an instrumented fleet does not support a flexible frame; use a vehicle variation "
                "without one"
            )
        step, steps, instruments = settings.step, settings.steps, settings.instruments
        logger = DataLogger(instruments, car, step, np.random.default_rng(0))
        if steps % logger.decimation:
            text = f"an interval of {steps} steps of {step} s must hold a whole number of samples"
            raise ConfigError(f"{text} at {instruments.fs} Hz")
        self.plant, self.car, self.settings = plant, car, settings
        self.step, self.steps, self.n_vehicles = step, steps, n_vehicles
        self.threads, self.samples = threads, steps // logger.decimation
        blocks, delay = ceil(n_vehicles / LANES), round(car.valve.delay / step)
        self.cars = fa.LaneCars(plant, car, step, blocks, settings.individual)
        self.safety = safety_parameters(car, step) if settings.individual else None
        self.columns = SAFETY_COLUMNS if settings.individual else fa.OUTPUT_COLUMNS
        self.parameters = fa.FleetParameters(
            delay=np.full(LANES, delay),
            per_static_load=1.0 / np.repeat(car.tyre_loads, 2),
            weights=np.array(settings.weights, dtype=float),
            antialias_sos=logger.sos,
            wk_sos=wk_sos(1.0 / step),
            noise_std=logger.noise_std,
            range=logger.range,
            noisy=int(logger.noise_std.any()),
            sensor_columns=np.array([COORDINATES[x.axle] for x in logger.locations]),
            top_speed=float(settings.top_speed),
            h=step,
            decimation=logger.decimation,
            planar=int(settings.planar),
            struts=int(settings.struts),
        )
        k = logger.range.size
        optional = settings.planar * fa.N_PLANAR + settings.struts * fa.N_STRUT_SIGNALS
        self.observation_size = k * self.samples + 5 + optional
        self.unresolved = np.zeros((n_vehicles, 256 if settings.unresolved_variance else 0))
        self.state = self._initial_state(blocks, delay, k)
        rows = n_vehicles if distinct is None else distinct
        self._rows: dict[int, int] = {}  # of roads and profiles, by vehicle
        self.road_heights = np.zeros((2 * rows, 4 + 2 * PAD))
        self._profiles = np.zeros((rows * settings.individual, 4, 1))
        self._moving = np.arange(blocks)
        self._commands = np.zeros(blocks * LANES, dtype=np.uint8)
        self._workspaces = [
            fa.ControlStepWorkspace(
                delayed=np.zeros((steps, LANES), dtype=np.uint8),
                s=aligned_zeros(2 * steps + 1),
                v=aligned_zeros(2 * steps + 1),
                a_xy=aligned_zeros(4 * steps + 2),
                noise=aligned_zeros(k, steps),
                samples=np.zeros((k, self.samples, LANES), dtype=np.float32),
                signals=aligned_zeros(keep_signals * steps, N_SIGNALS),
            )
            for _ in range(min(threads, blocks))
        ]
        self._idle = [True]  # emptied by the thread that advances: taking from a list is atomic

    def start(self, i: int, drive: DriveSimulator, logger: DataLogger, speed_kmh: float) -> None:
        """Start vehicle `i` on a `drive` measured by `logger`, with `speed_kmh` in its output."""
        b, k = divmod(i, LANES)
        row = self._rows.setdefault(i, len(self._rows))
        self._set_road(i, row, drive)
        state = self.state
        state.q[b, :, k], state.v[b, :, k] = np.split(drive.state, 2)
        state.strut_state[b, :, :, k], state.valves[b, 0, k] = drive.strut_state, 1.0
        state.delay_line[b, :, k] = drive.delay_line
        state.antialias_state[b, ..., k], state.wk_state[b, ..., k] = 0.0, 0.0
        state.high_pass_state[b, ..., k], state.off[b, ..., k] = 0.0, 0.0
        rows = [sensor_row(*x)[COORDINATES[x.axle]] for x in logger.locations]
        readings = logger.faults.readings(len(logger.range))
        state.mounting[b, ..., k] = np.column_stack([rows, *readings])
        kinematics, counts = state.kinematics[b, :, k], state.counts[b, :, k]
        kinematics[:] = drive.start, drive.speed, speed_kmh, logger.speed_gain
        counts[:] = 0, drive.steps_left, row
        state.noise_state[b, :, k] = generator_state(logger.rng)
        if self.settings.unresolved_variance is not None:
            self.unresolved[i] = self.settings.unresolved_variance(drive.speed)
        if self.settings.individual:
            self.cars.put(i, drive.plant, drive.car)
            # at least one interval, which a drive that has ended repeats
            s, v, a_xy = drive.half_step_inputs(max(drive.steps_left, self.steps))
            if (more := s.size - self._profiles.shape[2]) > 0:
                self._profiles = np.pad(self._profiles, ((0, 0), (0, 0), (0, more)))
            self._profiles[row, :, : s.size] = s, v, *a_xy.T

    def share(self, i: int, others: range) -> None:
        """Start the vehicles `others` on the drive of vehicle `i`, which all then share."""
        self.copy_vehicles(np.full(len(others), i), np.array(others, dtype=int))
        for other in others if self.settings.individual else ():
            self.cars.share(i, other)

    def copy_vehicles(self, source: np.ndarray, target: np.ndarray | None = None) -> None:
        """Give vehicle `target[j]`, by default j, the motion of `source[j]`, on an equal drive."""
        target = np.arange(source.size) if target is None else target
        (b, k), (b_new, k_new) = np.divmod(source, LANES), np.divmod(target, LANES)
        for field in self.state:
            field[b_new, ..., k_new] = field[b, ..., k]

    def copy_state(self) -> list[np.ndarray]:
        """Return a copy of the state of all vehicles, for `restore_state`."""
        return [field.copy() for field in self.state]

    def restore_state(self, saved: list[np.ndarray]) -> None:
        """Put all vehicles back to a saved state, on the drives that they had then."""
        for field, old in zip(self.state, saved, strict=True):
            field[...] = old

    def advance(self, commands: np.ndarray | int, mask: np.ndarray | None = None) -> fa.StepOutput:
        """Advance by one interval under `commands` (N,) uint8 or one for all vehicles. With a
        `mask` (N,) only the vehicles in it advance; output rows outside it are undefined.
        """
        try:
            self._idle.pop()
        except IndexError:
            text = "an environment is stepped by two threads at once; make one for each thread"
            raise ConfigError(text) from None
        try:
            return self._advance(commands, mask)
        finally:
            self._idle.append(True)

    def _advance(self, commands: np.ndarray | int, mask: np.ndarray | None) -> fa.StepOutput:
        self._commands[: self.n_vehicles] = commands
        moving, size = self._moving, self.n_vehicles
        if mask is not None:  # blocks advance as a whole: lanes outside it are restored afterwards
            moving = np.unique(np.flatnonzero(mask) // LANES)
            of_blocks = LANES * moving[:, None] + np.arange(LANES)
            b, k = np.divmod(np.setdiff1d(of_blocks, np.flatnonzero(mask)), LANES)
            saved = [field[b, ..., k] for field in self.state]
        output = fa.StepOutput(
            np.empty((size, self.observation_size), dtype=np.float32),
            np.empty((size, len(self.columns))),
            np.empty((size, 3), dtype=np.int64),
            np.empty((size, fa.N_TRUE * self.settings.truth, self.samples)),
        )
        heights, lanes = self.road_heights.ravel(), self._commands.reshape(-1, LANES)
        inputs = fa.IntervalInputs(heights, lanes, self._manoeuvre_inputs(), self._profiles)
        common = self.state, self.parameters, self.cars.buffers, inputs
        rest = output, self.safety, *self.plant.kernel_flags[1:]
        n = len(self._workspaces)
        jobs = [moving] if n == 1 else np.array_split(moving, n)
        shares = zip(jobs, self._workspaces, strict=True)
        run_in_threads(advance_blocks, [(job, *common, own, *rest) for job, own in shares])
        if mask is not None:
            for field, before in zip(self.state, saved, strict=True):
                field[b, ..., k] = before
        if self.settings.unresolved_variance is not None:  # the fourth cost
            values, weight = output.values, self.settings.unresolved_variance_weight
            values[:, fa.OUT_UNRESOLVED] = self.unresolved[np.arange(size), commands]
            interval = self.steps * self.step
            values[:, fa.OUT_REWARD] -= interval * weight * values[:, fa.OUT_UNRESOLVED]
        return output

    @property
    def steps_left(self) -> np.ndarray:
        """Number of steps until the drives are finished (N,)."""
        left = self.state.counts[:, fa.STEPS_TOTAL] - self.state.counts[:, fa.STEPS_DONE]
        return left.ravel()[: self.n_vehicles]

    def write_back(self, i: int, drive: DriveSimulator) -> None:
        """Copy the motion of vehicle `i` into `drive`."""
        b, k = divmod(i, LANES)
        drive.state[:] = np.concatenate([self.state.q[b, :, k], self.state.v[b, :, k]])
        drive.strut_state[:] = self.state.strut_state[b, :, :, k]
        drive.steps = int(self.state.counts[b, fa.STEPS_DONE, k])
        drive.delay_line = self.state.delay_line[b, :, k].copy()

    def last_interval(self, i: int, byte: int) -> Trajectory:
        """Return the motion of vehicle `i` in the last interval, under the command `byte`. Raises
        ValueError unless the fleet keeps its signals and has one block: a thread keeps its last.
        """
        last = self._workspaces[0]
        if len(self._moving) > 1 or not last.signals.size:
            raise ValueError(
                f"the last interval is kept in fleets of at most {LANES} vehicles, got "
                f"{self.n_vehicles}, and only with keep_signals; make such a fleet"
            )
        first = int(self.state.counts[0, fa.STEPS_DONE, i]) - self.steps
        t, commands = self.step * (first + np.arange(self.steps)), np.full(self.steps, byte, "u1")
        s, v = last.s[:-1:2, i].copy(), last.v[:-1:2, i].copy()
        return Trajectory(t, s, v, commands, last.signals[:, :, i].copy())

    def _set_road(self, i: int, row: int, drive: DriveSimulator) -> None:
        """Set the road of vehicle `i`, stored in `row`, to the surface of `drive`."""
        z = drive.surface.z
        size, capacity = z.shape[1] + 2 * PAD, self.road_heights.shape[1]
        if size > capacity:
            # an offset is a row times the capacity, for vehicles that share it, too
            offsets = self.state.road_layout[:, fa.ROAD_OFFSET : fa.ROAD_SIZE]
            offsets[:] = np.rint(offsets / capacity) * size
            self.road_heights = np.pad(self.road_heights, ((0, 0), (0, size - capacity)))
        b, k = divmod(i, LANES)
        layout = self.state.road_layout[b, :, k]
        for side in range(2):
            path = self.road_heights[2 * row + side]
            path[:size] = np.pad(z[side], PAD, mode="edge")
            layout[fa.ROAD_OFFSET + side] = path.size * (2 * row + side)
        layout[fa.ROAD_SIZE :] = size, drive.surface.start, 1.0 / drive.surface.ds

    def _manoeuvre_inputs(self) -> np.ndarray:
        """Return alternating a_x, a_y (B or 1, ..., LANES) for the next interval."""
        manoeuvre = self.settings.manoeuvre
        if manoeuvre is None:
            return NO_MANOEUVRE[None]
        done = self.state.counts[:, fa.STEPS_DONE]
        instants = 0.5 * self.step * (2 * done[:, None] + np.arange(2 * self.steps + 1)[:, None])
        a_xy = manoeuvre.at(instants)
        return np.moveaxis(a_xy, -1, 2).reshape(len(done), 4 * self.steps + 2, LANES)

    def _initial_state(self, blocks: int, delay: int, sensors: int) -> fa.FleetState:
        """Return the state of vehicles at rest on level ground, in all lanes of every block."""
        parameters, n_dof, individual = self.parameters, self.plant.n_dof, self.settings.individual
        high_pass = 0 if self.safety is None else len(self.safety.high_pass_sos)
        state = fa.FleetState(
            q=aligned_zeros(blocks, n_dof),
            v=aligned_zeros(blocks, n_dof),
            strut_state=aligned_zeros(blocks, 4, 3),
            valves=aligned_zeros(blocks, 2),
            delay_line=np.zeros((blocks, delay, LANES), dtype=np.uint8),
            antialias_state=aligned_zeros(blocks, len(parameters.antialias_sos), sensors, 2),
            wk_state=aligned_zeros(blocks, len(parameters.wk_sos), 1 + individual, 2),
            high_pass_state=aligned_zeros(blocks, high_pass, 4, 2),
            off=aligned_zeros(blocks, 2 * individual),
            mounting=aligned_zeros(blocks, sensors, 5),
            noise_state=np.zeros((blocks, 4, LANES), dtype=np.uint64),
            counts=np.zeros((blocks, 3, LANES), dtype=np.int64),
            kinematics=aligned_zeros(blocks, 4),
            road_layout=aligned_zeros(blocks, 5),
        )
        state.valves[:, 0] = 1.0
        state.road_layout[:, fa.ROAD_SIZE] = 4.0 + 2.0 * PAD
        state.road_layout[:, fa.ROAD_PER_DS] = 1.0
        return state
