"""One control interval of blocks of instrumented vehicles, in one compiled pass.

It integrates the motion (`fleet`), applies noise, clipping and anti-alias filter of the
accelerometers (as `data_logger`) and the W_k filter (`comfort`), and sums the costs; only the
output of an environment is stored. Arrays have the blocks as first axis and LANES as last axis,
which the shapes below omit.
"""

from typing import NamedTuple

import numpy as np

from road_envs._numba import kernel
from road_envs.sensing.filters import sosfilt_kernel
from road_envs.simulation.drive import DriveInputs
from road_envs.simulation.fleet import (
    RoadBuffers,
    delay_commands,
    front_axle_stations,
    integrate_lanes,
    sample_roads,
)
from road_envs.simulation.lanes import LaneBuffers, aligned_zeros
from road_envs.simulation.rosenbrock import ACCELERATION, EXTENSION, LOAD, N_SIGNALS
from road_envs.simulation.simd import LANES, extract_lane, maximum, minimum
from road_envs.simulation.simd_arrays import get, put, stack_rows
from road_envs.vehicle.equations import DOF, N_DOF, PHI, THETA, Z_B, extension
from road_envs.vehicle.parameters import GRAVITY

ANGLES = tuple(DOF.index(name) for name in ("phi", "theta", "phi_af", "phi_ar"))
MAX_ANGLE = float(np.radians(45.0))
"""Limit [rad] of each of ANGLES, beyond which the small-angle model is invalid."""

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

STEPS_DELAYED, STEPS_DONE, NOISE_ROWS_USED, STEPS_TOTAL = range(4)
DRIVE_START, SPEED, SPEED_KMH, SPEED_GAIN = range(4)
ROAD_OFFSET, ROAD_SIZE, ROAD_START, ROAD_DS = 0, 2, 3, 4
"""Rows of `FleetState.counts`, `FleetState.kinematics` and `FleetState.road_layout`."""


class FleetState(NamedTuple):
    """State that every vehicle keeps between control intervals; blocks first, lanes last.

    Coordinates `q` and rates `v` (B, 7), `strut_state` (B, 4, 3), command `delay_line` (B, D),
    filter states `antialias_state` (B, n, k, 2) and `wk_state` (B, m, 1, 2), `sensor_rows`
    (B, k, 3) as `instrumented_fleet.sensor_rows` returns them for k sensors. `counts` (B, 4): steps
    passed through the delay line, steps done, noise rows used, steps in total. `kinematics` (B, 4):
    station at the start [m], speed [m/s], speed [km/h], gain of the speed signal. `road_layout`
    (B, 5): the fields of `fleet.RoadBuffers` other than the heights.
    """

    q: np.ndarray
    v: np.ndarray
    strut_state: np.ndarray
    delay_line: np.ndarray
    antialias_state: np.ndarray
    wk_state: np.ndarray
    sensor_rows: np.ndarray
    counts: np.ndarray
    kinematics: np.ndarray
    road_layout: np.ndarray


