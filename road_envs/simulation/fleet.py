"""Simulation of many vehicles at once: LANES of them per SIMD vector, blocks of lanes over threads.

Every vehicle has its own parameters, surface, speed and commands. The step is `rosenbrock.step`,
compiled for vectors (`simd`); only the valves are advanced lane by lane. The result of a lane
depends on its own vehicle only, so it is the same for any number of vehicles and threads.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import (
    LANES,
    any_positive,
    broadcast,
    equals_one,
    if_positive,
    integer_part,
    maximum,
    minimum,
)
from road_envs.kernels.simd_arrays import get, load_four, put, stack_rows
from road_envs.roads.surface import PAD, Surface, catmull_rom
from road_envs.simulation.drive import DriveInputs, DriveSimulator
from road_envs.simulation.lanes import (
    aligned_copy,
    aligned_zeros,
    lane_buffers,
    update_lane_valves,
)
from road_envs.simulation.rosenbrock import (
    N_SIDE_SIGNALS,
    SIDE,
    TWIST,
    WORKSPACE_ROWS,
    StepInputs,
    StepWorkspace,
    any_step,
    n_signals,
    step_workspace,
)
from road_envs.simulation.substeps import SUBSTEPS, interpolate, mark_steep
from road_envs.vehicle.equations import Motion
from road_envs.vehicle.suspension import VehicleBuffers


@cache
def _thread_pool(threads: int) -> ThreadPoolExecutor:
    """Return a persistent pool of `threads` threads."""
    # a new thread starts on its creator's core, and an interval ends before it is migrated
    return ThreadPoolExecutor(threads)


def run_in_threads(run: Callable[..., None], jobs: Sequence[tuple[Any, ...]]) -> None:
    """Call `run(*job)` for each of `jobs` at once: the first in this thread, the others in a pool.

    A job is a thread's whole share, since each one that a pool hands over waits for its threads.
    """
    others = [_thread_pool(len(jobs) - 1).submit(run, *job) for job in jobs[1:]]
    run(*jobs[0])
    for other in others:
        other.result()


class RoadBuffers(NamedTuple):
    """Roads of LANES vehicles: lane k reads `heights` from `first` (2, LANES), left and right.

    `per_ds` (LANES,): samples per metre.
    """

    heights: np.ndarray
    first: np.ndarray
    size: np.ndarray
    start: np.ndarray
    per_ds: np.ndarray


@kernel
def _sample_roads(p, roads, s, speed, road, at):
    """Write heights [m] and rates [m/s] under the wheels to rows `at` ... `at` + 7 of `road`.

    `s`, `speed` (LANES,): stations [m] and speeds [m/s] of the front axles; `road` (16, LANES).
    """
    per_ds, v = get(roads.per_ds), get(speed)
    front = (get(s) - get(roads.start)) * per_ds + PAD
    last = get(roads.size) - 3.0
    for i in range(2):
        u = minimum(maximum(front - (get(p.x, 0) - get(p.x, i)) * per_ds, 1.0), last)
        j = integer_part(u)
        for side in range(2):
            a, b, c, d = load_four(roads.heights, get(roads.first, side) - 1.0, 1, j)
            z, slope = catmull_rom(a, b, c, d, u - j, per_ds)
            put(road, at + 2 * i + side, z)
            put(road, at + 4 + 2 * i + side, slope * v)


@kernel(inline=False, count_references=False)
def delay_commands(delay_line, delay, commands, delayed_commands):
    """Write the commands that reach the valves to `delayed_commands` (N, LANES).

    `commands` (N, LANES), or (1, LANES) if they stay the same, are delayed by `delay` (LANES,)
    steps. The first `delay` rows of `delay_line` (D, LANES) are pending ones, oldest first.
    """
    n, last = delayed_commands.shape[0], commands.shape[0] - 1
    for i in range(n):
        for k in range(LANES):
            sent = i - delay[k]
            delayed_commands[i, k] = delay_line[i, k] if sent < 0 else commands[min(sent, last), k]
    for i in range(delay_line.shape[0]):
        for k in range(LANES):
            sent = i + n - delay[k]
            if sent < 0:
                delay_line[i, k] = delay_line[i + n, k]
            elif i < delay[k]:
                delay_line[i, k] = commands[min(sent, last), k]


@kernel(inline=False, count_references=False)
def front_axle_stations(start, v, done, h, s, speed):
    """Write stations `s` [m] and speeds `speed` [m/s] (M, LANES) at M half steps.

    The vehicles have driven `done` (LANES,) steps from station `start` [m] at speed `v` [m/s].
    """
    for i in range(s.shape[0]):
        put(s, i, get(start) + 0.5 * h * (2.0 * get(done) + i) * get(v))
        put(speed, i, get(v))


@kernel(inline=False)
def _copy_lanes(source, target, kept):
    """Copy the Motion `source` to `target` but in lanes where `kept` (LANES,) is positive."""
    for j in range(min(source.q.shape[0], target.q.shape[0])):
        put(target.q, j, if_positive(get(kept), get(target.q, j), get(source.q, j)))
        put(target.v, j, if_positive(get(kept), get(target.v, j), get(source.v, j)))


NO_MANOEUVRE = aligned_zeros(6)
"""Accelerations a_x, a_y in turn at the three instants of any step without a manoeuvre."""


class LaneScratch(NamedTuple):
    """Scratch of `take_step`, on the stack of its caller: all but `work` are rows of lanes.

    `road` (16,); `front` (2,): heights under the front wheels at the beginning of the last step;
    `steep` (2,): which lanes are, and zeros; `motions` (40,): two Motions; `unused` (38,): signals.
    """

    work: StepWorkspace
    road: np.ndarray
    front: np.ndarray
    steep: np.ndarray
    motions: np.ndarray
    unused: np.ndarray


@kernel
def take_step(lanes, roads, inputs, n, scratch, signals, flexible, side):
    """Take step `n` of the DriveInputs of LaneBuffers over RoadBuffers; `a_xy` may be NO_MANOEUVRE.

    Its signals go to `signals` (29, 32 or 38, LANES). `flexible` is None for rigid frames, and
    `side` without side motion.
    """
    p, q, strut_state = lanes.lane_constants[0], lanes.q, lanes.strut_state
    vehicle = VehicleBuffers(lanes.lane_constants, lanes.velocity, lanes.displacement, strut_state)
    motion, s, speed, h = Motion(q, lanes.v), inputs.s, inputs.v, inputs.h
    road, valves, steep, motions = scratch.road, lanes.valves, scratch.steep, scratch.motions
    manoeuvre = inputs.a_xy.shape[0] > NO_MANOEUVRE.shape[0]
    before, whole = Motion(motions[:10], motions[10:20]), Motion(motions[20:30], motions[30:])
    _sample_roads(p, roads, s[2 * n], speed[2 * n], road, 0)
    _sample_roads(p, roads, s[2 * n + 1], speed[2 * n + 1], road, 8)
    put(scratch.front, 0, get(road, 0))
    put(scratch.front, 1, get(road, 1))
    # valves rarely move: skip those that have settled under an unchanged command
    change = get(inputs.commands, n) - get(valves, 1)
    if any_positive(get(valves, 0) + change * change):
        for k in range(LANES):
            byte, own = inputs.commands[n, k], lanes.constants[k : k + 1]
            if valves[0, k] > 0.0 or byte != valves[1, k]:
                settled = update_lane_valves(own, strut_state, q, k, byte, lanes.alpha[k], h)
                valves[0, k], valves[1, k] = 0.0 if settled else 1.0, byte
    # 0: the whole step, of all lanes unless each is on a steep road; then the parts, of those
    begin, end = 0, 1
    if mark_steep(road, steep):
        begin, end = 1 if equals_one(get(steep, 0)) else 0, 1 + SUBSTEPS
        put(steep, 1, 0.0)
        _copy_lanes(motion, before, steep[1])
    for i in range(begin, end):
        if i == 1 and begin == 0:
            _copy_lanes(motion, whole, steep[1])
            _copy_lanes(before, motion, steep[1])
        for half in range(2 if i > 0 else 0):
            station = interpolate(s[2 * n : 2 * n + 3], i - 1, half)
            rate = interpolate(speed[2 * n : 2 * n + 3], i - 1, half)
            _sample_roads(p, roads, station, rate, road, 8 * half)
        first = (4 * n if manoeuvre else 0) + (2 * (2 * (i - 1) // SUBSTEPS) if i > 0 else 0)
        length = h / SUBSTEPS if i > 0 else h
        a_xy, v = inputs.a_xy[first : first + 4], get(speed, 2 * n + 1)
        step_inputs = StepInputs(road, a_xy, length, v)
        row = signals if i == begin else scratch.unused
        any_step(vehicle, motion, step_inputs, scratch.work, row, flexible, side)
    if end > 1 and begin == 0:
        _copy_lanes(whole, motion, steep[0])


@kernel(inline=False, count_references=False)
def integrate_lanes(lanes, roads, inputs, columns, out, flexible=None, side=None):
    """Integrate the DriveInputs of LaneBuffers over RoadBuffers; `a_xy` may be NO_MANOEUVRE.

    The signals in `columns` (C,) go to `out` (N, C, LANES).
    `flexible`, if given: the vehicles have flexible frames, so there are 32 signals; `side`, if
    given: they have side motion.
    """
    scratch = LaneScratch(
        step_workspace(stack_rows(WORKSPACE_ROWS)), stack_rows(16), stack_rows(2), stack_rows(2),
        stack_rows(40), stack_rows(N_SIDE_SIGNALS),
    )  # fmt: skip
    signals = stack_rows(N_SIDE_SIGNALS)
    if flexible is None and side is not None:
        for j in range(TWIST, SIDE):
            put(signals, j, broadcast(0.0))
    for n in range(inputs.commands.shape[0]):
        take_step(lanes, roads, inputs, n, scratch, signals, flexible, side)
        # writing more columns than the caches hold takes as long as the step itself
        for c in range(columns.size):
            put(out[n], c, get(signals, columns[c]))


class _Block:
    """LANES vehicles in the layout of the kernel; a partial block repeats its last vehicle."""

    def __init__(self, drives: Sequence[DriveSimulator]):
        lane_drives = [*drives, *[drives[-1]] * (LANES - len(drives))]
        self.drives, self.lane_drives = list(drives), lane_drives
        self.h = lane_drives[0].step
        self.lanes = lane_buffers(
            [drive.plant for drive in lane_drives],
            [drive.state for drive in lane_drives],
            [drive.strut_state for drive in lane_drives],
            [drive.car.valve.lag for drive in lane_drives],
            self.h,
        )
        self.flags = lane_drives[0].plant.kernel_flags
        self.roads = _road_buffers([drive.surface for drive in lane_drives])
        self.constant_speed_inputs = _constant_speed_inputs(lane_drives)
        # kept for the next call: the kernel of the system clears fresh memory page by page
        self.half_steps = aligned_zeros(2, 0)
        self.delay = np.array([drive.delay_line.size for drive in lane_drives])
        self.delay_line = np.zeros((self.delay.max(), LANES), dtype=np.uint8)
        for k, drive in enumerate(lane_drives):
            self.delay_line[: drive.delay_line.size, k] = drive.delay_line

    def advance(self, commands: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
        """Take n steps under `commands` (n, vehicles); write the signals to `out` (n, C, LANES)."""
        n, own = len(commands), len(self.drives)
        sent, delayed = np.empty((2, n, LANES), dtype=np.uint8)
        sent[:, :own], sent[:, own:] = commands, commands[:, -1:]
        delay_commands(self.delay_line, self.delay, sent, delayed)
        inputs = self.drive_inputs(delayed)
        integrate_lanes(self.lanes, self.roads, inputs, columns, out, *self.flags)
        for drive in self.drives:
            drive.steps += n

    def drive_inputs(self, commands: np.ndarray) -> DriveInputs:
        """Return the inputs of n steps under the `commands` (n, LANES) that reach the valves."""
        return DriveInputs(*self._half_step_inputs(len(commands)), commands, self.h)

    def _half_step_inputs(self, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return stations, speeds (2 n + 1, LANES) and alternating a_x, a_y (4 n + 2, LANES)."""
        if self.half_steps.shape[1] != 2 * n + 1:
            self.half_steps = aligned_zeros(2, 2 * n + 1)
        s, speed = self.half_steps
        if self.constant_speed_inputs is not None:
            done = np.full(LANES, self.drives[0].steps)
            front_axle_stations(*self.constant_speed_inputs, done, self.h, s, speed)
            return s, speed, NO_MANOEUVRE
        a_xy = aligned_zeros(2 * n + 1, 2)
        for k, drive in enumerate(self.lane_drives):
            s[:, k], speed[:, k], a_xy[:, :, k] = drive.half_step_inputs(n)
        return s, speed, a_xy.reshape(4 * n + 2, LANES)

    def write_back(self) -> None:
        """Copy the motion of the vehicles into their simulators."""
        for k, drive in enumerate(self.drives):
            drive.state[:] = np.concatenate([self.lanes.q[:, k], self.lanes.v[:, k]])
            drive.strut_state[:] = self.lanes.strut_state[:, :, k]
            drive.delay_line = self.delay_line[: self.delay[k], k].copy()


