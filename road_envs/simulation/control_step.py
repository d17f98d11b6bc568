"""One control interval of a block of instrumented cars, in one compiled pass.

The drive (`lanes`), noise, clipping and anti-alias filter of the accelerometers as in `sensors`,
the W_k filter of `comfort` and the sums of the costs; only what an environment reports comes out.
Arrays have the blocks as first axis and the LANES as last one, which the shapes below leave out.
"""

from typing import NamedTuple

import numpy as np

from road_envs._numba import kernel, separate
from road_envs.sensing.filters import run_sections
from road_envs.simulation.fleet import (
    Numbers,
    Ways,
    aligned,
    drive_lanes,
    lay_course,
    look_at_roads,
    through_pipe,
)
from road_envs.simulation.rosenbrock import ACCELERATION, EXTENSION, LOAD, SIGNALS, Work
from road_envs.simulation.simd import LANES, get, lane, maximum, minimum, put
from road_envs.vehicle.equations import DOF, N_DOF, PHI, THETA, Z_B, extension
from road_envs.vehicle.parameters import GRAVITY

ANGLES = tuple(DOF.index(name) for name in ("phi", "theta", "phi_af", "phi_ar"))
LARGEST_ANGLE = float(np.radians(45.0))
"""Beyond it [rad] a small angle is none, whichever of ANGLES it is."""

TOLD = ("t", "station", "speed_kmh", "comfort", "rattle", "tyre_load", "reward", "unknown")
"""Columns of `Seen.numbers`: time since the start [s], station of the front axle [m], speed, the
three costs and the reward of an interval; what the states leave unknown of the road is the fourth
cost, which `Convoy` adds where it has a weight."""

PLANAR, STRUTS = 2, 8
"""Numbers that an observation holds more where it has the group: horizontal accelerations; strut
extensions and their rates."""
PLANAR_MOST, EXTENSION_MOST, RATE_MOST = 20.0, 0.5, 10.0
"""Largest values observed of them [m/s², m, m/s]."""

PASSED, DONE, USED, TOTAL = range(4)
BEGIN, SPEED, SPEED_KMH, SPEED_GAIN = range(4)
FIRST, SIZE, START, DS = 0, 2, 3, 4
"""Rows of `Cars.counts`, `Cars.course` and `Cars.way`."""


class Cars(NamedTuple):
    """What every car carries on from interval to interval; blocks first, lanes last.

    Coordinates `q`, rates `v` (B, 7), struts' `memory` (B, 4, 3), command `pipe` (B, D), memories
    `alias` (B, n, 3, 2) and `wk` (B, m, 1, 2) of the filters, `levers` (B, 3, 3), the sensors' rows
    on heave, roll and pitch. `counts` (B, 4): steps gone through the pipe, steps done, rows of
    noise used, steps in all. `course` (B, 4): station at the start [m], speed [m/s], the same
    [km/h], gain of the speed signal. `way` (B, 5): where in its heights the road of a car stands,
    as `lanes.Ways` has it.
    """

    q: np.ndarray
    v: np.ndarray
    memory: np.ndarray
    pipe: np.ndarray
    alias: np.ndarray
    wk: np.ndarray
    levers: np.ndarray
    counts: np.ndarray
    course: np.ndarray
    way: np.ndarray


class Common(NamedTuple):
    """What all cars share: parameters, tables, filters, clipping level, step, steps per sample."""

    p: Numbers
    numbers: np.ndarray
    velocity: np.ndarray
    displacement: np.ndarray
    delay: np.ndarray
    alpha: np.ndarray
    static_load: np.ndarray
    weights: np.ndarray
    alias_sos: np.ndarray
    wk_sos: np.ndarray
    columns: np.ndarray
    noise_std: float
    range: float
    top_speed: float
    h: float
    every: int
    planar: int
    struts: int


