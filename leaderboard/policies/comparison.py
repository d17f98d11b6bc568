"""Comparison of switching policies: ride comfort, handling and road reconstruction.

All policies drive the same roads and receive no truth. Each drive is simulated a second time with
the same commands, to record the whole motion for the ride metrics. The policy's own observations
form the record given to the estimators. An estimator that needs training and has no pretrained
weights is trained on records of the same policy's drives over the training roads.
"""

import random
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from gymnasium.utils import seeding

from estimators.api import Estimator
from leaderboard.entries.entry import EntryError, needs_training, reconstruct
from leaderboard.evaluation.bound import fit_spectrum, pooled_bound
from leaderboard.metrics import heights
from leaderboard.policies.policy_process import PolicyProcess
from leaderboard.policies.ride_metrics import METRICS, ride_metrics, state_time_shares
from leaderboard.policies.scenarios import Case, Scenarios
from leaderboard.policies.timeline import Timeline
from road_envs.drives.recording import true_profile
from road_envs.envs.instrumented_fleet import InstrumentedFleet
from road_envs.envs.options import EnvSetup, EpisodeStart
from road_envs.kernels.simd import LANES
from road_envs.policies.api import Policy, PolicyContext, PolicyError
from road_envs.policies.rollout import Rollout, roll_out
from road_envs.records.record import Profile, Record, scored_band
from road_envs.simulation.drive import Trajectory
from road_envs.simulation.fleet import Fleet, select_vehicle
from road_envs.vehicle.suspension import MODES, decode_commands

REMEMBERS = "its actions depend on the drives that it has seen before"

TIME_LIMIT = 120.0
"""Seconds that a policy may take for the drives of one case."""

Progress = Callable[[str, float], None]
"""Callback with a description of the current work and the share of the work done."""


@dataclass(frozen=True)
class PolicyResult:
    """Metrics of a policy, each (R, C) (roads, cases), and in-band NRMSE (R, C) [-] by estimator.

    `failure` explains missing metrics, `notes` missing errors. `timeline` is the first drive of the
    case `Scenarios.shown`.
    """

    policy: str
    metrics: Mapping[str, np.ndarray] = field(default_factory=dict)
    errors: Mapping[str, np.ndarray] = field(default_factory=dict)
    failure: str | None = None
    notes: tuple[str, ...] = ()
    timeline: Timeline | None = None


class PreparedCase(NamedTuple):
    """A case with its environment, and for each road seed the start of the drive and the truth."""

    case: Case
    options: dict[str, Any]
    setup: EnvSetup
    seeds: tuple[int, ...]
    starts: tuple[EpisodeStart, ...]
    truths: tuple[Profile, ...]


def compare(
    scenarios: Scenarios,
    policies: Mapping[str, Policy],
    estimators: Mapping[str, Estimator],
    *,
    roads: int | None = None,
    seconds: float = TIME_LIMIT,
    finished: Mapping[str, PolicyResult] = MappingProxyType({}),
    on_result: Callable[[PolicyResult], None] = lambda result: None,
    progress: Progress = lambda text, share: None,
) -> list[PolicyResult]:
    """Simulate every policy on every case; a policy that fails is a row with its failure.

    `roads` limits the number of test roads per case,
    `seconds` the time of a policy for a case. `finished` rows are taken as they are; `on_result` is
    called with each new one. Raises ConfigError on invalid scenarios.
    """
    tests = [
        prepare_case(scenarios, c, scenarios.test_seeds(roads)) for c in range(len(scenarios.cases))
    ]
    training_seeds = (
        scenarios.training.seeds if any(map(needs_training, estimators.values())) else range(0)
    )
    training = [prepare_case(scenarios, c, training_seeds) for c in range(len(scenarios.cases))]
    results = []
    for i, (name, policy) in enumerate(policies.items()):
        if name in finished:
            results.append(finished[name])
            continue
        columns: list[dict[str, np.ndarray]] = []
        notes: dict[str, None] = {}
        driven: list[tuple[np.ndarray, np.ndarray]] = []
        failure, timeline = None, None
        for c, (test, train) in enumerate(zip(tests, training, strict=True)):
            progress(f"{name}: {test.case.label}", (i + c / len(tests)) / len(policies))
            try:
                with time_limit(seconds):
                    rollout = roll_out(policy, test.options, test.seeds)
                    train_rollout = (
                        roll_out(policy, train.options, train.seeds) if train.seeds else None
                    )
                column, case_notes = _evaluate(test, rollout, train, train_rollout, estimators)
                if c == scenarios.shown:
                    timeline = Timeline.from_trajectory(
                        next(trajectories(test, rollout)), test.starts[0].surface
                    )
            except Exception as error:  # a failing policy must not stop the comparison
                message = " ".join(str(error).split()) or "no message"
                failure = f"{test.case.label}: {type(error).__name__}: {message}"
                break
            columns.append(column)
            notes |= dict.fromkeys(case_notes)
            driven.append((rollout.actions, rollout.intervals))
        if (
            isinstance(policy, PolicyProcess)
            and failure is None
            and _remembers(policy, tests, driven)
        ):
            notes[f"{name}: {REMEMBERS}"] = None
        results.append(_result(name, columns, tuple(estimators), failure, tuple(notes), timeline))
        on_result(results[-1])
    progress("done", 1.0)
    return results


