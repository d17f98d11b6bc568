"""One control interval of blocks of instrumented vehicles, in one compiled pass.

It integrates the motion (`fleet`), applies noise, clipping and anti-alias filter of the
accelerometers (as `data_logger`) and the W_k filter (`comfort`), and sums the costs, all of them
step by step, so that signals are not stored; only the output of an environment is. The costs are
those of `RoadReconEnv`, or with `safety` those of `safety_step`. Arrays have the blocks as first
axis and LANES as last axis, which the shapes below omit.
"""

import numpy as np

from road_envs.envs import fleet_arrays as fa
from road_envs.envs.failures import END_OF_ROAD, NONFINITE_STEP, ROLLOVER, find_failures
from road_envs.envs.fleet_arrays import N_SUMS
from road_envs.envs.safety_step import N_SAFETY, add_safety, write_safety
from road_envs.kernels._numba import kernel
from road_envs.kernels.filters import filter_sample
from road_envs.kernels.normal_numbers import fill_normal
from road_envs.kernels.simd import LANES, extract_lane, maximum, minimum
from road_envs.kernels.simd_arrays import add, get, put, stack_rows
from road_envs.simulation import fleet, rosenbrock
from road_envs.simulation.drive import DriveInputs
from road_envs.simulation.fleet import delay_commands, front_axle_stations, take_step
from road_envs.simulation.lanes import LaneBuffers
from road_envs.simulation.rosenbrock import N_SIDE_SIGNALS, WORKSPACE_ROWS, step_workspace
from road_envs.vehicle.equations import N_DOF, PHI, THETA, Z_B, extension
from road_envs.vehicle.parameters import GRAVITY


@kernel(inline=False)
def _read_profiles(profiles, counts, s, v, a_xy):
    """Write the inputs of the next interval; a drive that has ended repeats its last ones."""
    size = s.shape[0]
    for k in range(LANES):
        # profiles hold every half step, so that the interval begins at twice the steps done
        first = max(min(2 * counts[fa.STEPS_DONE, k], 2 * counts[fa.STEPS_TOTAL, k] + 1 - size), 0)
        row = profiles[counts[fa.PROFILE, k]]
        for i in range(size):
            s[i, k], v[i, k] = row[0, first + i], row[1, first + i]
            a_xy[2 * i, k], a_xy[2 * i + 1, k] = row[2, first + i], row[3, first + i]


@kernel
def _measure(parameters, mounting, antialias_state, signals, i, workspace, safety):
    """Write the filtered accelerations of step `i` to the samples, if it is one of a sample."""
    for j in range(parameters.range.size):
        first, columns = rosenbrock.ACCELERATION, parameters.sensor_columns[j]
        z, phi = get(signals, first + columns[0]), get(signals, first + columns[1])
        heave, roll, pitch = get(mounting, j, 0), get(mounting, j, 1), get(mounting, j, 2)
        true = heave * z + roll * phi + pitch * get(signals, first + columns[2])
        if safety is not None:
            true = true * get(mounting, j, 3) + get(mounting, j, 4)
        x = true + parameters.noise_std[j] * get(workspace.noise, j, i)
        limit = parameters.range[j]
        x = minimum(maximum(x, -limit), limit)
        x = filter_sample(parameters.antialias_sos, antialias_state, j, x)
        if i % parameters.decimation == 0:
            at = i // parameters.decimation
            put(workspace.samples[j], at, minimum(maximum(x, -limit), limit))


@kernel
def _add_costs(parameters, wk_state, signals, sums):
    """Add the squares of one step to the `sums` (6, LANES)."""
    heave = get(signals, rosenbrock.ACCELERATION + Z_B)
    heave = filter_sample(parameters.wk_sos, wk_state, 0, heave)
    add(sums, fa.SUM_COMFORT, heave * heave)
    for w in range(4):
        e = get(signals, rosenbrock.EXTENSION + w)
        add(sums, fa.SUM_RATTLE, e * e)
        variation = get(signals, rosenbrock.LOAD + w) * parameters.per_static_load[w] - 1.0
        add(sums, fa.SUM_TYRE_LOAD, variation * variation)