class FleetParameters(NamedTuple):
    """Parameters common to all vehicles.

    Vehicle constants as in `fleet.LaneBuffers`, force tables, command `delay` in steps, valve
    factor `alpha`, `static_load` (4,) [N], cost `weights` (3,), filters, indices `columns` of
    the stored signals, noise and range (k,) [m/s²] of the accelerometers, whether they are `noisy`,
    and the coordinates `sensor_columns` (k, 3) that they measure, `top_speed` [m/s], step `h` [s],
    steps per sample (`decimation`), and flags of the optional observation groups.
    """

    lane_constants: np.ndarray
    constants: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray
    delay: np.ndarray
    alpha: np.ndarray
    static_load: np.ndarray
    weights: np.ndarray
    antialias_sos: np.ndarray
    wk_sos: np.ndarray
    columns: np.ndarray
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

    `road_heights` (B, ...); `noise` (B, LANES, rows, k), standard normal; `commands` (B, LANES);
    `a_xy` (B or 1, 4 n + 2), a_x and a_y [m/s²] of a manoeuvre in turn at every half step.
    """

    road_heights: np.ndarray
    noise: np.ndarray
    commands: np.ndarray
    a_xy: np.ndarray


class ControlStepWorkspace(NamedTuple):
    """Scratch of one thread for the n steps of a block."""

    scalar: np.ndarray  # (1,)
    out: np.ndarray  # (n, 29)
    s: np.ndarray  # (2 n + 1,)
    v: np.ndarray  # (2 n + 1,)
    a: np.ndarray  # (k, n)
    heave: np.ndarray  # (1, n)


class StepOutput(NamedTuple):
    """Output of one control interval with k samples, of N vehicles with S accelerometers.

    `observation` (N, S k + 5 or more) float32, see `RoadReconEnv`; `values` (N, 8), see
    OUTPUT_COLUMNS; `end_of_road` (N,), whether the vehicle has left its road; `rollover` (N,),
    4 i + column of ANGLES if an angle first exceeds MAX_ANGLE in step i, else -1; `nonfinite_step`
    (N,), the first step with a non-finite motion, else -1. The ground truth `s` (N, k) [m],
    `profile` (N, 2, k) [m] and `loads` (N, 4, k) [N] is empty unless requested.
    """

    observation: np.ndarray
    values: np.ndarray
    end_of_road: np.ndarray
    rollover: np.ndarray
    nonfinite_step: np.ndarray
    s: np.ndarray
    profile: np.ndarray
    loads: np.ndarray


def workspace_buffer(steps: int, sensors: int) -> np.ndarray:
    """Allocate the buffer (rows, LANES) of a ControlStepWorkspace for intervals of n = `steps`."""
    return aligned_zeros(1 + (N_SIGNALS + 5 + sensors) * steps + 2)


@kernel
def workspace_views(buffer, n, sensors):
    """Return the ControlStepWorkspace for `n` steps as views into a `workspace_buffer`."""
    scalar, at = buffer[:1], 1
    out, at = buffer[at : at + N_SIGNALS * n].reshape(n, N_SIGNALS, LANES), at + N_SIGNALS * n
    s, at = buffer[at : at + 2 * n + 1], at + 2 * n + 1
    v, at = buffer[at : at + 2 * n + 1], at + 2 * n + 1
    a, at = buffer[at : at + sensors * n].reshape(sensors, n, LANES), at + sensors * n
    heave = buffer[at : at + n].reshape(1, n, LANES)
    return ControlStepWorkspace(scalar, out, s, v, a, heave)


@kernel(inline=False)
def _first_nonfinite(out, k):
    """Return the first step of lane `k` with a non-finite signal at its beginning, or n."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            if not np.isfinite(out[i, j, k]):
                return i
    return out.shape[0]


@kernel(inline=False)
def _first_rollover(out, k):
    """Return 4 i + column of ANGLES for the first step i of lane `k` beyond MAX_ANGLE, or -1."""
    for i in range(out.shape[0]):
        for column in range(len(ANGLES)):
            if abs(out[i, ANGLES[column], k]) > MAX_ANGLE:
                return len(ANGLES) * i + column
    return -1


@kernel(inline=False)
def _find_failures(out, q, v, largest, nonfinite_step, rollover):
    """Write the first failures of the lanes in use (k,); zero the signals of diverged lanes."""
    for k in range(rollover.size):
        total = 0.0
        for j in range(N_DOF):
            total += q[j, k] + v[j, k]
        nonfinite_step[k] = -1
        if not np.isfinite(total):
            nonfinite_step[k] = _first_nonfinite(out, k)
            out[:, :, k] = 0.0  # keeps the output and the filter states finite
    # a vector maximum over the block first: the search lane by lane is then rarely needed
    put(largest, 0, 0.0)
    for i in range(out.shape[0]):
        for angle in ANGLES:
            x = get(out[i], angle)
            put(largest, 0, maximum(get(largest, 0), maximum(x, -x)))
    for k in range(rollover.size):
        rollover[k] = _first_rollover(out, k) if largest[0, k] > MAX_ANGLE else -1


