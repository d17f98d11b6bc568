"""One control interval of blocks of instrumented vehicles, in one compiled pass.

It integrates the motion (`fleet`), applies noise, clipping and anti-alias filter of the
accelerometers (as `data_logger`) and the W_k filter (`comfort`), and sums the costs, all of them
step by step, so that signals are not stored; only the output of an environment is. Arrays have the
blocks as first axis and LANES as last axis, which the shapes below omit.
"""

from typing import NamedTuple

import numpy as np

from road_envs.envs.failures import END_OF_ROAD, NONFINITE_STEP, ROLLOVER, find_failures
from road_envs.kernels._numba import kernel
from road_envs.kernels.filters import filter_sample
from road_envs.kernels.normal_numbers import fill_normal
from road_envs.kernels.simd import (
    LANES,
    extract_lane,
    maximum,
    minimum,
)
from road_envs.kernels.simd_arrays import add, get, put, stack_rows
from road_envs.simulation.drive import DriveInputs
from road_envs.simulation.fleet import (
    NO_MANOEUVRE,
    LaneScratch,
    RoadBuffers,
    delay_commands,
    front_axle_stations,
    take_step,
)
from road_envs.simulation.lanes import LaneBuffers, aligned_zeros
from road_envs.simulation.rosenbrock import (
    ACCELERATION,
    EXTENSION,
    LOAD,
    N_SIDE_SIGNALS,
    N_SIGNALS,
    WORKSPACE_ROWS,
    step_workspace,
)
from road_envs.vehicle.equations import N_DOF, PHI, THETA, Z_B, extension
from road_envs.vehicle.parameters import GRAVITY

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

