"""Best switching found on known drives: a line that no policy of the comparison may exceed.

A stratified beam search over all sixteen pairs of states keeps, for each pair commanded last, the
drives with the best score so far: a history that pays later is not lost to others of another pair.
Sweeps then go on from the best of the beam and of every policy of the comparison. At each choice
every pair, held for several times, replaces the plan there; the best over a horizon, after which
the plan goes on as it was, becomes the plan. Only the best trials go on to the end of the horizon,
which is two periods of the body: over a shorter one a choice gains now what it pays later.

Most of a drive's price, and nearly all of what two searches differ by, is in its severe manoeuvre.
So every sweep of a whole drive is followed by some of its dearest window, which are annealed: the
costs of the trials are raised by random shares, which fall from _HEAT to none. The best plan is
kept, so the result is at least as good as every policy that it starts from. It knows the road ahead
and is no attainable policy; how much two searches differ by tells what a longer one may find.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import numpy as np

from road_envs.envs.fleet_arrays import StepOutput
from road_envs.envs.instrumented_fleet import InstrumentedFleet
from road_envs.kernels.simd import LANES
from road_envs.policies.rollout import VIOLATION_PRICE, Drives, Rollout, replay

_HOLD_TIME = 0.2  # time [s] between choices of the beam
_SWEEP_TIME, _HORIZON = 0.1, 2.4  # [s] between choices of a sweep, and over which they are compared
_LONGEST_SECTION = 1.2  # longest time [s] of a choice; times are uniform in their logarithm
_SECTIONS = 3  # times for which each pair is tried at each choice
_TRIAL_TIME, _FINALISTS = 0.4, LANES  # time [s] after which only so many trials go on
_WINDOW, _WINDOW_SWEEPS = 5.5, 5  # [s] of the dearest window, and its sweeps after each whole one
_HEAT, _COOLING = 0.02, 0.7  # mean rise of the costs of trials at first; share of sweeps until none
SWEEPS = 6  # sweeps of the whole drive by default
Progress = Callable[[str, float], None]


def search(
    drives: Drives,
    rows: Sequence[np.ndarray],
    seeds: Sequence[int],
    *,
    sweeps: int = SWEEPS,
    progress: Progress = lambda text, share: None,
) -> tuple[Rollout, np.ndarray]:
    """Return the best drives found from any of S `seeds`, and the scores (S, N) from each.

    `rows` are actions (T, N) of policies on these drives. The score is that of `Rollout`:
    violations have their price. Seeds are searched in `drives.threads` at once.
    """
    n, T = len(drives), max(len(row) for row in rows)
    candidates = [np.concatenate([row, np.repeat(row[-1:], T - len(row), axis=0)]) for row in rows]
    beams = np.zeros((T, n), dtype=np.int64)
    for i in range(n):
        progress("beam", 0.1 * i / n)
        own = _beam(drives, i)[0]
        beams[: len(own), i] = own[:T]
    plans = _best([*candidates, beams], drives)[None].repeat(len(seeds), axis=0)
    stop = Event()

    def climbs(plan: np.ndarray, seed: int) -> None:
        alone, rng = drives.alone(), np.random.default_rng(seed)
        for i in range(n):
            if stop.is_set():
                return
            progress("sweeps", 0.1 + 0.9 * i / n)
            _climb(alone, i, plan[:, i], sweeps, rng)

    with ThreadPoolExecutor(drives.threads) as pool:
        try:
            list(pool.map(climbs, plans, seeds))
        finally:
            stop.set()
    scores = np.array([replay(drives, plan).score for plan in plans])
    return replay(drives, _best(list(plans), drives)), scores


def _best(plans: Sequence[np.ndarray], drives: Drives) -> np.ndarray:
    """Return the actions (T, N) of the best of some plans (T, N) on each drive."""
    scores = np.array([replay(drives, plan).score for plan in plans])
    return np.stack([plans[k][:, i] for i, k in enumerate(scores.argmax(axis=0))], axis=1)


def _climb(drives: Drives, i: int, best: np.ndarray, sweeps: int, rng: np.random.Generator) -> None:
    """Replace the plan `best` (T,) of drive number `i` by better ones, in `sweeps` of the drive."""
    prices, plan = _prices(drives, i, best), best.copy()
    least, length = prices.sum(), round(_WINDOW / drives.setup.interval)
    for k in range(sweeps):
        heat = _HEAT * max(1.0 - k / (_COOLING * sweeps), 0.0)
        for part in range(1 + _WINDOW_SWEEPS):
            if not heat:
                plan = best.copy()
            if part == 0:
                _sweep(drives, i, plan, rng)
            else:
                first = int(np.convolve(prices, np.ones(length), "valid").argmax())
                _sweep(drives, i, plan, rng, first, first + length, heat)
            prices = _prices(drives, i, plan)
            if prices.sum() < least:
                best[:], least = plan, prices.sum()


def _beam(drives: Drives, i: int) -> tuple[np.ndarray, float]:
    """Return actions (T,) of drive number `i` by the stratified beam search, and their score."""
    setup, pairs = drives.setup, len(drives.setup.command_bytes)
    fleet = _started(drives, i, pairs * pairs)
    # vehicle k drives child k % pairs of parent k // pairs: each parent tries every pair
    child = np.arange(fleet.n_vehicles) % pairs
    hold, score = max(1, round(_HOLD_TIME / setup.interval)), np.zeros(fleet.n_vehicles)
    history = np.zeros((0, fleet.n_vehicles), dtype=np.int64)
    running = bool((fleet.steps_left > 0).all())
    while running:
        for _ in range(hold):
            output = fleet.advance(setup.command_bytes[child])
            score -= _price(output, fleet)
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


def _sweep(
    drives: Drives, i: int, plan: np.ndarray, rng: np.random.Generator,
    first: int = 0, stop: int | None = None, heat: float = 0.0,
) -> None:  # fmt: skip
    """Improve the `plan` (T,) of actions of drive number `i` in place, from `first` to `stop`."""
    setup, pairs = drives.setup, len(drives.setup.command_bytes)
    fleet, few = (_started(drives, i, size) for size in (pairs * _SECTIONS, _FINALISTS))
    pair = np.arange(fleet.n_vehicles) % pairs
    times = _SWEEP_TIME, _TRIAL_TIME, _HORIZON
    hold, trial, horizon = (max(1, round(time / setup.interval)) for time in times)
    end = int(fleet.steps_left[0]) // fleet.steps
    for action in plan[:first]:
        fleet.advance(int(setup.command_bytes[action]))
    for k in range(first, min(stop or end, end), hold):
        kept = plan[k : min(k + horizon, end)]
        seconds = np.exp(rng.uniform(np.log(_SWEEP_TIME), np.log(_LONGEST_SECTION), _SECTIONS))
        lengths = np.repeat(np.maximum(1, np.rint(seconds / setup.interval)), pairs)
        lengths[0] = 0.0  # the plan as it is
        # vehicle v commands its pair for the length of its section, and then the plan
        trials = np.where(np.arange(kept.size)[:, None] < lengths, pair, kept[:, None])
        cost = np.zeros(fleet.n_vehicles)
        for j, row in enumerate(trials[:trial]):
            cost += _price(fleet.advance(setup.command_bytes[row]), fleet)
            if j == min(hold, len(trials)) - 1:
                state = fleet.copy_state()
        # the plan as it is goes on in any case
        order = np.where(np.arange(cost.size) > 0, cost, -np.inf)
        alive = np.argsort(order, kind="stable")[:_FINALISTS]
        fleet.copy_vehicles(alive)
        few.restore_state([field[:1] for field in fleet.state])  # the first block of lanes
        for row in trials[trial:, alive]:
            cost[alive] += _price(few.advance(setup.command_bytes[row]), few)
        raised = cost[alive] * (1.0 + heat * rng.exponential(size=len(alive)))
        best = int(alive[raised.argmin()])
        kept[:] = trials[:, best]
        fleet.restore_state(state)
        fleet.copy_vehicles(np.full(fleet.n_vehicles, best))


def _prices(drives: Drives, i: int, plan: np.ndarray) -> np.ndarray:
    """Return the price [m²/s³] of every interval of drive number `i` under a plan (T,)."""
    fleet = _started(drives, i, _FINALISTS)
    commands = drives.setup.command_bytes[plan[: int(fleet.steps_left[0]) // fleet.steps]]
    return np.array([_price(fleet.advance(int(byte)), fleet)[0] for byte in commands])


def _started(drives: Drives, i: int, size: int) -> InstrumentedFleet:
    """Return `size` vehicles on drive number `i`, after the interval of a reset."""
    fleet = drives.start(size, [i])
    fleet.advance(int(drives.starts[i].command_byte))
    return fleet


def _price(output: StepOutput, fleet: InstrumentedFleet) -> np.ndarray:
    """Return the price (N,) [m²/s³] of an interval for all vehicles."""
    comfort, cost = (output.values[:, fleet.columns.index(x)] for x in ("comfort", "cost"))
    return np.where(output.failed, np.inf, comfort + VIOLATION_PRICE * cost)