@kernel(inline=False)
def _sample_accelerometers(parameters, sensor_rows, antialias_state, noise, used, out, a):
    """Write the filtered accelerometer signals of an interval to `a` (k, n, LANES).

    `used` (lanes in use,): the rows of their `noise` that are used up.
    """
    n = out.shape[0]
    a[:] = 0.0
    if parameters.noisy > 0:
        for k in range(used.size):
            for i in range(n):
                for j in range(a.shape[0]):
                    a[j, i, k] = noise[k, used[k] + i, j]
            used[k] += n
    for j in range(a.shape[0]):
        heave, roll, pitch = get(sensor_rows, j, 0), get(sensor_rows, j, 1), get(sensor_rows, j, 2)
        columns, limit = parameters.sensor_columns[j], parameters.range[j]
        std = parameters.noise_std[j]
        for i in range(n):
            z, phi = get(out[i], ACCELERATION + columns[0]), get(out[i], ACCELERATION + columns[1])
            true = heave * z + roll * phi + pitch * get(out[i], ACCELERATION + columns[2])
            x = true + std * get(a, j, i)
            put(a[j], i, minimum(maximum(x, -limit), limit))
    sosfilt_kernel(parameters.antialias_sos, antialias_state, a, a)


@kernel(inline=False)
def _sum_costs(parameters, wk_state, out, heave, scalar, values):
    """Write the costs and the reward of an interval to `values` (lanes in use, 8)."""
    n = out.shape[0]
    put(scalar, 0, 0.0)
    for i in range(n):
        put(heave[0], i, get(out[i], ACCELERATION + Z_B))
    sosfilt_kernel(parameters.wk_sos, wk_state, heave, heave)
    comfort = rattle = load = get(scalar, 0)
    for i in range(n):
        x = get(heave, 0, i)
        comfort = comfort + x * x
        for w in range(4):
            e = get(out[i], EXTENSION + w)
            rattle = rattle + e * e
            variation = get(out[i], LOAD + w) / parameters.static_load[w] - 1.0
            load = load + variation * variation
    for k in range(values.shape[0]):
        values[k, OUT_COMFORT] = np.sqrt(extract_lane(comfort, k) / n)
        values[k, OUT_RATTLE] = np.sqrt(extract_lane(rattle, k) / (4 * n))
        values[k, OUT_TYRE_LOAD] = np.sqrt(extract_lane(load, k) / (4 * n))
        cost = 0.0
        for j in range(3):
            cost += parameters.weights[j] * values[k, OUT_COMFORT + j]
        values[k, OUT_REWARD] = -n * parameters.h * cost
        values[k, OUT_UNRESOLVED] = 0.0


@kernel(inline=False)
def _write_observation(parameters, kinematics, a, commands, observation):
    """Write the observations (lanes in use, S k + 5) of a block."""
    for k in range(observation.shape[0]):
        at, byte = 0, commands[k]
        for j in range(a.shape[0]):
            high = parameters.range[j]
            for i in range(0, a.shape[1], parameters.decimation):
                observation[k, at] = min(max(a[j, i, k], -high), high)
                at += 1
        measured = kinematics[SPEED_GAIN, k] * kinematics[SPEED, k]
        observation[k, at] = min(max(measured, 0.0), parameters.top_speed)
        for wheel in (0, 2):
            observation[k, at + 1 + wheel] = (byte >> wheel) & 1
            observation[k, at + 2 + wheel] = (byte >> (4 + wheel)) & 1


@kernel(inline=False)
def _write_optional_groups(parameters, a_xy, out, k_0, observation):
    """Write the optional groups to the observations (lanes in use, ...), from column `k_0` on.

    Horizontal specific forces on the inclined body are a_x - g theta and a_y + g phi, averaged over
    the interval. Strut extensions and rates are those of the last step.
    """
    n, at, lanes = out.shape[0], k_0, observation.shape[0]
    if parameters.planar > 0:
        for k in range(lanes):
            a_x = a_y = 0.0
            for i in range(n):
                a_x += a_xy[4 * i, k] - GRAVITY * out[i, THETA, k]
                a_y += a_xy[4 * i + 1, k] + GRAVITY * out[i, PHI, k]
            observation[k, at] = min(max(a_x / n, -MAX_PLANAR), MAX_PLANAR)
            observation[k, at + 1] = min(max(a_y / n, -MAX_PLANAR), MAX_PLANAR)
        at += N_PLANAR
    if parameters.struts > 0:
        for w in range(4):
            rate = extension(parameters.lane_constants[0], out[n - 1, N_DOF : 2 * N_DOF], w)
            for k in range(lanes):
                e, e_dot = out[n - 1, EXTENSION + w, k], extract_lane(rate, k)
                observation[k, at + w] = min(max(e, -MAX_EXTENSION), MAX_EXTENSION)
                observation[k, at + 4 + w] = min(
                    max(e_dot, -MAX_EXTENSION_RATE), MAX_EXTENSION_RATE
                )