STEPS_DONE, STEPS_TOTAL = range(2)
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
    filter states `antialias_state` (B, n, k, 2) and `wk_state` (B, m, 1, 2), `sensor_rows`
    (B, k, 3) as `instrumented_fleet.sensor_rows` returns them for k sensors, and `noise_state`
    (B, 4) as `normal_numbers.generator_state`. `counts` (B, 2): steps done, steps in total.
    `kinematics` (B, 4): station at the start [m], speed [m/s], speed [km/h], gain of the speed
    signal. `road_layout` (B, 5): the fields of `fleet.RoadBuffers` other than the heights.
    """

    q: np.ndarray
    v: np.ndarray
    strut_state: np.ndarray
    valves: np.ndarray
    delay_line: np.ndarray
    antialias_state: np.ndarray
    wk_state: np.ndarray
    sensor_rows: np.ndarray
    noise_state: np.ndarray
    counts: np.ndarray
    kinematics: np.ndarray
    road_layout: np.ndarray


class FleetParameters(NamedTuple):
    """Parameters common to all vehicles.

    Vehicle constants as in `fleet.LaneBuffers`, force tables, command `delay` in steps, valve
    factor `alpha`, `per_static_load` (4,) [1/N], cost `weights` (3,), filters, noise and range (k,)
    [m/s²] of the accelerometers, whether they are `noisy`, and the coordinates `sensor_columns`
    (k, 3) that they measure, `top_speed` [m/s], step `h` [s], steps per sample (`decimation`), and
    flags of the optional observation groups.
    """

    lane_constants: np.ndarray
    constants: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray
    delay: np.ndarray
    alpha: np.ndarray
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


class IntervalInputs(NamedTuple):
    """Inputs of B blocks in one control interval.

    `road_heights` (B, ...); `commands` (B, LANES); `a_xy` (B, 4 n + 2), a_x and a_y [m/s²] of a
    manoeuvre in turn at every half step, or (1, ...) of `fleet.NO_MANOEUVRE`.
    """

    road_heights: np.ndarray
    commands: np.ndarray
    a_xy: np.ndarray


class ControlStepWorkspace(NamedTuple):
    """Scratch of one thread for the n steps of a block."""

    delayed: np.ndarray  # (n,): command bytes
    s: np.ndarray  # (2 n + 1,)
    v: np.ndarray  # (2 n + 1,)
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
    def s(self) -> np.ndarray:
        """Stations of the front axles at the samples [m] (N, k)."""
        return self.truth[:, TRUE_S]

    @property
    def profile(self) -> np.ndarray:
        """Heights under the front wheels at the samples [m] (N, 2, k)."""
        return self.truth[:, TRUE_PROFILE:TRUE_LOADS]

    @property
    def loads(self) -> np.ndarray:
        """Tyre loads at the samples [N] (N, 4, k)."""
        return self.truth[:, TRUE_LOADS:]


def allocate_workspace(
    steps: int, samples: int, sensors: int, keep_signals: bool
) -> ControlStepWorkspace:
    """Allocate the scratch of a thread for intervals of n = `steps`."""
    return ControlStepWorkspace(
        delayed=np.zeros((steps, LANES), dtype=np.uint8),
        s=aligned_zeros(2 * steps + 1),
        v=aligned_zeros(2 * steps + 1),
        noise=aligned_zeros(sensors, steps),
        samples=np.zeros((sensors, samples, LANES), dtype=np.float32),
        signals=aligned_zeros(keep_signals * steps, N_SIGNALS),
    )


@kernel
def _measure(parameters, sensor_rows, antialias_state, signals, i, workspace):
    """Write the filtered accelerations of step `i` to the samples, if it is one of a sample."""
    for j in range(parameters.range.size):
        columns, limit = parameters.sensor_columns[j], parameters.range[j]
        z, phi = get(signals, ACCELERATION + columns[0]), get(signals, ACCELERATION + columns[1])
        heave, roll, pitch = get(sensor_rows, j, 0), get(sensor_rows, j, 1), get(sensor_rows, j, 2)
        true = heave * z + roll * phi + pitch * get(signals, ACCELERATION + columns[2])
        x = true + parameters.noise_std[j] * get(workspace.noise, j, i)
        x = minimum(maximum(x, -limit), limit)
        x = filter_sample(parameters.antialias_sos, antialias_state, j, x)
        if i % parameters.decimation == 0:
            at = i // parameters.decimation
            put(workspace.samples[j], at, minimum(maximum(x, -limit), limit))


@kernel
def _add_costs(parameters, wk_state, signals, sums):
    """Add the squares of one step to the `sums` (6, LANES)."""
    heave = get(signals, ACCELERATION + Z_B)
    heave = filter_sample(parameters.wk_sos, wk_state, 0, heave)
    add(sums, SUM_COMFORT, heave * heave)
    for w in range(4):
        e = get(signals, EXTENSION + w)
        add(sums, SUM_RATTLE, e * e)
        variation = get(signals, LOAD + w) * parameters.per_static_load[w] - 1.0
        add(sums, SUM_TYRE_LOAD, variation * variation)


@kernel(inline=False)
def _write_costs(parameters, n, sums, values):
    """Write the costs and the reward of an interval of `n` steps to `values` (lanes in use, 8)."""
    for k in range(values.shape[0]):
        values[k, OUT_COMFORT] = np.sqrt(sums[SUM_COMFORT, k] / n)
        values[k, OUT_RATTLE] = np.sqrt(sums[SUM_RATTLE, k] / (4 * n))
        values[k, OUT_TYRE_LOAD] = np.sqrt(sums[SUM_TYRE_LOAD, k] / (4 * n))
        cost = 0.0
        for j in range(3):
            cost += parameters.weights[j] * values[k, OUT_COMFORT + j]
        values[k, OUT_REWARD] = -n * parameters.h * cost
        values[k, OUT_UNRESOLVED] = 0.0


@kernel(inline=False)
def _write_observation(parameters, kinematics, samples, commands, observation):
    """Write the observations (lanes in use, S k + 5) of a block."""
    for k in range(observation.shape[0]):
        at, byte = 0, commands[k]
        for j in range(samples.shape[0]):
            for i in range(samples.shape[1]):
                observation[k, at] = samples[j, i, k]
                at += 1
        measured = kinematics[SPEED_GAIN, k] * kinematics[SPEED, k]
        observation[k, at] = min(max(measured, 0.0), parameters.top_speed)
        for wheel in (0, 2):
            observation[k, at + 1 + wheel] = (byte >> wheel) & 1
            observation[k, at + 2 + wheel] = (byte >> (4 + wheel)) & 1


@kernel(inline=False)
def _write_optional_groups(parameters, n, sums, signals, k_0, observation):
    """Write the optional groups to the observations (lanes in use, ...), from column `k_0` on.

    Horizontal specific forces on the inclined body are averaged over the interval. Strut extensions
    and rates are those of the last step, with its `signals`.
    """
    at, lanes = k_0, observation.shape[0]
    if parameters.planar > 0:
        for k in range(lanes):
            for j in range(N_PLANAR):
                mean = sums[SUM_A_X + j, k] / n
                observation[k, at + j] = min(max(mean, -MAX_PLANAR), MAX_PLANAR)
        at += N_PLANAR
    if parameters.struts > 0:
        for w in range(4):
            rate = extension(parameters.lane_constants[0], signals[N_DOF : 2 * N_DOF], w)
            for k in range(lanes):
                e, e_dot = signals[EXTENSION + w, k], extract_lane(rate, k)
                observation[k, at + w] = min(max(e, -MAX_EXTENSION), MAX_EXTENSION)
                observation[k, at + 4 + w] = min(
                    max(e_dot, -MAX_EXTENSION_RATE), MAX_EXTENSION_RATE
                )


@kernel(inline=False)
def _write_truth(s, heights, signals, at, truth):
    """Write station, heights under the front wheels and tyre loads of a step to column `at`."""
    for k in range(truth.shape[0]):
        truth[k, TRUE_S, at] = s[k]
        for side in range(2):
            truth[k, TRUE_PROFILE + side, at] = heights[side, k]
        for w in range(4):
            truth[k, TRUE_LOADS + w, at] = signals[LOAD + w, k]


@kernel(inline=False, count_references=False)
def advance_blocks(blocks, state, parameters, inputs, workspace, output, side=None):
    """Advance the `blocks` (indices) by one control interval under IntervalInputs.

    The rows of `output` are the vehicles; the last block may have lanes without one. `side`, if
    given: the vehicles have side motion.
    """
    delayed = workspace.delayed
    n, h = delayed.shape[0], parameters.h
    scratch = LaneScratch(
        step_workspace(stack_rows(WORKSPACE_ROWS)), stack_rows(16), stack_rows(2), stack_rows(2),
        stack_rows(40), stack_rows(N_SIDE_SIGNALS),
    )  # fmt: skip
    signals, sums = stack_rows(N_SIDE_SIGNALS), stack_rows(N_SUMS)
    for b in blocks:
        rows = slice(b * LANES, min((b + 1) * LANES, output.values.shape[0]))
        lanes = rows.stop - rows.start
        q, v, layout, commands = state.q[b], state.v[b], state.road_layout[b], inputs.commands[b]
        kinematics, counts, a_xy = state.kinematics[b], state.counts[b], inputs.a_xy
        values, events, truth = output.values[rows], output.events[rows], output.truth[rows]
        offset, size = layout[ROAD_OFFSET:ROAD_SIZE], layout[ROAD_SIZE]
        roads = RoadBuffers(
            inputs.road_heights[b], offset, size, layout[ROAD_START], layout[ROAD_PER_DS]
        )
        start, speed = kinematics[DRIVE_START], kinematics[SPEED]
        front_axle_stations(start, speed, counts[STEPS_DONE], h, workspace.s, workspace.v)
        delay_commands(state.delay_line[b], parameters.delay, inputs.commands[b : b + 1], delayed)
        vehicles = LaneBuffers(
            parameters.lane_constants, parameters.constants, parameters.alpha, parameters.velocity,
            parameters.displacement, state.strut_state[b], state.valves[b], q, v,
        )  # fmt: skip
        a_xy = a_xy[b % a_xy.shape[0]]
        manoeuvre = a_xy.shape[0] > NO_MANOEUVRE.shape[0]
        drive_inputs = DriveInputs(workspace.s, workspace.v, a_xy, delayed, h)
        if parameters.noisy > 0:
            fill_normal(state.noise_state[b], lanes, workspace.noise)
        for j in range(N_SUMS):
            put(sums, j, 0.0)
        for k in range(lanes):
            events[k, ROLLOVER] = events[k, NONFINITE_STEP] = -1
        for i in range(n):
            take_step(vehicles, roads, drive_inputs, i, scratch, signals, None, side)
            find_failures(signals, i, events)
            _measure(
                parameters, state.sensor_rows[b], state.antialias_state[b], signals, i, workspace
            )
            _add_costs(parameters, state.wk_state[b], signals, sums)
            if parameters.planar > 0:
                first = 4 * i if manoeuvre else 0
                add(sums, SUM_A_X, get(a_xy, first) - GRAVITY * get(signals, THETA))
                add(sums, SUM_A_Y, get(a_xy, first + 1) + GRAVITY * get(signals, PHI))
            if truth.shape[1] > 0 and i % parameters.decimation == 0:
                at = i // parameters.decimation
                _write_truth(workspace.s[2 * i], scratch.front, signals, at, truth)
            if workspace.signals.shape[0] > 0:
                for j in range(N_SIGNALS):
                    put(workspace.signals[i], j, get(signals, j))
        for k in range(lanes):
            total = 0.0
            for j in range(N_DOF):
                total += q[j, k] + v[j, k]
            if events[k, NONFINITE_STEP] < 0 and not np.isfinite(total):
                events[k, NONFINITE_STEP] = n
            if events[k, NONFINITE_STEP] >= 0:
                for j in range(N_SUMS):
                    sums[j, k] = 0.0
        _write_costs(parameters, n, sums, values)
        observation = output.observation[rows]
        _write_observation(parameters, kinematics, workspace.samples, commands, observation)
        k_0 = workspace.samples.shape[0] * workspace.samples.shape[1] + 5
        _write_optional_groups(parameters, n, sums, signals, k_0, observation)
        for k in range(lanes):
            counts[STEPS_DONE, k] += n
            t = counts[STEPS_DONE, k] * h
            values[k, OUT_T] = t
            values[k, OUT_STATION] = kinematics[DRIVE_START, k] + t * kinematics[SPEED, k]
            values[k, OUT_SPEED_KMH] = kinematics[SPEED_KMH, k]
            events[k, END_OF_ROAD] = counts[STEPS_DONE, k] >= counts[STEPS_TOTAL, k]