def _remembers(
    policy: PolicyProcess,
    tests: Sequence[PreparedCase],
    driven: Sequence[tuple[np.ndarray, np.ndarray]],
) -> bool:
    """Return whether a policy in a new process drives a case, drawn in secret, in another way."""
    if len(tests) < 2:
        return False
    case = random.SystemRandom().randrange(1, len(tests))  # the first has none before it
    policy.close()
    try:
        again = roll_out(policy, tests[case].options, tests[case].seeds)
        actions, intervals = driven[case]
    except PolicyError:
        return True
    return any(
        not np.array_equal(again.actions[:n, k], actions[:n, k]) for k, n in enumerate(intervals)
    )


def prepare_case(scenarios: Scenarios, c: int, seeds: Sequence[int]) -> PreparedCase:
    """Build case number `c` on the roads of `seeds`, started as the environment starts it."""
    case, setup = scenarios.cases[c], scenarios.setups[c]
    spare_fleet = setup.make_fleet()
    starts = tuple(
        setup.start_episode(spare_fleet, 0, seeding.np_random(seed)[0], setup.options)
        for seed in seeds
    )
    truths = tuple(true_profile(start.surface) for start in starts)
    return PreparedCase(case, scenarios.options(case), setup, tuple(seeds), starts, truths)


def trajectories(prepared: PreparedCase, rollout: Rollout) -> Iterator[Trajectory]:
    """Yield the full trajectory of every drive, simulated again with the same commands."""
    setup = prepared.setup
    steps, spare_fleet = round(setup.interval / setup.options.step), setup.make_fleet()
    for first in range(0, len(prepared.starts), LANES):
        batch = range(first, min(first + LANES, len(prepared.starts)))
        fleet = Fleet([_restarted_drive(prepared, k, spare_fleet) for k in batch])
        commands = np.stack([command_bytes(prepared, rollout, k, steps) for k in batch])
        signals = fleet.advance(commands)
        for lane, k in enumerate(batch):
            n = steps * (1 + int(rollout.intervals[k]))
            t, start = setup.options.step * np.arange(n), prepared.starts[k].drive
            v = np.full(n, start.speed)
            own = select_vehicle(signals, lane)[:n].copy()
            yield Trajectory(t, start.start + v * t, v, commands[lane, :n], own)


def record_of(prepared: PreparedCase, rollout: Rollout, k: int) -> Record:
    """Return the record of drive `k`, made of the policy's own observations."""
    setup, rows = prepared.setup, 1 + int(rollout.intervals[k])
    context = PolicyContext.from_setup(setup, 1, 0)
    observations = rollout.observations[:rows, k]
    a = np.moveaxis(context.accelerations(observations), 0, 1).reshape(
        len(context.accelerometers), -1
    )
    # an observation has one speed for all samples of its interval
    v = np.repeat(context.signal("speed", observations)[:, 0], setup.samples_per_interval).astype(
        float
    )
    t = np.arange(v.size) / setup.instruments.fs
    stiff, high = decode_commands(
        command_bytes(prepared, rollout, k, setup.samples_per_interval)[: v.size]
    )
    start = prepared.starts[k]
    s = start.drive.start + v * t
    sensors = setup.instruments.layout
    return Record(t, a.astype(float), v, s, stiff, high, start.surface.length, sensors)


