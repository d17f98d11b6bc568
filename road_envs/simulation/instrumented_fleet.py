"""Equal instrumented cars, each on its own road, driven side by side, interval by interval.

This is what an environment advances. A car's numbers do not depend on its company, so that an
environment of one car and one of thousands agree to the bit.
"""

from collections.abc import Callable
from math import ceil

import numpy as np

from road_envs.analysis.comfort import wk_sos
from road_envs.config import ConfigError
from road_envs.data.record import SENSORS
from road_envs.roads.surface import PAD
from road_envs.sensing.data_logger import Instruments, Logger
from road_envs.simulation.control_step import (
    BEGIN,
    DONE,
    DS,
    FIRST,
    PASSED,
    PLANAR,
    SIZE,
    SPEED,
    SPEED_GAIN,
    SPEED_KMH,
    START,
    STRUTS,
    TOLD,
    TOTAL,
    USED,
    Cars,
    Common,
    Seen,
    desk,
    drive_blocks,
    scratch,
)
from road_envs.simulation.drive import Drive, Trajectory
from road_envs.simulation.fleet import aligned, copied, numbers_of, pool
from road_envs.simulation.manoeuvres import Manoeuvre
from road_envs.simulation.rosenbrock import SIGNALS
from road_envs.simulation.simd import LANES
from road_envs.vehicle.equations import N_DOF, Plant
from road_envs.vehicle.parameters import VehicleParameters

AHEAD = 20
"""Intervals for which noise is drawn at once, in the order in which it would be drawn singly."""


def levers(logger: Logger) -> np.ndarray:
    """Rows (3, 3) that take heave, roll and pitch acceleration to the sensors."""
    return np.array([[1.0, y, -x] for x, y in logger.places])


