"""The best that is known to be possible: a search over commands on a road that is known.

Not attainable: it drives every candidate over the road itself and keeps the best of them. From each
of `BEAM` drives every pair of ride and handling is tried for `HELD` seconds, and the best by the
return so far go on, beside the four drives that never switch. So no fixed pair of these beats it;
but it looks no further ahead, and it holds two of four states, so another policy may.
"""

from collections.abc import Sequence

import numpy as np

from road_envs.config import ConfigError
from road_envs.envs.options import Setup, Start
from road_envs.sensing.data_logger import Logger
from road_envs.simulation.control_step import TOLD
from road_envs.simulation.instrumented_fleet import Convoy
from road_envs.vehicle.suspension import command

BEAM = 16
HELD = 0.2
PAIRS = (("ride", "ride"), ("handling", "ride"), ("ride", "handling"), ("handling", "handling"))
FAITHFUL = np.arange(len(PAIRS)) * (len(PAIRS) + 1)
"""Where the cars that never switch stand: child k of place k."""


def plan(setup: Setup, starts: Sequence[Start]) -> np.ndarray:
    """Actions (T, N) for N drives that begin as `starts` and take equally long."""
    size = BEAM * len(PAIRS)
    convoy = setup.convoy(size * len(starts))
    for i, start in enumerate(starts):
        for k in range(size):
            logger = Logger(setup.instruments, setup.car, setup.options.step, _silence())
            convoy.start(i * size + k, start.drive, logger, start.speed_kmh)
    first = convoy.advance(np.full(convoy.number, starts[0].byte, dtype=np.uint8))
    if len({start.drive.steps_left for start in starts}) > 1:
        raise ConfigError("the search needs drives of one length")
    actions = [action(setup, pair) for pair in PAIRS]
    bytes_ = setup.bytes[actions]
    branch = np.tile(np.arange(size) % len(PAIRS), len(starts))
    held, returns = max(1, round(HELD / setup.interval)), np.zeros(convoy.number)
    chosen: list[np.ndarray] = []  # branch of every car at every macro step
    parents: list[np.ndarray] = []
    alive, intervals = not first.over.all(), 0
    best = np.arange(len(starts)) * size
    while alive:
        for _ in range(held):
            seen = convoy.advance(bytes_[branch])
            failed = (seen.turned >= 0) | (seen.broken >= 0)
            returns += np.where(failed, -np.inf, seen.numbers[:, TOLD.index("reward")])
            intervals += 1
            alive = not seen.over.all()
            if not alive:
                break
        chosen.append(branch.copy())
        order = np.argsort(-returns.reshape(len(starts), size), axis=1, kind="stable")
        first_car = size * np.arange(len(starts))[:, None]
        best = (order + first_car)[:, 0]
        order = np.concatenate([np.tile(FAITHFUL, (len(starts), 1)), order], axis=1)
        keep = np.repeat((order + first_car)[:, :BEAM], len(PAIRS), axis=1).ravel()
        parents.append(keep)
        if alive:
            transplant(convoy, keep)
            returns = returns[keep]
    return np.array(actions)[_trace(chosen, parents, best, held, intervals)]


def action(setup: Setup, pair: tuple[str, str]) -> int:
    """The action that commands this pair. Raises ConfigError."""
    byte = command({"front": pair[0], "rear": pair[1]})
    if byte not in setup.bytes:
        raise ConfigError("the search needs control 'axle' or 'states'")
    return int(np.flatnonzero(setup.bytes == byte)[0])


def transplant(convoy: Convoy, source: np.ndarray) -> None:
    """Put car k where car source[k] is, both on the same road."""
    lanes = convoy.cars.q.shape[-1]
    for name, array in zip(convoy.cars._fields, convoy.cars, strict=True):
        if name != "way":
            rows = np.moveaxis(array, -1, 1)  # (B, LANES, ...)
            rows[np.divmod(np.arange(convoy.number), lanes)] = rows[np.divmod(source, lanes)]


def _trace(chosen, parents, best, held, intervals) -> np.ndarray:
    """Branches (T, N) that led to the `best` cars (N,)."""
    car, branches = best, []
    for t in range(len(chosen) - 1, -1, -1):
        branches.append(chosen[t][car])
        if t > 0:
            car = parents[t - 1][car]
    return np.repeat(np.array(branches[::-1]), held, axis=0)[:intervals]


def _silence() -> np.random.Generator:
    return np.random.default_rng(0)
