"""Steps of LANES vehicles at once, one per lane of a SIMD vector, and jobs over threads.

Every vehicle has its own parameters, road, speed and commands. The step is `rosenbrock.step`,
compiled for vectors (`simd`); only the valves are advanced lane by lane. The result of a lane
depends on its own vehicle only, so it is the same for any number of vehicles and threads.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from road_envs.kernels import simd
from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import LANES, if_positive
from road_envs.kernels.simd_arrays import get, load_four, put
from road_envs.roads.surface import PAD, catmull_rom
from road_envs.simulation.lanes import aligned_zeros, update_lane_valves
from road_envs.simulation.rosenbrock import StepInputs, StepWorkspace, any_step
from road_envs.simulation.substeps import SUBSTEPS, interpolate, mark_steep
from road_envs.vehicle.equations import Motion
from road_envs.vehicle.suspension import VehicleBuffers


@cache
def _thread_pool(threads: int) -> ThreadPoolExecutor:
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
        u = simd.minimum(simd.maximum(front - (get(p.x, 0) - get(p.x, i)) * per_ds, 1.0), last)
        j = simd.integer_part(u)
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
    """Write stations `s` [m] and `speed` [m/s] (M, LANES) at M half steps behind those `done`.

    The vehicles began at station `start` [m] (LANES,), at the speed `v` [m/s].
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
    `steep` (2,): which lanes are, and zeros; `motions` (40,): two Motions; `unused` (44,): signals.
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

    Its signals go to `signals` (29, 32 or 44, LANES). `flexible` is None for rigid frames, and
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
    if simd.any_positive(get(valves, 0) + change * change):
        for k in range(LANES):
            byte, own = inputs.commands[n, k], lanes.constants[k : k + 1]
            if valves[0, k] > 0.0 or byte != valves[1, k]:
                settled = update_lane_valves(own, strut_state, q, k, byte, lanes.alpha[k], h)
                valves[0, k], valves[1, k] = 0.0 if settled else 1.0, byte
    # 0: the whole step, of all lanes unless each is on a steep road; then the parts, of those
    begin, end = 0, 1
    if mark_steep(road, steep):
        begin, end = 1 if simd.equals_one(get(steep, 0)) else 0, 1 + SUBSTEPS
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
