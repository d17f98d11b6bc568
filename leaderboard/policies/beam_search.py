"""Beam search for commands on a known road: the oracle of the policy comparison.

The result is no attainable policy, because the search simulates every candidate on the test road.
From each of BEAM_WIDTH drives, every pair of ride and handling is simulated for HOLD_TIME seconds.
The best drives by the return so far are kept, together with the four that never switch, so no fixed
pair is better. The search looks no further ahead and uses two of the four strut states, so another
policy may still be better.
"""

from collections.abc import Sequence

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.envs.control_step import OUT_REWARD
from road_envs.envs.instrumented_fleet import InstrumentedFleet
from road_envs.envs.options import EnvSetup, EpisodeStart
from road_envs.sensing.data_logger import DataLogger
from road_envs.vehicle.suspension import encode_command

BEAM_WIDTH = 16
HOLD_TIME = 0.2
MODE_PAIRS = (
    ("ride", "ride"),
    ("handling", "ride"),
    ("ride", "handling"),
    ("handling", "handling"),
)
CONSTANT_BRANCHES = np.arange(len(MODE_PAIRS)) * (len(MODE_PAIRS) + 1)
"""Indices of the vehicles that never switch: child k of parent k."""


def search_actions(setup: EnvSetup, starts: Sequence[EpisodeStart]) -> np.ndarray:
    """Return actions (T, N) for N drives of equal length that begin as `starts`.

    Raises ConfigError if the lengths differ or if `setup` cannot command the pairs.
    """
    size = BEAM_WIDTH * len(MODE_PAIRS)
    fleet = setup.make_fleet(size * len(starts))
    for i, start in enumerate(starts):
        for k in range(size):
            rng = np.random.default_rng(0)  # of sensor noise, which the search does not read
            logger = DataLogger(setup.instruments, setup.car, setup.options.step, rng)
            fleet.start(i * size + k, start.drive, logger, start.speed_kmh)
    first = fleet.advance(np.full(fleet.n_vehicles, starts[0].command_byte, dtype=np.uint8))
    if len({start.drive.steps_left for start in starts}) > 1:
        raise ConfigError("the oracle needs drives of equal length on all roads of a case")
    actions = [action_index(setup, pair) for pair in MODE_PAIRS]
    bytes_ = setup.command_bytes[actions]
    branch = np.tile(np.arange(size) % len(MODE_PAIRS), len(starts))
    n_hold, returns = max(1, round(HOLD_TIME / setup.interval)), np.zeros(fleet.n_vehicles)
    chosen: list[np.ndarray] = []  # branch of every vehicle at every macro step
    parents: list[np.ndarray] = []
    running, intervals = not first.end_of_road.all(), 0
    best = np.arange(len(starts)) * size
    while running:
        for _ in range(n_hold):
            output = fleet.advance(bytes_[branch])
            returns += np.where(output.failed, -np.inf, output.values[:, OUT_REWARD])
            intervals += 1
            running = not output.end_of_road.all()
            if not running:
                break
        chosen.append(branch.copy())
        order = np.argsort(-returns.reshape(len(starts), size), axis=1, kind="stable")
        first_vehicle = size * np.arange(len(starts))[:, None]
        best = (order + first_vehicle)[:, 0]
        # the beam is the first BEAM_WIDTH of `order`: drives without a switch always survive
        order = np.concatenate([np.tile(CONSTANT_BRANCHES, (len(starts), 1)), order], axis=1)
        keep = np.repeat((order + first_vehicle)[:, :BEAM_WIDTH], len(MODE_PAIRS), axis=1).ravel()
        parents.append(keep)
        if running:
            copy_vehicles(fleet, keep)
            returns = returns[keep]
    return np.array(actions)[_backtrack(chosen, parents, best, n_hold, intervals)]


def action_index(setup: EnvSetup, pair: tuple[str, str]) -> int:
    """Return the action that commands this pair. Raises ConfigError."""
    byte = encode_command({"front": pair[0], "rear": pair[1]})
    if byte not in setup.command_bytes:
        raise ConfigError("the oracle needs control 'axle' or 'states', got 'vehicle'")
    return int(np.flatnonzero(setup.command_bytes == byte)[0])


def copy_vehicles(fleet: InstrumentedFleet, source: np.ndarray) -> None:
    """Overwrite the state of vehicle k by that of vehicle source[k] on the same road."""
    lanes = fleet.state.q.shape[-1]
    for name, array in zip(fleet.state._fields, fleet.state, strict=True):
        if name != "road_layout":
            rows = np.moveaxis(array, -1, 1)  # (B, LANES, ...)
            rows[np.divmod(np.arange(fleet.n_vehicles), lanes)] = rows[np.divmod(source, lanes)]


def _backtrack(chosen, parents, best, n_hold, intervals) -> np.ndarray:
    """Return the branches (T, N) that led to the `best` vehicles (N,)."""
    car, branches = best, []
    for t in range(len(chosen) - 1, -1, -1):
        branches.append(chosen[t][car])
        if t > 0:
            car = parents[t - 1][car]
    return np.repeat(np.array(branches[::-1]), n_hold, axis=0)[:intervals]