def command_bytes(prepared: PreparedCase, rollout: Rollout, k: int, repeated: int) -> np.ndarray:
    """Return the command bytes of drive `k`, each repeated `repeated` times per interval."""
    commands = np.concatenate(
        [[prepared.starts[k].command_byte], prepared.setup.command_bytes[rollout.actions[:, k]]]
    )
    return np.repeat(commands.astype(np.uint8), repeated)


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError if the block takes longer than `seconds`.

    Works in the main thread only, since alarm signals are delivered there; elsewhere there is no
    limit.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: object) -> None:
        raise TimeoutError(f"not finished after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _restarted_drive(prepared: PreparedCase, k: int, spare_fleet: InstrumentedFleet):
    """Return drive `k` at its start, made again from its seed (simulation changes it in place)."""
    random = seeding.np_random(prepared.seeds[k])[0]
    drive = prepared.setup.start_episode(spare_fleet, 0, random, prepared.setup.options).drive
    drive.manoeuvre = prepared.setup.manoeuvre  # `start_episode` gives it to the fleet instead
    return drive


def _evaluate(
    test, rollout, train, train_rollout, estimators
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the metrics and errors of one case, each (R,), and notes on failed estimators."""
    car, v = test.setup.car, test.case.speed_kmh / 3.6
    # the first interval keeps the initial command: the policy has not acted yet
    first_step = round(test.setup.interval / test.setup.options.step)
    rows, road = [], fit_spectrum(test.truths[0], scored_band(v))
    for k, motion in enumerate(trajectories(test, rollout)):
        row = ride_metrics(motion, car, first_step)
        row["turned_over"] = float(rollout.reasons[k] != "")
        row["return"] = rollout.returns[k] / (rollout.intervals[k] * test.setup.interval)
        row["bound"] = np.nan if road is None else _bound(test, motion.commands, v, road)
        rows.append(row)
    column = {name: np.array([row[name] for row in rows]) for name in METRICS}
    records = [record_of(test, rollout, k) for k in range(len(test.starts))]
    training_pairs = []
    if train_rollout is not None:
        training_pairs = [
            (record_of(train, train_rollout, k), truth) for k, truth in enumerate(train.truths)
        ]
    notes = []
    for name, estimator in estimators.items():
        try:
            estimates = reconstruct(estimator, training_pairs, records, car, seed=1).estimates
            column[name] = np.array(
                [
                    heights.nrmse(y.z, x.z, y.ds, scored_band(v)).pooled
                    for y, x in zip(test.truths, estimates, strict=True)
                ]
            )
        except EntryError as error:
            notes.append(f"{name}: {test.case.label}: {error}")
            column[name] = np.full(len(records), np.nan)
    return column, notes


def _bound(test: PreparedCase, commands: np.ndarray, v: float, road: tuple[float, float]) -> float:
    """Return the least NRMSE [-]: root of the time-weighted mean of the squared bounds by state."""
    names = {flags: mode for mode, flags in MODES.items()}
    mean_square = 0.0
    for (a, b, c, d), share in state_time_shares(commands).items():
        pair = {"front": names[a, b], "rear": names[c, d]}
        options = test.setup.options
        mean_square += share * pooled_bound(options.vehicle, options.sensors, pair, v, *road) ** 2
    return float(np.sqrt(mean_square))


def _result(name, columns, estimators, failure, notes, timeline) -> PolicyResult:
    if failure is not None:
        return PolicyResult(name, failure=failure, notes=notes)
    table = {key: np.stack([c[key] for c in columns], axis=1) for key in columns[0]}
    errors = {key: table.pop(key) for key in estimators}
    return PolicyResult(name, table, errors, None, notes, timeline)
