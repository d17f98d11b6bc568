"""Fleet of simulators, each with its own vehicle, surface, speed and commands.

Blocks of LANES vehicles take the steps of `road_envs.simulation.fleet`. The result of a vehicle
does not depend on the others, so it is the same for any number of vehicles and threads.
"""

from collections.abc import Sequence

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import LANES, broadcast
from road_envs.kernels.simd_arrays import get, put, stack_rows
from road_envs.roads.surface import Surface
from road_envs.simulation.drive import DriveInputs, DriveSimulator
from road_envs.simulation.fleet import (
    NO_MANOEUVRE,
    LaneScratch,
    RoadBuffers,
    delay_commands,
    front_axle_stations,
    run_in_threads,
    take_step,
)
from road_envs.simulation.lanes import aligned_copy, aligned_zeros, lane_buffers
from road_envs.simulation.rosenbrock import (
    N_SIDE_SIGNALS,
    SIDE,
    TWIST,
    WORKSPACE_ROWS,
    n_signals,
    step_workspace,
)


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