@kernel(inline=False)
def _write_costs(parameters, n, sums, values):
    """Write the costs and the reward of an interval of `n` steps to `values` (lanes in use, 8)."""
    for k in range(values.shape[0]):
        values[k, fa.OUT_COMFORT] = np.sqrt(sums[fa.SUM_COMFORT, k] / n)
        values[k, fa.OUT_RATTLE] = np.sqrt(sums[fa.SUM_RATTLE, k] / (4 * n))
        values[k, fa.OUT_TYRE_LOAD] = np.sqrt(sums[fa.SUM_TYRE_LOAD, k] / (4 * n))
        cost = 0.0
        for j in range(3):
            cost += parameters.weights[j] * values[k, fa.OUT_COMFORT + j]
        values[k, fa.OUT_REWARD] = -n * parameters.h * cost
        values[k, fa.OUT_UNRESOLVED] = 0.0


@kernel(inline=False)
def _write_observation(parameters, gain, v, samples, commands, observation):
    """Write the observations (lanes in use, S k + 5) of a block at the speeds `v` (LANES,)."""
    for k in range(observation.shape[0]):
        at, byte = 0, commands[k]
        for j in range(samples.shape[0]):
            for i in range(samples.shape[1]):
                observation[k, at] = samples[j, i, k]
                at += 1
        observation[k, at] = min(max(gain[k] * v[k], 0.0), parameters.top_speed)
        for wheel in (0, 2):
            observation[k, at + 1 + wheel] = (byte >> wheel) & 1
            observation[k, at + 2 + wheel] = (byte >> (4 + wheel)) & 1


@kernel(inline=False)
def _write_optional_groups(parameters, p, n, sums, signals, at, observation):
    """Write the optional groups to the observations (lanes in use, ...), from column `at` on.
    Horizontal specific forces on the inclined body are averaged over the interval. Strut extensions
    and rates are those of the last step, with its `signals`; `p` are the constants of the lanes.
    """
    lanes = observation.shape[0]
    if parameters.planar > 0:
        for k in range(lanes):
            for j in range(fa.N_PLANAR):
                mean = sums[fa.SUM_A_X + j, k] / n
                observation[k, at + j] = min(max(mean, -fa.MAX_PLANAR), fa.MAX_PLANAR)
        at += fa.N_PLANAR
    if parameters.struts > 0:
        for w in range(4):
            rate = extension(p, signals[N_DOF : 2 * N_DOF], w)
            for k in range(lanes):
                e, e_dot = signals[rosenbrock.EXTENSION + w, k], extract_lane(rate, k)
                observation[k, at + w] = min(max(e, -fa.MAX_EXTENSION), fa.MAX_EXTENSION)
                observation[k, at + 4 + w] = min(
                    max(e_dot, -fa.MAX_EXTENSION_RATE), fa.MAX_EXTENSION_RATE
                )


@kernel(inline=False)
def _write_truth(s, heights, signals, at, truth):
    """Write station, heights under the front wheels and tyre loads of a step to column `at`."""
    for k in range(truth.shape[0]):
        truth[k, fa.TRUE_S, at] = s[k]
        for side in range(2):
            truth[k, fa.TRUE_PROFILE + side, at] = heights[side, k]
        for w in range(4):
            truth[k, fa.TRUE_LOADS + w, at] = signals[rosenbrock.LOAD + w, k]


