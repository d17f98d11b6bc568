"""Best switching found on known drives: a line that no policy of the comparison may exceed.

A stratified beam search over all sixteen pairs of states keeps, for each pair commanded last, the
drives with the best score so far: a history that pays later is not lost to others of another pair.
Sweeps then go on from the best of the beam and of every policy of the comparison. A sweep drives
through a plan from its beginning. At each choice every pair, held for several times, replaces the
plan there; the best over a horizon, after which the plan goes on as it was, becomes the plan. Only
the best trials go on to the end of the horizon. The best plan of a whole drive is kept, so the
result is at least as good as every policy that it starts from. It knows the road ahead and is no
attainable policy; a longer search may find more.
"""

from collections.abc import Callable, Sequence

import numpy as np

from road_envs.envs.fleet_arrays import StepOutput
from road_envs.envs.instrumented_fleet import InstrumentedFleet
from road_envs.policies.rollout import VIOLATION_PRICE, Drives, Rollout, replay

HOLD_TIME = 0.2
"""Time [s] between choices of the beam."""

SWEEP_TIME, HORIZON = 0.1, 1.0
"""Time [s] between choices of a sweep, and over which they are compared: a period of the body."""

LONGEST_SECTION = 1.2
"""Longest time [s] for which a choice of a sweep is held; times are uniform in their logarithm."""

SECTIONS = 3
"""Times for which each pair is tried at each choice."""

TRIAL_TIME, FINALISTS = 0.4, 16
"""Time [s] after which only the best trials of a choice go on, and their number."""

SWEEPS = 8
"""Sweeps by default."""

Progress = Callable[[str, float], None]


def search(
    drives: Drives,
    rows: Sequence[np.ndarray],
    seed: int,
    *,
    sweeps: int = SWEEPS,
    progress: Progress = lambda text, share: None,
) -> Rollout:
    """Return the best drives found; `rows` are actions (T, N) of policies on these drives.

    The score is that of `Rollout`: violations have their price.
    """
    n, T, rng = len(drives), max(len(row) for row in rows), np.random.default_rng(seed)
    candidates = [np.concatenate([row, np.repeat(row[-1:], T - len(row), axis=0)]) for row in rows]
    beams = np.zeros((T, n), dtype=np.int64)
    for i in range(n):
        progress("beam", 0.2 * i / n)
        own = beam(drives, i)[0]
        beams[: len(own), i] = own[:T]
    candidates.append(beams)
    scores = np.array([replay(drives, actions).score for actions in candidates])
    best = np.stack([candidates[scores[:, i].argmax()][:, i] for i in range(n)], axis=1)
    score, plans = scores.max(axis=0), best.copy()
    for k in range(sweeps):
        for i in range(n):
            progress("sweeps", 0.2 + 0.8 * (k + i / n) / sweeps)
            sweep(drives, i, plans[:, i], rng)
        found = replay(drives, plans).score
        better = found > score
        best[:, better], score[better] = plans[:, better], found[better]
    return replay(drives, best)


def beam(drives: Drives, i: int) -> tuple[np.ndarray, float]:
    """Return actions (T,) of drive number `i` by the stratified beam search, and their score."""
    setup, pairs = drives.setup, len(drives.setup.command_bytes)
    fleet = _started(drives, i, pairs * pairs)
    # vehicle k drives child k % pairs of parent k // pairs: each parent tries every pair
    child = np.arange(fleet.n_vehicles) % pairs
    hold, score = max(1, round(HOLD_TIME / setup.interval)), np.zeros(fleet.n_vehicles)
    history = np.zeros((0, fleet.n_vehicles), dtype=np.int64)
    running = bool((fleet.steps_left > 0).all())
    while running:
        for _ in range(hold):
            output = fleet.advance(setup.command_bytes[child])
            score -= _price(output, fleet, fleet.n_vehicles)
            running = not output.end_of_road.all()
            if not running:
                break
        history = np.concatenate([history, child[None]])
        # of each pair commanded last, the best history becomes a parent
        parents = np.argmax(score.reshape(-1, pairs), axis=0) * pairs + np.arange(pairs)
        best = history[:, score.argmax()]
        source = np.repeat(parents, pairs)
        if running:
            fleet.copy_vehicles(source)
            score, history = score[source], history[:, source]
    return np.repeat(best, hold), float(score.max())


def sweep(drives: Drives, i: int, plan: np.ndarray, rng: np.random.Generator) -> None:
    """Improve the `plan` (T,) of actions of drive number `i` in place, from its first choice on."""
    setup, pairs = drives.setup, len(drives.setup.command_bytes)
    fleet = _started(drives, i, pairs * SECTIONS)
    pair = np.arange(fleet.n_vehicles) % pairs
    hold, horizon = (round(time / setup.interval) for time in (SWEEP_TIME, HORIZON))
    shortest, end = max(1, hold), int(fleet.steps_left[0]) // fleet.steps
    for k in range(0, end, shortest):
        kept = plan[k : min(k + horizon, end)]
        seconds = np.exp(rng.uniform(np.log(SWEEP_TIME), np.log(LONGEST_SECTION), SECTIONS))
        lengths = np.repeat(np.maximum(1, np.rint(seconds / setup.interval)), pairs)
        lengths[0] = 0.0  # the plan as it is
        # vehicle v commands its pair for the length of its section, and then the plan
        trials = np.where(np.arange(kept.size)[:, None] < lengths, pair, kept[:, None])
        cost, alive = np.zeros(fleet.n_vehicles), np.arange(fleet.n_vehicles)
        for j in range(len(trials)):
            if j == round(TRIAL_TIME / setup.interval):
                # the plan as it is goes on in any case
                order = np.where(np.arange(cost.size) > 0, cost, -np.inf)
                alive = np.argsort(order, kind="stable")[:FINALISTS]
                fleet.copy_vehicles(alive, np.arange(len(alive)))
            commands = np.resize(trials[j, alive], fleet.n_vehicles)
            moving = np.arange(fleet.n_vehicles) < len(alive)
            output = fleet.advance(setup.command_bytes[commands], None if moving.all() else moving)
            cost[alive] += _price(output, fleet, len(alive))
            if j == min(shortest, len(trials)) - 1:
                state = fleet.copy_state()
        best = int(alive[cost[alive].argmin()])
        kept[:] = trials[:, best]
        fleet.restore_state(state)
        fleet.copy_vehicles(np.full(fleet.n_vehicles, best))


def _started(drives: Drives, i: int, size: int) -> InstrumentedFleet:
    """Return `size` vehicles on drive number `i`, after the interval of a reset."""
    fleet = drives.start(size, [i])
    fleet.advance(int(drives.starts[i].command_byte))
    return fleet


def _price(output: StepOutput, fleet: InstrumentedFleet, n: int) -> np.ndarray:
    """Return the price (n,) [m²/s³] of an interval for the first `n` vehicles."""
    columns = [fleet.columns.index("comfort"), fleet.columns.index("cost")]
    comfort, cost = output.values[:n, columns].T
    return np.where(output.failed[:n], np.inf, comfort + VIOLATION_PRICE * cost)