class Desk(NamedTuple):
    """Scratch of one thread for a block and its n steps."""

    work: Work
    road: np.ndarray  # (16,)
    row: np.ndarray  # (29,)
    nothing: np.ndarray  # (1,)
    out: np.ndarray  # (n, 29)
    s: np.ndarray  # (2 n + 1,)
    v: np.ndarray  # (2 n + 1,)
    a: np.ndarray  # (3, n)
    heave: np.ndarray  # (1, n)


class Seen(NamedTuple):
    """What an interval gave of N cars, k samples.

    `observation` (N, 3 k + 5 and more) float32 as `RoadReconEnv` describes it; `numbers` (N, 8),
    the columns of TOLD; `over` (N,), whether the car has left its road; `turned` (N,), 4 i + column
    of ANGLES where step i first passed LARGEST_ANGLE, else -1; `broken` (N,), the first step whose
    motion is not finite, else -1; and, or empty, `s` (N, k) [m], `profile` (N, 2, k) [m] and
    `loads` (N, 4, k) [N].
    """

    observation: np.ndarray
    numbers: np.ndarray
    over: np.ndarray
    turned: np.ndarray
    broken: np.ndarray
    s: np.ndarray
    profile: np.ndarray
    loads: np.ndarray


def scratch(steps: int) -> np.ndarray:
    """Room (rows, LANES) for the Desk of intervals of so many steps."""
    return aligned(_WORK + 17 + SIGNALS + (SIGNALS + 8) * steps + 2)


_WORK = 6 * N_DOF + 8 * 4 + 12 + 6


@kernel
def desk(room, n):
    """The Desk of intervals of `n` steps in a `scratch`."""
    q, w, at = N_DOF, 6 * N_DOF, _WORK
    work = Work(
        room[:q],
        room[q : 2 * q],
        room[2 * q : 3 * q],
        room[3 * q : 4 * q],
        room[4 * q : 5 * q],
        room[5 * q : w],
        room[w : w + 4],
        room[w + 4 : w + 8],
        room[w + 8 : w + 12],
        room[w + 12 : w + 16],
        room[w + 16 : w + 20],
        room[w + 20 : w + 24],
        room[w + 24 : w + 28],
        room[w + 28 : w + 32],
        room[w + 32 : w + 44],
        room[w + 44 : at],
    )
    road, nothing, at = room[at : at + 16], room[at + 16 : at + 17], at + 17
    row, at = room[at : at + SIGNALS], at + SIGNALS
    out, at = room[at : at + SIGNALS * n].reshape(n, SIGNALS, LANES), at + SIGNALS * n
    s, at = room[at : at + 2 * n + 1], at + 2 * n + 1
    v, at = room[at : at + 2 * n + 1], at + 2 * n + 1
    a, at = room[at : at + 3 * n].reshape(3, n, LANES), at + 3 * n
    heave = room[at : at + n].reshape(1, n, LANES)
    return Desk(work, road, row, nothing, out, s, v, a, heave)


@separate
def _first_broken(out, k):
    """The first step before which a signal of lane `k` is not finite."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            if not np.isfinite(out[i, j, k]):
                return i
    return out.shape[0]


@separate
def _first_turned(out, k):
    """4 i + column of the first step i at which one of ANGLES of lane `k` is too large."""
    for i in range(out.shape[0]):
        for column in range(len(ANGLES)):
            if abs(out[i, ANGLES[column], k]) > LARGEST_ANGLE:
                return len(ANGLES) * i + column
    return -1


@separate
def _find_failures(out, q, v, largest, broken, turned):
    """Write where the lanes' motion fails (LANES,); one that broke down is reported as still."""
    for k in range(LANES):
        total = 0.0
        for j in range(N_DOF):
            total += q[j, k] + v[j, k]
        broken[k] = -1
        if not np.isfinite(total):
            broken[k] = _first_broken(out, k)
            out[:, :, k] = 0.0
    put(largest, 0, 0.0)
    for i in range(out.shape[0]):
        for angle in ANGLES:
            x = get(out[i], angle)
            put(largest, 0, maximum(get(largest, 0), maximum(x, -x)))
    for k in range(LANES):
        turned[k] = _first_turned(out, k) if largest[0, k] > LARGEST_ANGLE else -1