@kernel(inline=False, count_references=False)
def advance_blocks(
    blocks, state, parameters, cars, inputs, workspace, output, safety=None, side=None
):
    """Advance the `blocks` (indices) by one control interval under IntervalInputs. The rows of
    `output` are the vehicles; the last block may have lanes without one. `safety`, if given:
    constants of costs as in `safety_step`; `side`, if given: vehicles have side motion.
    """
    delayed = workspace.delayed
    n, h = delayed.shape[0], parameters.h
    work = step_workspace(stack_rows(WORKSPACE_ROWS))
    signals, unused = stack_rows(N_SIDE_SIGNALS), stack_rows(N_SIDE_SIGNALS)
    scratch = fleet.LaneScratch(
        work, stack_rows(16), stack_rows(2), stack_rows(2), stack_rows(40), unused
    )
    sums, safe = stack_rows(N_SUMS), stack_rows(N_SAFETY)
    for b in blocks:
        rows = slice(b * LANES, min((b + 1) * LANES, output.values.shape[0]))
        lanes, own = rows.stop - rows.start, b % cars.lane_constants.shape[0]
        q, v, layout, commands = state.q[b], state.v[b], state.road_layout[b], inputs.commands[b]
        kinematics, counts = state.kinematics[b], state.counts[b]
        values, events, truth = output.values[rows], output.events[rows], output.truth[rows]
        offset, size = layout[fa.ROAD_OFFSET : fa.ROAD_SIZE], layout[fa.ROAD_SIZE]
        roads = fleet.RoadBuffers(
            inputs.road_heights, offset, size, layout[fa.ROAD_START], layout[fa.ROAD_PER_DS]
        )
        if inputs.profiles.shape[0] > 0:
            a_xy = workspace.a_xy
            _read_profiles(inputs.profiles, counts, workspace.s, workspace.v, a_xy)
        else:
            a_xy = inputs.a_xy[b % inputs.a_xy.shape[0]]
            start, speed = kinematics[fa.DRIVE_START], kinematics[fa.SPEED]
            front_axle_stations(start, speed, counts[fa.STEPS_DONE], h, workspace.s, workspace.v)
        delay_commands(state.delay_line[b], parameters.delay, inputs.commands[b : b + 1], delayed)
        vehicles = LaneBuffers(
            cars.lane_constants[own : own + 1], cars.constants[own], cars.alpha[own], cars.velocity,
            cars.displacement, state.strut_state[b], state.valves[b], q, v,
        )  # fmt: skip
        manoeuvre = a_xy.shape[0] > fleet.NO_MANOEUVRE.shape[0]
        drive_inputs = DriveInputs(workspace.s, workspace.v, a_xy, delayed, h)
        if parameters.noisy > 0:
            fill_normal(state.noise_state[b], lanes, workspace.noise)
        for j in range(N_SUMS):
            put(sums, j, 0.0)
        for j in range(N_SAFETY):
            put(safe, j, 0.0)
        for k in range(lanes):
            events[k, ROLLOVER] = events[k, NONFINITE_STEP] = -1
        for i in range(n):
            take_step(vehicles, roads, drive_inputs, i, scratch, signals, None, side)
            find_failures(signals, i, events)
            _measure(
                parameters, state.mounting[b], state.antialias_state[b], signals, i, workspace,
                safety,
            )  # fmt: skip
            if safety is None:
                _add_costs(parameters, state.wk_state[b], signals, sums)
            else:
                add_safety(
                    parameters, safety, state.wk_state[b], state.high_pass_state[b], state.off[b],
                    signals, safe,
                )  # fmt: skip
            if parameters.planar > 0:
                first = 4 * i if manoeuvre else 0
                add(sums, fa.SUM_A_X, get(a_xy, first) - GRAVITY * get(signals, THETA))
                add(sums, fa.SUM_A_Y, get(a_xy, first + 1) + GRAVITY * get(signals, PHI))
            if truth.shape[1] > 0 and i % parameters.decimation == 0:
                at = i // parameters.decimation
                _write_truth(workspace.s[2 * i], scratch.front, signals, at, truth)
            if workspace.signals.shape[0] > 0:
                for j in range(rosenbrock.N_SIGNALS):
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
                for j in range(N_SAFETY):
                    safe[j, k] = 0.0
        if safety is None:
            _write_costs(parameters, n, sums, values)
        else:
            write_safety(safe, values)
        observation, end = output.observation[rows], workspace.v[2 * n]
        gain, p = kinematics[fa.SPEED_GAIN], cars.lane_constants[own]
        _write_observation(parameters, gain, end, workspace.samples, commands, observation)
        k_0 = workspace.samples.shape[0] * workspace.samples.shape[1] + 5
        _write_optional_groups(parameters, p, n, sums, signals, k_0, observation)
        for k in range(lanes):
            counts[fa.STEPS_DONE, k] += n
            t = counts[fa.STEPS_DONE, k] * h
            values[k, fa.OUT_T] = t
            if inputs.profiles.shape[0] > 0:
                values[k, fa.OUT_STATION] = workspace.s[2 * n, k]
                values[k, fa.OUT_SPEED_KMH] = 3.6 * end[k]
            else:
                station = kinematics[fa.DRIVE_START, k] + t * kinematics[fa.SPEED, k]
                values[k, fa.OUT_STATION] = station
                values[k, fa.OUT_SPEED_KMH] = kinematics[fa.SPEED_KMH, k]
            events[k, END_OF_ROAD] = counts[fa.STEPS_DONE, k] >= counts[fa.STEPS_TOTAL, k]
