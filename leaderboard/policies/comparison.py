"""The league of switching policies: comfort, handling, and what the drives tell of the road.

Every policy drives the same roads, side by side, without the truth in sight. Its commands are then
driven again to look at the whole motion, and the record of its own drive is given to estimators:
one that learns and comes without weights is trained on records of the same policy's drives over
training roads.
"""

import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from gymnasium.utils import seeding

from estimators.api import Estimator
from leaderboard.evaluation.entry import EntryError, needs_training, reconstruct
from leaderboard.metrics import heights
from leaderboard.metrics.bound import fit_spectrum, pooled_bound
from leaderboard.policies import beam_search
from leaderboard.policies.ride_metrics import METRICS, ride_metrics, state_time_shares
from leaderboard.policies.scenarios import Case, Scenarios
from leaderboard.policies.timeline import Timeline
from road_envs.data.record import Profile, Record, scored_band
from road_envs.data.recording import true_profile
from road_envs.envs.options import EnvSetup, EpisodeStart
from road_envs.policies.api import Policy, PolicyContext
from road_envs.policies.rollout import Rollout, roll_out
from road_envs.simulation.drive import Trajectory
from road_envs.simulation.fleet import Fleet, select_vehicle
from road_envs.simulation.instrumented_fleet import InstrumentedFleet
from road_envs.simulation.simd import LANES
from road_envs.vehicle.suspension import MODES, decode_commands

ORACLE = "oracle"
"""Not a policy: a search on the known road, as the upper bound."""

TIME_LIMIT = 120.0
"""Seconds that a policy may take over the drives of one case."""

Progress = Callable[[str, float], None]
"""Hears what is being done and the share of all work that is done."""


@dataclass(frozen=True)
class PolicyResult:
    """One policy's metrics, each (R, C): roads and cases; `errors` (R, C) in-band NRMSE [-] for
    each estimator. `failure` says why there are none; `notes`, what an estimator did not do.
    `timeline`: its first drive of the case that the scenarios want shown.
    """

    policy: str
    metrics: Mapping[str, np.ndarray] = field(default_factory=dict)
    errors: Mapping[str, np.ndarray] = field(default_factory=dict)
    failure: str | None = None
    notes: tuple[str, ...] = ()
    timeline: Timeline | None = None


class PreparedCase(NamedTuple):
    """One case made ready: how its drives begin and what lies under them, road by road."""

    case: Case
    options: dict[str, Any]
    setup: EnvSetup
    seeds: tuple[int, ...]
    starts: tuple[EpisodeStart, ...]
    truths: tuple[Profile, ...]


def compare(
    scenarios: Scenarios,
    policies: Mapping[str, Policy | None],
    estimators: Mapping[str, Estimator],
    *,
    roads: int | None = None,
    progress: Progress = lambda text, share: None,
) -> list[PolicyResult]:
    """Drive every policy over every case; a failure is a row. None stands for the oracle.

    Raises ConfigError where the scenarios are bad input.
    """
    tests = [
        prepare_case(scenarios, c, scenarios.test_seeds(roads)) for c in range(len(scenarios.cases))
    ]
    lessons = (
        scenarios.training.seeds if any(map(needs_training, estimators.values())) else range(0)
    )
    training = [prepare_case(scenarios, c, lessons) for c in range(len(scenarios.cases))]
    results = []
    for i, (name, policy) in enumerate(policies.items()):
        columns: list[dict[str, np.ndarray]] = []
        notes: dict[str, None] = {}
        failure, shown = None, None
        for c, (test, known) in enumerate(zip(tests, training, strict=True)):
            progress(f"{name}: {test.case.label}", (i + c / len(tests)) / len(policies))
            try:
                with time_limit(TIME_LIMIT) if policy is not None else nullcontext():
                    driven = _rollout(policy, test)
                    seen = _rollout(policy, known) if known.seeds else None
                column, said = _evaluate(test, driven, known, seen, estimators)
                if c == scenarios.shown:
                    shown = Timeline.from_trajectory(
                        next(trajectories(test, driven)), test.starts[0].surface
                    )
            except Exception as error:  # whatever a policy does wrong is its own row's news
                said_by = " ".join(str(error).split()) or "no message"
                failure = f"{test.case.label}: {type(error).__name__}: {said_by}"
                break
            columns.append(column)
            notes |= dict.fromkeys(said)
        results.append(_result(name, columns, tuple(estimators), failure, tuple(notes), shown))
    progress("done", 1.0)
    return results


def prepare_case(scenarios: Scenarios, c: int, seeds: Sequence[int]) -> PreparedCase:
    """Case number `c` on the roads of `seeds`, as the environment would begin it."""
    case, setup = scenarios.cases[c], scenarios.setups[c]
    parking = setup.make_fleet()
    starts = tuple(
        setup.start_episode(parking, 0, seeding.np_random(seed)[0], setup.options) for seed in seeds
    )
    truths = tuple(true_profile(start.surface) for start in starts)
    return PreparedCase(case, scenarios.options(case), setup, tuple(seeds), starts, truths)


def trajectories(prepared: PreparedCase, driven: Rollout) -> Iterator[Trajectory]:
    """The whole motion of every drive, under the commands that were given."""
    setup = prepared.setup
    steps, parking = round(setup.interval / setup.options.step), setup.make_fleet()
    for first in range(0, len(prepared.starts), LANES):
        some = range(first, min(first + LANES, len(prepared.starts)))
        fleet = Fleet([_restarted_drive(prepared, k, parking) for k in some])
        given = np.stack([command_bytes(prepared, driven, k, steps) for k in some])
        signals = fleet.advance(given)
        for lane, k in enumerate(some):
            n = steps * (1 + int(driven.intervals[k]))
            t, start = setup.options.step * np.arange(n), prepared.starts[k].drive
            v = np.full(n, start.speed)
            own = select_vehicle(signals, lane)[:n].copy()
            yield Trajectory(t, start.start + v * t, v, given[lane, :n], own)