@separate
def _sense(common, levers, alias, noise, used, out, a):
    """What the accelerometers give in an interval, to `a` (3, n, LANES), every step of it."""
    n = out.shape[0]
    if common.noise_std > 0.0:
        for k in range(LANES):
            for i in range(n):
                for j in range(a.shape[0]):
                    a[j, i, k] = noise[k, used[k] + i, j]
            used[k] += n
    else:
        a[:] = 0.0
    for j in range(a.shape[0]):
        heave, roll, pitch = get(levers, j, 0), get(levers, j, 1), get(levers, j, 2)
        for i in range(n):
            z, phi = get(out[i], ACCELERATION + Z_B), get(out[i], ACCELERATION + PHI)
            true = heave * z + roll * phi + pitch * get(out[i], ACCELERATION + THETA)
            x = true + common.noise_std * get(a, j, i)
            put(a[j], i, minimum(maximum(x, -common.range), common.range))
    run_sections(common.alias_sos, alias, a, a)


@separate
def _add_up(common, wk, out, heave, nothing, numbers):
    """The costs and the reward of an interval, to their columns of `numbers` (LANES, 8)."""
    n = out.shape[0]
    put(nothing, 0, 0.0)
    for i in range(n):
        put(heave[0], i, get(out[i], ACCELERATION + Z_B))
    run_sections(common.wk_sos, wk, heave, heave)
    comfort = rattle = load = get(nothing, 0)
    for i in range(n):
        x = get(heave, 0, i)
        comfort = comfort + x * x
        for w in range(4):
            e = get(out[i], EXTENSION + w)
            rattle = rattle + e * e
            variation = get(out[i], LOAD + w) / common.static_load[w] - 1.0
            load = load + variation * variation
    for k in range(LANES):
        numbers[k, 3] = np.sqrt(lane(comfort, k) / n)
        numbers[k, 4] = np.sqrt(lane(rattle, k) / (4 * n))
        numbers[k, 5] = np.sqrt(lane(load, k) / (4 * n))
        cost = 0.0
        for j in range(3):
            cost += common.weights[j] * numbers[k, 3 + j]
        numbers[k, 6] = -n * common.h * cost
        numbers[k, 7] = 0.0


@separate
def _observe(common, course, a, given, observation):
    """The observations (LANES, 3 k + 5) of a block."""
    high = common.range
    for k in range(LANES):
        at, byte = 0, given[k]
        for j in range(a.shape[0]):
            for i in range(0, a.shape[1], common.every):
                observation[k, at] = min(max(a[j, i, k], -high), high)
                at += 1
        seen = course[SPEED_GAIN, k] * course[SPEED, k]
        observation[k, at] = min(max(seen, 0.0), common.top_speed)
        for wheel in (0, 2):
            observation[k, at + 1 + wheel] = (byte >> wheel) & 1
            observation[k, at + 2 + wheel] = (byte >> (4 + wheel)) & 1


@separate
def _observe_more(common, turn, out, k_0, observation):
    """Horizontal accelerations and struts (LANES, ...), from column `k_0` of the observations on.

    An accelerometer on a leaning body feels its share of the weight too: the means over the
    interval of a_x - g theta and a_y + g phi. Extensions and rates are those of the last step.
    """
    n, at = out.shape[0], k_0
    if common.planar > 0:
        for k in range(LANES):
            a_x = a_y = 0.0
            for i in range(n):
                a_x += turn[4 * i, k] - GRAVITY * out[i, THETA, k]
                a_y += turn[4 * i + 1, k] + GRAVITY * out[i, PHI, k]
            observation[k, at] = min(max(a_x / n, -PLANAR_MOST), PLANAR_MOST)
            observation[k, at + 1] = min(max(a_y / n, -PLANAR_MOST), PLANAR_MOST)
        at += PLANAR
    if common.struts > 0:
        for w in range(4):
            rate = extension(common.p, out[n - 1, N_DOF : 2 * N_DOF], w)
            for k in range(LANES):
                e, e_dot = out[n - 1, EXTENSION + w, k], lane(rate, k)
                observation[k, at + w] = min(max(e, -EXTENSION_MOST), EXTENSION_MOST)
                observation[k, at + 4 + w] = min(max(e_dot, -RATE_MOST), RATE_MOST)