def _constant_speed_inputs(
    drives: Sequence[DriveSimulator],
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return starts [m] and speeds [m/s] if all drives are in step at constant speed, else None."""
    if not all(
        d.speed_profile.is_constant and d.manoeuvre is None and d.steps == drives[0].steps
        for d in drives
    ):
        return None
    return np.array([d.start for d in drives]), np.array([d.speed_profile.v[0] for d in drives])


def _road_buffers(surfaces: Sequence[Surface]) -> RoadBuffers:
    """Return the roads of LANES vehicles; a surface that several share is stored once."""
    sizes = np.array([surface.padded.shape[1] for surface in surfaces])
    distinct = list({id(surface): surface for surface in surfaces}.values())
    first = np.cumsum([0, *(surface.padded.size for surface in distinct)])
    at = {id(surface): i for surface, i in zip(distinct, first[:-1], strict=True)}
    left = np.array([at[id(surface)] for surface in surfaces])
    return RoadBuffers(
        np.concatenate([surface.padded.ravel() for surface in distinct]),
        aligned_copy(np.stack([left, left + sizes]).astype(float)),
        aligned_copy(sizes.astype(float)),
        aligned_copy(np.array([surface.start for surface in surfaces])),
        aligned_copy(np.array([1.0 / surface.ds for surface in surfaces])),
    )


class Fleet:
    """Simulators advanced together, each with its own vehicle, surface, speed and commands.

    All take the same integrator step. The fleet holds their motion until `write_back` copies it
    into the simulators. Blocks of LANES vehicles are spread over `threads`. `columns` selects
    signals, by default all 29 (32 of flexible vehicles); fewer columns save time. Raises
    ConfigError on an empty fleet, on different integrator steps, on a mixture of flexible and rigid
    frames, and on unknown columns.
    """

    def __init__(
        self,
        drives: Sequence[DriveSimulator],
        threads: int = 1,
        columns: Sequence[int] | None = None,
    ):
        if not drives:
            raise ConfigError("a fleet needs at least one drive")
        if len({drive.step for drive in drives}) > 1:
            steps = sorted({drive.step for drive in drives})
            raise ConfigError(f"the drives of a fleet must have one integrator step, got {steps} s")
        if len({drive.plant.flexible for drive in drives}) > 1:
            raise ConfigError("the cars of a fleet must all have a flexible frame, or none of them")
        if len({drive.plant.n_dof for drive in drives}) > 1:
            raise ConfigError(
                "the cars of a fleet must all have side motion, or none of them, and joints of the "
                "axles alike"
            )
        rows = n_signals(drives[0].plant)
        columns = range(rows) if columns is None else columns
        if wrong := [c for c in columns if not 0 <= c < rows]:
            raise ConfigError(f"columns of signals are 0 to {rows - 1}, got {wrong}")
        self.drives, self.threads, self.columns = list(drives), threads, np.array(columns)
        self.blocks = [_Block(drives[i : i + LANES]) for i in range(0, len(drives), LANES)]

    def allocate_signals(self, n: int) -> np.ndarray:
        """Return an array (blocks, n, C, LANES) for the signals of n steps; it can be reused."""
        return aligned_zeros(len(self.blocks), n, self.columns.size)

    def advance(self, commands: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Take n steps; return the signals (blocks, n, C, LANES) at their beginnings.

        `commands` (vehicles, n) are bytes; `out`, if given, is filled and returned. Vehicle k is
        lane k % LANES of block k // LANES, see `select_vehicle`. A vehicle whose motion diverges
        has NaN in its signals and does not affect the others.
        """
        commands = np.asarray(commands, dtype=np.uint8)
        parts = [commands[i * LANES : (i + 1) * LANES].T for i in range(len(self.blocks))]
        out = self.allocate_signals(commands.shape[1]) if out is None else out

        def run(numbers: range) -> None:
            for i in numbers:
                self.blocks[i].advance(parts[i], self.columns, out[i])

        threads, n = min(self.threads, len(self.blocks)), len(self.blocks)
        run_in_threads(run, [(range(i, n, threads),) for i in range(threads)])
        return out

    def write_back(self) -> list[DriveSimulator]:
        """Copy the motion into the simulators and return them."""
        for block in self.blocks:
            block.write_back()
        return self.drives


def select_vehicle(signals: np.ndarray, k: int) -> np.ndarray:
    """Return a view (n, C) of the signals of vehicle `k` in those of a fleet."""
    return signals[k // LANES, :, :, k % LANES]