@kernel(inline=False)
def _write_truth(parameters, roads, workspace, s, profile, loads):
    """Write stations, heights under the front wheels and tyre loads at the samples."""
    p, road = parameters.lane_constants[0], stack_rows(8)
    for i in range(0, workspace.out.shape[0], parameters.decimation):
        at = i // parameters.decimation
        sample_roads(p, roads, workspace.s[2 * i], workspace.v[2 * i], road, 0)
        for k in range(s.shape[0]):
            s[k, at] = workspace.s[2 * i, k]
            for side in range(2):
                profile[k, side, at] = road[side, k]
            for w in range(4):
                loads[k, w, at] = workspace.out[i, LOAD + w, k]


@kernel(inline=False)
def advance_blocks(blocks, state, parameters, inputs, delayed, buffer, output):
    """Advance the `blocks` (indices) by one control interval under IntervalInputs.

    `delayed` (2, n, LANES): scratch for command bytes; `buffer`: a `workspace_buffer`. The rows of
    `output` are the vehicles; the last block may have lanes without one.
    """
    n = delayed.shape[1]
    n_samples = (n + parameters.decimation - 1) // parameters.decimation
    n_sensors = parameters.range.size
    workspace = workspace_views(buffer, n, n_sensors)
    for b in blocks:
        rows = slice(b * LANES, min((b + 1) * LANES, output.values.shape[0]))
        lanes = rows.stop - rows.start
        q, v, layout, commands = state.q[b], state.v[b], state.road_layout[b], inputs.commands[b]
        kinematics, counts, values = state.kinematics[b], state.counts[b], output.values[rows]
        offset, size = layout[ROAD_OFFSET:ROAD_SIZE], layout[ROAD_SIZE]
        roads = RoadBuffers(
            inputs.road_heights[b], offset, size, layout[ROAD_START], layout[ROAD_DS]
        )
        start, speed, h = kinematics[DRIVE_START], kinematics[SPEED], parameters.h
        front_axle_stations(start, speed, counts[STEPS_DONE], h, workspace.s, workspace.v)
        a_xy, out = inputs.a_xy[b % inputs.a_xy.shape[0]], workspace.out
        for i in range(n):
            for k in range(LANES):
                delayed[0, i, k] = commands[k]
        delay_commands(
            state.delay_line[b], parameters.delay, counts[STEPS_DELAYED], delayed[0], delayed[1]
        )
        vehicles = LaneBuffers(
            parameters.lane_constants, parameters.constants, parameters.alpha, parameters.velocity,
            parameters.displacement, state.strut_state[b], q, v,
        )  # fmt: skip
        drive_inputs = DriveInputs(workspace.s, workspace.v, a_xy, delayed[1], h)
        integrate_lanes(vehicles, roads, drive_inputs, parameters.columns, out)
        nonfinite_step, rollover = output.nonfinite_step[rows], output.rollover[rows]
        _find_failures(out, q, v, workspace.scalar, nonfinite_step, rollover)
        filters, used = state.antialias_state[b], counts[NOISE_ROWS_USED, :lanes]
        sensor_rows, a = state.sensor_rows[b], workspace.a
        _sample_accelerometers(parameters, sensor_rows, filters, inputs.noise[b], used, out, a)
        _sum_costs(parameters, state.wk_state[b], out, workspace.heave, workspace.scalar, values)
        observation = output.observation[rows]
        _write_observation(parameters, kinematics, a, commands, observation)
        _write_optional_groups(parameters, a_xy, out, n_sensors * n_samples + 5, observation)
        if output.s.shape[1] > 0:
            truth = (output.s[rows], output.profile[rows], output.loads[rows])
            _write_truth(parameters, roads, workspace, *truth)
        for k in range(lanes):
            counts[STEPS_DONE, k] += n
            t = counts[STEPS_DONE, k] * parameters.h
            values[k, OUT_T] = t
            values[k, OUT_STATION] = kinematics[DRIVE_START, k] + t * kinematics[SPEED, k]
            values[k, OUT_SPEED_KMH] = kinematics[SPEED_KMH, k]
            output.end_of_road[b * LANES + k] = counts[STEPS_DONE, k] >= counts[STEPS_TOTAL, k]
