"""Best switching found on known drives: a line that no policy of the comparison may exceed.

A stratified beam search over all sixteen pairs of states keeps, for each pair commanded last, the
drives with the best score so far: a history that pays later is not lost to others of another pair.
Hill climbing then goes on from the best of the beam and of every policy of the comparison. In each
generation a drive's candidates are its best actions with random sections set to another pair; the
best of them stays. So the result is at least as good as every policy that it starts from. It knows
the road ahead and is no attainable policy; a longer search may find more.
"""

from collections.abc import Callable, Sequence

import numpy as np

from road_envs.policies.safe_rollout import VIOLATION_PRICE, SafeDrives, SafeRollout, Totals

HOLD_TIME = 0.2
"""Time [s] between choices of the beam, and the shortest section of a mutant."""

LONGEST_SECTION = 3.0
"""Longest section of a mutant [s]; lengths are uniform in their logarithm."""

KEPT_PER_PAIR = 1
"""Histories that the beam keeps for each last pair."""

MUTANTS, GENERATIONS = 16, 30
"""Candidates of a drive in a generation, and the number of generations."""

Progress = Callable[[str, float], None]


def search(
    drives: SafeDrives,
    rows: Sequence[np.ndarray],
    seed: int,
    *,
    generations: int = GENERATIONS,
    progress: Progress = lambda text, share: None,
) -> SafeRollout:
    """Return the best drives found; `rows` are actions (T, N) of policies on these drives.

    The score is that of `SafeRollout`: violations have their price.
    """
    n = len(drives)
    T = max(len(row) for row in rows)
    candidates = [np.concatenate([row, np.repeat(row[-1:], T - len(row), axis=0)]) for row in rows]
    beams = np.zeros((T, n), dtype=np.int64)
    for i in range(n):
        progress("beam", 0.2 * i / n)
        own = beam(drives, i)[0]
        beams[: len(own), i] = own[:T]
    candidates.append(beams)
    scores = np.array([replay(drives, actions).score for actions in candidates])
    best = np.stack([candidates[scores[:, i].argmax()][:, i] for i in range(n)], axis=1)
    score, rng = scores.max(axis=0), np.random.default_rng(seed)
    for generation in range(generations):
        progress("climbing", 0.2 + 0.8 * generation / generations)
        mutants = np.repeat(best, MUTANTS, axis=1)
        for column in mutants.T:
            _mutate(column, rng, drives.setup.interval)
        found = replay(drives, mutants, copies=MUTANTS).score.reshape(n, MUTANTS)
        better = found.max(axis=1) > score
        chosen = mutants.reshape(T, n, MUTANTS)[:, np.arange(n), found.argmax(axis=1)]
        best[:, better], score[better] = chosen[:, better], found.max(axis=1)[better]
    return replay(drives, best)


def replay(drives: SafeDrives, actions: np.ndarray, copies: int = 1) -> SafeRollout:
    """Drive all drives, each in `copies` vehicles in a row, under actions (T, copies N)."""
    fleet, setup = drives.start(copies), drives.setup
    first = np.repeat([start.command_byte for start, _ in drives.starts], copies)
    fleet.advance(first.astype(np.uint8))
    totals = Totals(fleet.n_vehicles)
    for row in actions:
        totals.add(fleet.advance(setup.command_bytes[row]))
        if not totals.running.any():
            break
    return totals.rollout(actions, setup.interval)


def beam(drives: SafeDrives, i: int) -> tuple[np.ndarray, float]:
    """Return actions (T,) of drive number `i` by the stratified beam search, and their score."""
    setup, pairs = drives.setup, len(drives.setup.command_bytes)
    size = KEPT_PER_PAIR * pairs * pairs
    fleet = drives.start(size, [i])
    command = drives.starts[i][0].command_byte
    running = not fleet.advance(np.full(size, command, np.uint8)).end_of_road.all()
    # vehicle k drives child k % pairs of parent k // pairs: each parent tries every pair
    child = np.arange(size) % pairs
    hold, score = max(1, round(HOLD_TIME / setup.interval)), np.zeros(size)
    history = np.zeros((0, size), dtype=np.int64)
    columns = [setup.output_columns.index(name) for name in ("comfort", "cost")]
    while running:
        for _ in range(hold):
            output = fleet.advance(setup.command_bytes[child])
            comfort, cost = output.values[:, columns].T
            score -= np.where(output.failed, np.inf, comfort + VIOLATION_PRICE * cost)
            running = not output.end_of_road.all()
            if not running:
                break
        history = np.concatenate([history, child[None]])
        # of each pair commanded last, the best histories become parents
        order = np.argsort(-score.reshape(-1, pairs), axis=0, kind="stable")[:KEPT_PER_PAIR]
        parents = (order * pairs + np.arange(pairs)).T.ravel()
        best = history[:, score.argmax()]
        source = np.repeat(parents, pairs)
        if running:
            fleet.copy_vehicles(source)
            score, history = score[source], history[:, source]
    return np.repeat(best, hold), float(score.max())


def _mutate(actions: np.ndarray, rng: np.random.Generator, interval: float) -> None:
    """Set one to three random sections of `actions` (T,) to another pair, or shift their edges."""
    for _ in range(rng.integers(1, 4)):
        seconds = np.exp(rng.uniform(*np.log([HOLD_TIME, LONGEST_SECTION])))
        length = max(1, round(seconds / interval))
        first = int(rng.integers(0, max(1, actions.size - length)))
        part = actions[first : first + length]
        # half of the sections continue the pair before them: edges move earlier or later
        part[:] = actions[max(first - 1, 0)] if rng.random() < 0.5 else rng.integers(16)
