"""Many vehicles at once: LANES of them in a vector register, blocks of lanes over threads.

The step is `integrator.step` itself, compiled for vectors (`vector.py`); only reading the road,
where each lane is on a surface of its own, and switching valves go lane by lane. Every vehicle has
its own parameters, surface, speed and commands. What a lane computes depends on nothing but its
own vehicle, so it is the same whatever the number of vehicles and threads.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy as np

from road_envs._numba import kernel, separate
from road_envs.config import ConfigError
from road_envs.roads.surface import PAD, Surface, catmull_rom
from road_envs.simulation.drive import Drive
from road_envs.simulation.rosenbrock import Work, flexible_step, signals_of, step
from road_envs.simulation.simd import LANES, four, get, maximum, minimum, put, whole
from road_envs.vehicle.equations import N_DOF, NUMBERS, bend, extension
from road_envs.vehicle.suspension import settled, switch

Numbers = np.void
"""`dynamics.NUMBERS` with lanes as the last axis of every field: a record, which compiled code
finds by one address (30 arrays have 30, more than there are registers)."""

_NUMBERS = np.dtype([(n, "f8", (*NUMBERS[n].shape, LANES)) for n in NUMBERS.names or ()])
_SIZES = dict(zip(Work._fields, [N_DOF] * 6 + [4] * 8 + [12, 6], strict=True))
_WORK = np.dtype([(name, "f8", (size, LANES)) for name, size in _SIZES.items()])


@cache
def pool(threads: int) -> ThreadPoolExecutor:
    """Threads that stay: new ones begin on the core of their maker and are not moved in time."""
    return ThreadPoolExecutor(threads)


class Ways(NamedTuple):
    """Where each lane drives: its samples in `heights`, from `first` (2,) of left and right on."""

    heights: np.ndarray
    first: np.ndarray
    size: np.ndarray
    start: np.ndarray
    ds: np.ndarray


def aligned(*shape: int) -> np.ndarray:
    """Zeros (..., LANES) whose rows begin where a vector register's loads cross no cache line."""
    size = int(np.prod(shape)) * LANES
    store = np.zeros(size + LANES)
    skip = -(store.ctypes.data // 8) % LANES
    return store[skip : skip + size].reshape(*shape, LANES)


def copied(array: np.ndarray) -> np.ndarray:
    """An aligned copy of an array (..., LANES)."""
    copy = aligned(*array.shape[:-1])
    copy[...] = array
    return copy


def _record(kind: np.dtype) -> np.void:
    """An aligned record of a kind whose fields have lanes as their last axis."""
    return aligned(kind.itemsize // (8 * LANES)).reshape(-1).view(kind)[0]


def numbers_of(numbers: np.ndarray) -> Numbers:
    """The Numbers of LANES vehicles from those of `dynamics` (LANES,)."""
    p = _record(_NUMBERS)
    for name in NUMBERS.names or ():
        p[name][...] = np.moveaxis(numbers[name], 0, -1)
    return p


def workspace() -> np.void:
    """Scratch of LANES vehicles for `integrator.step`: a record with the fields of Work."""
    return _record(_WORK)


@kernel
def look_at_roads(p, ways, s, speed, road, at):
    """Heights and rates under the wheels to rows `at` ... `at` + 7 of `road` (16, LANES).

    `s`, `speed` (LANES,): stations of the front axles [m] and speeds [m/s].
    """
    ds, v = get(ways.ds), get(speed)
    front = (get(s) - get(ways.start)) / ds + PAD
    last = get(ways.size) - 3.0
    for i in range(2):
        u = minimum(maximum(front - (get(p.x, 0) - get(p.x, i)) / ds, 1.0), last)
        j = whole(u)
        for side in range(2):
            a, b, c, d = four(ways.heights, get(ways.first, side) + j - 1.0)
            z, slope = catmull_rom(a, b, c, d, u - j, ds)
            put(road, at + 2 * i + side, z)
            put(road, at + 4 + 2 * i + side, slope * v)


@separate
def switch_lane(numbers, memory, q, k, byte, alpha, h):
    """Advance the valves of lane `k`; returns whether all are settled. `numbers` (1,): its own."""
    p = numbers[0]
    own, own_q = np.empty(memory.shape[:2]), np.empty(q.shape[0])
    for w in range(own.shape[0]):
        for j in range(own.shape[1]):
            own[w, j] = memory[w, j, k]
    for j in range(own_q.size):
        own_q[j] = q[j, k]
    calm = True
    for w in range(4):
        stiff, high = (byte >> w) & 1, (byte >> (4 + w)) & 1
        if not settled(own, w, stiff, high):
            e = extension(p, own_q, w)
            if own_q.size > N_DOF:
                e += bend(p, own_q[N_DOF], w)
            switch(p, own, w, e, stiff, high, alpha, h)
            calm = False
    for w in range(own.shape[0]):
        for j in range(own.shape[1]):
            memory[w, j, k] = own[w, j]
    return calm


@separate
def through_pipe(pipe, delay, passed, commands, arriving):
    """What reaches the valves while `commands` (N, LANES) are given, to `arriving` (N, LANES).

    A lane's command takes `delay` (LANES,) steps; those on their way are in its column of `pipe`
    (D, LANES), a ring of which `passed` (LANES,) steps have gone by, which are counted on.
    """
    n = commands.shape[0]
    for k in range(LANES):
        slot = passed[k] % max(delay[k], 1)
        for i in range(n):
            arriving[i, k] = commands[i, k]
            if delay[k] > 0:
                arriving[i, k] = pipe[slot, k]
                pipe[slot, k] = commands[i, k]
                slot = slot + 1 if slot + 1 < delay[k] else 0
        passed[k] += n


@separate
def lay_course(begin, v, done, h, s, speed):
    """Stations and speeds (M, LANES) at half steps from `done` (LANES,) steps on, at speeds `v`."""
    for i in range(s.shape[0]):
        for k in range(LANES):
            s[i, k] = begin[k] + 0.5 * h * (2.0 * done[k] + i) * v[k]
            speed[i, k] = v[k]


@separate
def drive_lanes(
    p,
    numbers,
    velocity,
    displacement,
    memory,
    q,
    v,
    ways,
    s,
    speed,
    turn,
    commands,
    alpha,
    h,
    work,
    road,
    row,
    columns,
    out,
    flexible=None,
):
    """Drive LANES vehicles; `q`, `v` (7, LANES), `memory` (4, 3, LANES) end as they stand then.

    `s`, `speed` (2 N + 1, LANES), `turn` (4 N + 2, LANES) and `commands` (N, LANES) as in
    `integrator.drive`; `alpha` (LANES,) is the share of the way to its target that a valve goes in
    a step. Of the 29 signals those of `columns` (C,) go to `out` (N, C, LANES): more of them than
    the caches hold cost as much time as the motion. `work`, `road` (16, LANES) and `row`
    (29, LANES) are scratch. Of `flexible` cars `q`, `v` are (8, LANES) and there are 32 signals.
    """
    last = np.zeros(LANES, dtype=np.uint8)
    calm = np.zeros(LANES, dtype=np.bool_)
    for n in range(commands.shape[0]):
        look_at_roads(p, ways, s[2 * n], speed[2 * n], road, 0)
        look_at_roads(p, ways, s[2 * n + 1], speed[2 * n + 1], road, 8)
        for k in range(LANES):
            byte = commands[n, k]
            if not calm[k] or byte != last[k]:
                calm[k] = switch_lane(numbers[k : k + 1], memory, q, k, byte, alpha[k], h)
                last[k] = byte
        between = turn[4 * n : 4 * n + 4]
        if flexible is None:
            step(p, velocity, displacement, memory, q, v, road, between, h, work, row)
        else:
            flexible_step(p, velocity, displacement, memory, q, v, road, between, h, work, row)
        for c in range(columns.size):
            put(out[n], c, get(row, columns[c]))


class _Block:
    """LANES vehicles as the kernel reads them; a block that is not full repeats its last one."""

    def __init__(self, drives: Sequence[Drive]):
        everyone = [*drives, *[drives[-1]] * (LANES - len(drives))]
        self.drives, self.everyone = list(drives), everyone
        self.numbers = np.concatenate([drive.plant.numbers for drive in everyone])
        cars = list({id(drive.plant): drive.plant for drive in everyone}.values())
        of_lane = [next(i for i, c in enumerate(cars) if c is d.plant) for d in everyone]
        for kind, tables in (("losses", "velocity"), ("stops", "displacement")):
            first = np.cumsum([0, *(len(getattr(c, tables)) for c in cars)])  # equal cars share
            self.numbers[kind] += first[of_lane][:, None]
        self.p = numbers_of(self.numbers)
        self.velocity = np.concatenate([car.velocity for car in cars])
        self.displacement = np.concatenate([car.displacement for car in cars])
        self.memory = copied(np.stack([drive.memory for drive in everyone], axis=-1))
        state = np.stack([drive.state for drive in everyone], axis=-1)
        self.q, self.v = map(copied, np.split(state, 2))
        self.flexible = (True,) if everyone[0].plant.flexible else ()
        self.ways = _ways([drive.surface for drive in everyone])
        self.h = everyone[0].step
        lags = np.array([drive.car.valve.lag for drive in everyone])
        self.alpha = copied(1.0 - np.exp(-self.h / lags))
        rows = signals_of(everyone[0].plant)
        self.work, self.road, self.row = workspace(), aligned(16), aligned(rows)
        self.steady = _steady(everyone)
        self.delay = np.array([drive.pipe.size for drive in everyone])
        self.pipe = np.zeros((self.delay.max(), LANES), dtype=np.uint8)
        for k, drive in enumerate(everyone):
            self.pipe[: drive.pipe.size, k] = drive.pipe
        self.passed = np.zeros(LANES, dtype=np.int64)

    def advance(self, commands: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
        """Write the signals (n, C, LANES) under commands (n, vehicles)."""
        n, own = len(commands), len(self.drives)
        given, byte = np.empty((2, n, LANES), dtype=np.uint8)
        given[:, :own], given[:, own:] = commands, commands[:, -1:]
        through_pipe(self.pipe, self.delay, self.passed, given, byte)
        tables = (self.numbers, self.velocity, self.displacement, self.memory)
        course = (*self._course(n), byte, self.alpha, self.h)
        room = (self.work, self.road, self.row, columns, out, *self.flexible)
        drive_lanes(self.p, *tables, self.q, self.v, self.ways, *course, *room)
        for drive in self.drives:
            drive.steps += n

    def _course(self, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stations and speeds (2 n + 1, LANES); a_x, a_y one below the other (4 n + 2, LANES)."""
        s, speed, turn = aligned(2 * n + 1), aligned(2 * n + 1), aligned(2 * n + 1, 2)
        if self.steady is not None:
            done = np.full(LANES, self.drives[0].steps)
            lay_course(*self.steady, done, self.h, s, speed)
        else:
            for k, drive in enumerate(self.everyone):
                s[:, k], speed[:, k], turn[:, :, k] = drive.course(n)
        return s, speed, turn.reshape(4 * n + 2, LANES)

    def land(self) -> None:
        """Put the drives where their vehicles are."""
        for k, drive in enumerate(self.drives):
            drive.state[:] = np.concatenate([self.q[:, k], self.v[:, k]])
            drive.memory[:] = self.memory[:, :, k]
            if self.delay[k]:
                ring = self.pipe[: self.delay[k], k]
                drive.pipe = np.roll(ring, -(self.passed[k] % self.delay[k]))


def _steady(drives: Sequence[Drive]) -> tuple[np.ndarray, np.ndarray] | None:
    """Starts [m] and speeds [m/s] of drives that are all alike in time and keep their speed."""
    alike = all(
        len(d.profile.v) == 1 and d.manoeuvre is None and d.steps == drives[0].steps for d in drives
    )
    if not alike:
        return None
    return np.array([d.start for d in drives]), np.array([d.profile.v[0] for d in drives])


def _ways(surfaces: Sequence[Surface]) -> Ways:
    sizes = np.array([surface.padded.shape[1] for surface in surfaces])
    left = np.cumsum([0, *2 * sizes[:-1]])
    return Ways(
        np.concatenate([surface.padded.ravel() for surface in surfaces]),
        copied(np.stack([left, left + sizes]).astype(float)),
        copied(sizes.astype(float)),
        copied(np.array([surface.start for surface in surfaces])),
        copied(np.array([surface.ds for surface in surfaces])),
    )


class Fleet:
    """Drives that go on side by side, each its own vehicle, surface, speed and commands.

    All take the same integrator step. While they are in the fleet it holds their motion; `land`
    puts it back into the drives. Blocks of LANES vehicles are spread over `threads`. `columns`
    chooses signals, all 29 (of flexible cars 32) by default; what is not needed is better left out,
    since writing costs time. Raises ConfigError on drives of different steps, on cars of which some
    have a flexible frame and some have none, on an empty fleet and on unknown columns.
    """

    def __init__(
        self, drives: Sequence[Drive], threads: int = 1, columns: Sequence[int] | None = None
    ):
        if not drives:
            raise ConfigError("a fleet needs at least one drive")
        if len({drive.step for drive in drives}) > 1:
            raise ConfigError("the drives of a fleet must have one integrator step")
        if len({drive.plant.flexible for drive in drives}) > 1:
            raise ConfigError("the cars of a fleet must all have a flexible frame, or none of them")
        rows = signals_of(drives[0].plant)
        columns = range(rows) if columns is None else columns
        if wrong := [c for c in columns if not 0 <= c < rows]:
            raise ConfigError(f"columns of signals are 0 to {rows - 1}, got {wrong}")
        self.drives, self.threads, self.columns = list(drives), threads, np.array(columns)
        self.blocks = [_Block(drives[i : i + LANES]) for i in range(0, len(drives), LANES)]

    def signals(self, n: int) -> np.ndarray:
        """Room (blocks, n, C, LANES) for the signals of n steps, to be used again and again."""
        return aligned(len(self.blocks), n, self.columns.size)

    def advance(self, commands: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Signals (blocks, n, C, LANES) at the beginnings of n steps, in `out` if it is given.

        `commands` (vehicles, n) are bytes. Vehicle k is lane k % LANES of block k // LANES; `of`
        picks it. A vehicle whose motion leaves the range of numbers has NaN in its signals; the
        others do not notice.
        """
        commands = np.asarray(commands, dtype=np.uint8)
        parts = [commands[i * LANES : (i + 1) * LANES].T for i in range(len(self.blocks))]
        out = self.signals(commands.shape[1]) if out is None else out
        work = zip(self.blocks, parts, out, strict=True)
        if self.threads == 1:
            for block, part, signals in work:
                block.advance(part, self.columns, signals)
        else:
            workers = pool(self.threads)
            list(workers.map(lambda job: job[0].advance(job[1], self.columns, job[2]), work))
        return out

    def land(self) -> list[Drive]:
        """The drives, each where its vehicle is."""
        for block in self.blocks:
            block.land()
        return self.drives


def of(signals: np.ndarray, k: int) -> np.ndarray:
    """Signals (n, C) of vehicle `k` out of those of a fleet (blocks, n, C, LANES); a view."""
    return signals[k // LANES, :, :, k % LANES]