class Convoy:
    """`number` cars of one make, each of them started by `start` and then driven by `advance`.

    `steps` of `step` [s] make an interval, a whole number of samples of the `instruments`. With
    `truth`, what is `Seen` holds the road and the tyre loads. Blocks are spread over `threads`.
    Plain NumPy state, so copies and pickles work. Raises ConfigError if the instruments cannot
    sample at these steps.
    `weights` are those of the three costs in the reward; `top_speed` [m/s] is the highest that is
    observed; `planar` and `struts` add these groups to what is observed. `unknown` says, for a
    speed [m/s], what each command byte leaves unknown of the road (256,) [-], a fourth cost with
    the weight `information`.
    """

    def __init__(
        self,
        plant: Plant,
        car: VehicleParameters,
        instruments: Instruments,
        *,
        step: float,
        steps: int,
        number: int = 1,
        manoeuvre: Manoeuvre | None = None,
        weights: tuple[float, float, float] = (0.0, 0.0, 0.0),
        top_speed: float = np.inf,
        planar: bool = False,
        struts: bool = False,
        unknown: Callable[[float], np.ndarray] | None = None,
        information: float = 0.0,
        truth: bool = True,
        threads: int = 1,
    ):
        logger = Logger(instruments, car, step, np.random.default_rng(0))
        if steps % logger.every:
            raise ConfigError(
                f"an interval of {steps} steps of {step} s must hold a whole number of samples at "
                f"{instruments.fs} Hz"
            )
        self.plant, self.car, self.manoeuvre = plant, car, manoeuvre
        self.step, self.steps, self.number, self.truth = step, steps, number, truth
        self.threads, self.samples = threads, steps // logger.every
        blocks = ceil(number / LANES)
        self.rngs: list[np.random.Generator | None] = [None] * (blocks * LANES)
        delay = round(car.valve.delay / step)
        groups = (int(planar), int(struts))
        self.common = _common(plant, car, logger, step, delay, weights, top_speed, groups)
        self.width = len(SENSORS) * self.samples + 5 + planar * PLANAR + struts * STRUTS
        self.unknown, self.information = unknown, information
        self.left_unknown = np.zeros((number, 256 if unknown else 0))
        self.cars = _parked(blocks, delay, len(logger.sos), len(self.common.wk_sos))
        self.heights = np.zeros((blocks, LANES * 2 * (4 + 2 * PAD)))
        self._lay_out(4 + 2 * PAD)
        rows = AHEAD * steps if logger.noise_std > 0.0 else 1
        self.noise = np.zeros((blocks, LANES, rows, len(SENSORS)))
        self._moving = np.arange(blocks)
        self._desks = [_desk(steps) for _ in range(min(threads, blocks))]
        self._straight = np.zeros((1, 4 * steps + 2, LANES))

    def start(self, i: int, drive: Drive, logger: Logger, speed_kmh: float) -> None:
        """Put car `i` at the beginning of a `drive`, at one speed, seen through a `logger`.

        `speed_kmh` is that speed as it will be told.
        """
        b, k = divmod(i, LANES)
        self._pave(b, k, drive)
        cars = self.cars
        cars.q[b, :, k], cars.v[b, :, k] = drive.state[:N_DOF], drive.state[N_DOF:]
        cars.memory[b, :, :, k], cars.pipe[b, :, k] = drive.memory, drive.pipe
        cars.alias[b, ..., k], cars.wk[b, ..., k], cars.levers[b, ..., k] = 0.0, 0.0, levers(logger)
        course, counts = cars.course[b, :, k], cars.counts[b, :, k]
        course[BEGIN], course[SPEED], course[SPEED_GAIN] = (
            drive.start,
            drive.speed,
            logger.speed_gain,
        )
        course[SPEED_KMH] = speed_kmh
        counts[PASSED], counts[DONE], counts[TOTAL] = 0, 0, drive.steps_left
        counts[USED], self.rngs[i] = self.noise.shape[2], logger.rng
        if self.unknown is not None:
            self.left_unknown[i] = self.unknown(drive.speed)

    def advance(self, commands: np.ndarray, mask: np.ndarray | None = None) -> Seen:
        """Drive one interval under `commands` (N,) uint8; the cars outside `mask` (N,) stand still.

        Rows of cars outside the mask say nothing.
        """
        blocks, size = len(self.heights), len(self.heights) * LANES
        given = np.zeros(size, dtype=np.uint8)
        given[: self.number] = commands
        moving = self._moving if mask is None else np.unique(np.flatnonzero(mask) // LANES)
        if self.common.noise_std > 0.0:
            self._draw_noise(moving)
        kept = None if mask is None else [field[moving] for field in self.cars]
        seen, byte, turns = self._room(size), given.reshape(blocks, LANES), self._turns()
        inputs = (self.cars, self.common, self.heights, self.noise, byte)

        def drive(job: np.ndarray, pipes: np.ndarray, room: np.ndarray) -> None:
            drive_blocks(job, *inputs, pipes, turns, room, seen)

        if len(self._desks) == 1:
            drive(moving, *self._desks[0])
        else:
            jobs = np.array_split(moving, len(self._desks))
            list(pool(len(jobs)).map(lambda job, top: drive(job, *top), jobs, self._desks))
        if mask is not None and kept is not None:
            self._put_back(moving, mask, kept)
        if self.unknown is not None:
            self._charge(commands, seen.numbers)
        return seen if size == self.number else Seen(*(field[: self.number] for field in seen))

    def _charge(self, commands: np.ndarray, numbers: np.ndarray) -> None:
        """Charge the rewards with what the commanded states leave unknown of the road."""
        unknown = self.left_unknown[np.arange(self.number), commands]
        numbers[: self.number, TOLD.index("unknown")] = unknown
        interval = self.steps * self.step
        numbers[: self.number, TOLD.index("reward")] -= interval * self.information * unknown

    @property
    def done(self) -> np.ndarray:
        """Steps taken (N,)."""
        return self.cars.counts[:, DONE].ravel()[: self.number]

    @property
    def steps_left(self) -> np.ndarray:
        """Steps until the cars' drives are over (N,)."""
        left = self.cars.counts[:, TOTAL] - self.cars.counts[:, DONE]
        return left.ravel()[: self.number]

    def land(self, i: int, drive: Drive) -> None:
        """Put `drive` where car `i` is."""
        b, k = divmod(i, LANES)
        drive.state[:N_DOF], drive.state[N_DOF:] = self.cars.q[b, :, k], self.cars.v[b, :, k]
        drive.memory[:] = self.cars.memory[b, :, :, k]
        drive.steps = int(self.cars.counts[b, DONE, k])
        if drive.pipe.size:
            ring = self.cars.pipe[b, :, k]
            drive.pipe = np.roll(ring, -(self.cars.counts[b, PASSED, k] % ring.size))

    def last_interval(self, i: int, command: int) -> Trajectory:
        """The motion of car `i` in the last interval, under `command`; of the first block only."""
        last = desk(self._desks[0][1], self.steps)
        begin = int(self.cars.counts[0, DONE, i]) - self.steps
        t = self.step * (begin + np.arange(self.steps))
        commands = np.full(self.steps, command, dtype=np.uint8)
        s, v = last.s[:-1:2, i].copy(), last.v[:-1:2, i].copy()
        return Trajectory(t, s, v, commands, last.out[:, :, i].copy())

    def _pave(self, b: int, k: int, drive: Drive) -> None:
        """Lay the surface of `drive` under lane `k` of block `b`."""
        z = drive.surface.z
        size = z.shape[1] + 2 * PAD
        if size > self.heights.shape[1] // (2 * LANES):
            self._lay_out(size)
        room = self.heights.shape[1] // (2 * LANES)
        for side in range(2):
            at = (2 * k + side) * room
            lane = self.heights[b, at : at + size]
            lane[:PAD], lane[PAD:-PAD], lane[-PAD:] = z[side, 0], z[side], z[side, -1]
        way = self.cars.way[b, :, k]
        way[SIZE], way[START], way[DS] = size, drive.surface.start, drive.surface.ds

    def _lay_out(self, room: int) -> None:
        """Make room for `room` samples of each wheel path of every lane."""
        blocks, old = len(self.heights), self.heights.shape[1] // (2 * LANES)
        heights = np.zeros((blocks, 2 * LANES, room))
        kept = min(old, room)
        heights[:, :, :kept] = self.heights.reshape(blocks, 2 * LANES, old)[:, :, :kept]
        self.heights = heights.reshape(blocks, 2 * LANES * room)
        at = room * np.arange(2.0 * LANES).reshape(LANES, 2)
        self.cars.way[:, FIRST:SIZE] = at.T

    def _draw_noise(self, moving: np.ndarray) -> None:
        rows, used = self.noise.shape[2], self.cars.counts[:, USED]
        if used.max() < rows:
            return
        for b in moving[(used[moving] >= rows).any(axis=1)]:
            for k in np.flatnonzero(used[b] >= rows):
                rng = self.rngs[b * LANES + k]
                if rng is not None:
                    rng.standard_normal(out=self.noise[b, k])
                used[b, k] = 0

    def _turns(self) -> np.ndarray:
        """a_x, a_y one below the other (B or 1, 4 n + 2, LANES) for the coming interval."""
        if self.manoeuvre is None:
            return self._straight
        done = self.cars.counts[:, DONE]
        instants = 0.5 * self.step * (2 * done[:, None] + np.arange(2 * self.steps + 1)[:, None])
        turn = self.manoeuvre.at(instants)
        return np.moveaxis(turn, -1, 2).reshape(len(done), 4 * self.steps + 2, LANES)

    def _room(self, size: int) -> Seen:
        """Fresh arrays for what `size` lanes will have seen."""
        truth = self.samples if self.truth else 0
        return Seen(
            np.empty((size, self.width), dtype=np.float32),
            np.empty((size, len(TOLD))),
            np.empty(size, dtype=bool),
            np.empty(size, dtype=np.int64),
            np.empty(size, dtype=np.int64),
            np.empty((size, truth)),
            np.empty((size, 2, truth)),
            np.empty((size, 4, truth)),
        )

    def _put_back(self, moving: np.ndarray, mask: np.ndarray, kept: list[np.ndarray]) -> None:
        """Undo what the last interval did to cars outside the `mask`."""
        still = np.ones(len(self.heights) * LANES, dtype=bool)
        still[: self.number] = ~mask
        for field, before in zip(self.cars, kept, strict=True):
            for at, b in enumerate(moving):
                lanes = still[b * LANES : (b + 1) * LANES]
                field[b][..., lanes] = before[at][..., lanes]


def _desk(steps: int) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((2, steps, LANES), dtype=np.uint8), scratch(steps)


def _common(plant, car, logger, step, delay, weights, top_speed, groups) -> Common:
    numbers = np.repeat(plant.numbers, LANES)
    return Common(
        numbers_of(numbers),
        numbers,
        plant.velocity,
        plant.displacement,
        np.full(LANES, delay),
        copied(np.full(LANES, 1.0 - np.exp(-step / car.valve.lag))),
        np.repeat(car.tyre_loads, 2),
        np.array(weights, dtype=float),
        logger.sos,
        wk_sos(1.0 / step),
        np.arange(SIGNALS),
        float(logger.noise_std),
        float(logger.range),
        float(top_speed),
        step,
        logger.every,
        *groups,
    )


def _parked(blocks: int, delay: int, alias: int, wk: int) -> Cars:
    """Cars that stand still on level ground, all lanes of every block."""
    cars = Cars(
        q=aligned(blocks, N_DOF),
        v=aligned(blocks, N_DOF),
        memory=aligned(blocks, 4, 3),
        pipe=np.zeros((blocks, delay, LANES), dtype=np.uint8),
        alias=aligned(blocks, alias, len(SENSORS), 2),
        wk=aligned(blocks, wk, 1, 2),
        levers=aligned(blocks, len(SENSORS), 3),
        counts=np.zeros((blocks, 4, LANES), dtype=np.int64),
        course=aligned(blocks, 4),
        way=aligned(blocks, 5),
    )
    cars.way[:, SIZE], cars.way[:, DS] = 4.0 + 2.0 * PAD, 1.0
    return cars