@separate
def _tell_the_truth(common, ways, top, s, profile, loads):
    """Stations (LANES, k), heights under the front wheels and tyre loads at the samples."""
    for i in range(0, top.out.shape[0], common.every):
        at = i // common.every
        look_at_roads(common.p, ways, top.s[2 * i], top.v[2 * i], top.road, 0)
        for k in range(LANES):
            s[k, at] = top.s[2 * i, k]
            for side in range(2):
                profile[k, side, at] = top.road[side, k]
            for w in range(4):
                loads[k, w, at] = top.out[i, LOAD + w, k]


@separate
def drive_blocks(blocks, cars, common, heights, noise, given, pipes, turns, room, seen):
    """Drive the `blocks` (indices) for one interval under the commands `given` (B, LANES).

    `heights` (B, ...): the roads; `noise` (B, LANES, rows, 3): standard normal; `pipes`
    (2, n, LANES): scratch of bytes; `turns` (B or 1, 4 n + 2): a_x, a_y of a manoeuvre; `room`:
    a `scratch`; the rows of `seen` are the lanes of all blocks.
    """
    n = pipes.shape[1]
    seen_samples = (n + common.every - 1) // common.every
    top = desk(room, n)
    for b in blocks:
        rows = slice(b * LANES, (b + 1) * LANES)
        q, v, memory, way = cars.q[b], cars.v[b], cars.memory[b], cars.way[b]
        course, counts, numbers = cars.course[b], cars.counts[b], seen.numbers[rows]
        ways = Ways(heights[b], way[FIRST:SIZE], way[SIZE], way[START], way[DS])
        lay_course(course[BEGIN], course[SPEED], counts[DONE], common.h, top.s, top.v)
        for i in range(n):
            for k in range(LANES):
                pipes[0, i, k] = given[b, k]
        through_pipe(cars.pipe[b], common.delay, counts[PASSED], pipes[0], pipes[1])
        drive_lanes(
            common.p,
            common.numbers,
            common.velocity,
            common.displacement,
            memory,
            q,
            v,
            ways,
            top.s,
            top.v,
            turns[b % turns.shape[0]],
            pipes[1],
            common.alpha,
            common.h,
            top.work,
            top.road,
            top.row,
            common.columns,
            top.out,
        )
        _find_failures(top.out, q, v, top.nothing, seen.broken[rows], seen.turned[rows])
        _sense(common, cars.levers[b], cars.alias[b], noise[b], counts[USED], top.out, top.a)
        _add_up(common, cars.wk[b], top.out, top.heave, top.nothing, numbers)
        _observe(common, course, top.a, given[b], seen.observation[rows])
        _observe_more(
            common, turns[b % turns.shape[0]], top.out, 3 * seen_samples + 5, seen.observation[rows]
        )
        if seen.s.shape[1] > 0:
            truth = (seen.s[rows], seen.profile[rows], seen.loads[rows])
            _tell_the_truth(common, ways, top, *truth)
        for k in range(LANES):
            counts[DONE, k] += n
            numbers[k, 0] = counts[DONE, k] * common.h
            numbers[k, 1] = course[BEGIN, k] + numbers[k, 0] * course[SPEED, k]
            numbers[k, 2] = course[SPEED_KMH, k]
            seen.over[b * LANES + k] = counts[DONE, k] >= counts[TOTAL, k]