def record_of(prepared: PreparedCase, driven: Rollout, k: int) -> Record:
    """What the instruments recorded on drive `k`: the policy's own observations, end to end."""
    setup, rows = prepared.setup, 1 + int(driven.intervals[k])
    context = PolicyContext.from_setup(setup, 1, 0)
    seen = driven.observations[:rows, k]
    a = np.moveaxis(context.accelerations(seen), 0, 1).reshape(3, -1)
    v = np.repeat(context.signal("speed", seen)[:, 0], setup.samples_per_interval).astype(float)
    t = np.arange(v.size) / setup.instruments.fs
    stiff, high = decode_commands(
        command_bytes(prepared, driven, k, setup.samples_per_interval)[: v.size]
    )
    start = prepared.starts[k]
    s = start.drive.start + v * t
    return Record(t, a.astype(float), v, s, stiff, high, start.surface.length)


def command_bytes(prepared: PreparedCase, driven: Rollout, k: int, repeated: int) -> np.ndarray:
    """The command bytes of drive `k`, each interval's `repeated` times."""
    given = np.concatenate(
        [[prepared.starts[k].command_byte], prepared.setup.command_bytes[driven.actions[:, k]]]
    )
    return np.repeat(given.astype(np.uint8), repeated)


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the block after so long. In the main thread only, where alarms ring;
    elsewhere nothing is watched.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ring(number: int, frame: object) -> None:
        raise TimeoutError(f"no end after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _restarted_drive(prepared: PreparedCase, k: int, parking: InstrumentedFleet):
    """The drive number `k` at its beginning, drawn again from its seed: drives go on in place."""
    random = seeding.np_random(prepared.seeds[k])[0]
    drive = prepared.setup.start_episode(parking, 0, random, prepared.setup.options).drive
    drive.manoeuvre = prepared.setup.manoeuvre  # the environment's convoy has its own
    return drive


class _FixedActions:
    """Actions that stand fixed beforehand."""

    def __init__(self, actions: np.ndarray):
        self.actions = actions

    def reset(self, context: PolicyContext) -> None:
        self.at = 0

    def act(self, observations: np.ndarray) -> np.ndarray:
        self.at += 1
        return self.actions[self.at - 1]


def _rollout(policy: Policy | None, prepared: PreparedCase) -> Rollout:
    if policy is None:
        policy = _FixedActions(beam_search.search_actions(prepared.setup, prepared.starts))
    return roll_out(policy, prepared.options, prepared.seeds)


def _evaluate(test, driven, known, seen, estimators) -> tuple[dict[str, np.ndarray], list[str]]:
    """Metrics and errors, each (R,), of one case, and what is to be noted."""
    car, v = test.setup.car, test.case.speed_kmh / 3.6
    first_step = round(test.setup.interval / test.setup.options.step)
    rows, road = [], fit_spectrum(test.truths[0], scored_band(v))
    for k, motion in enumerate(trajectories(test, driven)):
        row = ride_metrics(motion, car, first_step)
        row["turned_over"] = float(driven.reasons[k] != "")
        row["reward"] = driven.returns[k] / (driven.intervals[k] * test.setup.interval)
        row["bound"] = np.nan if road is None else _bound(test, motion.commands, v, road)
        rows.append(row)
    column = {name: np.array([row[name] for row in rows]) for name in METRICS}
    records = [record_of(test, driven, k) for k in range(len(test.starts))]
    lessons = []
    if seen is not None:
        lessons = [(record_of(known, seen, k), known.truths[k]) for k in range(len(known.starts))]
    notes = []
    for name, estimator in estimators.items():
        try:
            found = reconstruct(estimator, lessons, records, car, seed=1).estimates
            column[name] = np.array(
                [_nrmse(y, x, v) for y, x in zip(test.truths, found, strict=True)]
            )
        except EntryError as error:
            notes.append(f"{name}: {test.case.label}: {error}")
            column[name] = np.full(len(records), np.nan)
    return column, notes


def _nrmse(y: Profile, estimate: Profile, v: float) -> float:
    inside = heights.band_pass(np.stack([y.z, estimate.z]), y.ds, scored_band(v))
    return heights.error_over_truth(*inside).pooled


def _bound(test: PreparedCase, given: np.ndarray, v: float, road: tuple[float, float]) -> float:
    """Least NRMSE of a car that keeps each of its states as long as it did, one after the other."""
    names = {flags: mode for mode, flags in MODES.items()}
    left = 0.0
    for (a, b, c, d), share in state_time_shares(given).items():
        pair = {"front": names[a, b], "rear": names[c, d]}
        options = test.setup.options
        left += share * pooled_bound(options.vehicle, options.sensors, pair, v, *road) ** 2
    return float(np.sqrt(left))


def _result(name, columns, estimators, failure, notes, timeline) -> PolicyResult:
    if failure is not None:
        return PolicyResult(name, failure=failure, notes=notes)
    table = {key: np.stack([c[key] for c in columns], axis=1) for key in columns[0]}
    errors = {key: table.pop(key) for key in estimators}
    return PolicyResult(name, table, errors, None, notes, timeline)
