"""The judge at work: what an entry makes of the drives of one condition, as a `Result`.

The drives are simulated once and shared by all entries; only one condition's drives are held at a
time. Training seeds are kept apart, drive by drive. A failure is a result too.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from estimators.api import Estimator
from leaderboard.evaluation.code_version import judge_code
from leaderboard.evaluation.entry import (
    JUDGES_OWN,
    Entry,
    EntryError,
    Outcome,
    reconstruct_all,
    settings_of,
)
from leaderboard.evaluation.provenance import environment, version
from leaderboard.evaluation.results import DriveScores, Result, Trace, heights, together
from leaderboard.evaluation.tasks import Condition, Task
from leaderboard.evaluation.test_data import Drive, DriveSource, read_only, simulated
from leaderboard.metrics import heights as metrics
from leaderboard.metrics.baselines import SENTINELS, truth_plus_noise
from leaderboard.metrics.bound import nrmse_bound
from leaderboard.metrics.registry import scores
from road_envs.data.record import Estimate
from road_envs.simulation.drive import SimulationError

SEEDS = (1, 2, 3)
"""Training seeds of an estimator that learns."""

TRACED = 100.0
"""Length [m] of the first test road that is kept for the figures."""


Report = Callable[[str], None]


class Session(NamedTuple):
    """One condition of a task, and all that was driven under it."""

    task: Task
    condition: Condition
    training: list[Drive]
    tests: list[Drive]

    @property
    def v(self) -> float:
        """Speed [m/s]."""
        return self.condition.speed_kmh / 3.6


Run = Callable[[Entry, Session, Sequence[int]], Iterable[Outcome]]
"""How an entry is run on a session's records: one outcome for each training seed that tells
something new. Raises EntryError; `here` is the plain one.
"""


def run_task(
    task: Task,
    estimators: Mapping[str, Estimator | None],
    seeds: Sequence[int] = SEEDS,
    *,
    drive: DriveSource = simulated,
    report: Report = lambda text: None,
) -> list[Result]:
    """Results of `estimators` on a task, run in this process; None is the judge's noisy truth.

    `report` hears of each of `steps(task, estimators)` steps as it begins. Raises ConfigError where
    the task is bad input.
    """
    entries = [_entry(name, estimator) for name, estimator in estimators.items()]
    parts: dict[str, list[Result]] = {entry.name: [] for entry in entries}
    for condition in task.conditions:
        report(f"{task.name}: driving, {condition.label}")
        session = drive_all(task, condition, drive)
        for entry in entries:
            report(f"{task.name}: {entry.name}, {condition.label}")
            if not any(part.failure for part in parts[entry.name]):
                run = here(estimators[entry.name])
                parts[entry.name].append(judge(task, condition, session, entry, seeds, run))
    return [together(found, "") for found in parts.values()]


def steps(task: Task, estimators: Mapping[str, Estimator | None]) -> int:
    """How often `run_task` reports."""
    return len(task.conditions) * (len(estimators) + 1)


def _entry(name: str, estimator: Estimator | None) -> Entry:
    """An entry that is run here and need not be found again."""
    reference = JUDGES_OWN if estimator is None else type(estimator).__name__
    causal = getattr(estimator, "causal", None)
    return Entry(name=name, reference=reference, settings=settings_of(estimator), causal=causal)


def here(estimator: Estimator | None) -> Run:
    """Run an estimator in this process."""

    def run(entry: Entry, session: Session, seeds: Sequence[int]) -> Iterable[Outcome]:
        assert estimator is not None
        records = [test.record for test in session.tests]
        return reconstruct_all(estimator, pairs(session), records, session.task.vehicle, seeds)

    return run


def pairs(session: Session) -> list[tuple]:
    """Training records with their truths."""
    return [(drive.record, drive.truth) for drive in session.training]


def drive_all(task: Task, condition: Condition, drive: DriveSource = simulated) -> Session | str:
    """The drives of a condition, or in one sentence why there are none. Raises ConfigError."""
    try:
        training = [read_only(d) for d in drive(task, task.training, condition)]
        tests = [read_only(d) for d in drive(task, task.test, condition)]
    except SimulationError as error:
        return f"{condition.label}: the drive itself failed: {error}"
    return Session(task, condition, training, tests)


def judge(
    task: Task,
    condition: Condition,
    session: Session | str,
    entry: Entry,
    seeds: Sequence[int],
    run: Run,
) -> Result:
    """What an entry did under a condition, trained with every seed."""
    nothing = Result(
        task=task.name,
        task_digest=task.digest,
        estimator=entry.name,
        role="sentinel" if entry.name in SENTINELS else "entry",
        settings=entry.settings,
        package_version=version(),
        metric_version=metrics.VERSION,
        seeds=tuple(seeds),
        code=entry.code,
        judge=judge_code(),
        conditions=(condition.label,),
        causal=entry.causal,
        environment=environment(),
    )
    why = entry.failure or (session if isinstance(session, str) else None)
    if why is not None or isinstance(session, str):
        return dataclasses.replace(nothing, failure=why)
    notes = tuple(dict.fromkeys(note for test in session.tests for note in test.notes))
    try:
        found = _judged(session, _outcomes(session, entry, seeds, run))
    except EntryError as error:
        failure = f"{condition.label}, {error}"
        return dataclasses.replace(nothing, failure=failure, notes=notes)
    return dataclasses.replace(nothing, notes=notes, **found)


def _outcomes(session: Session, entry: Entry, seeds: Sequence[int], run: Run) -> Iterable[Outcome]:
    if entry.reference != JUDGES_OWN:
        return run(entry, session, seeds)
    band = metrics.scored_band(session.v)
    noisy = [truth_plus_noise(test.truth, band, test.seed) for test in session.tests]
    return [Outcome(noisy, 0.0, 0.0, 0, seeds[0])]


def _judged(session: Session, outcomes: Iterable[Outcome]) -> dict:
    """Fields of a result: scores of every outcome, the middle trace, and the costs."""
    drives: list[DriveScores] = []
    traces: list[Trace] = []
    train: list[float] = []
    seconds, last = 0.0, Outcome([], 0.0, 0.0, 0)
    for outcome in outcomes:
        judged = [_scored(session, k, z, outcome.seed) for k, z in enumerate(outcome.estimates)]
        traces.append(_trace(session, outcome.estimates[0], judged[0]))
        drives += judged
        train.append(outcome.train_seconds)
        seconds += outcome.estimate_seconds
        last = outcome
    metres = len(train) * sum(test.record.length for test in session.tests)
    return {
        "drives": tuple(drives),
        "traces": (_middle(traces),),
        "train_seconds": tuple(train),
        "estimate_ms_per_100m": 1e5 * seconds / metres if seconds else None,
        "parameters": last.parameters,
        "peak_memory": last.peak_memory,
        "isolation": last.isolation,
    }


def _scored(session: Session, drive: int, estimate: Estimate, seed: int) -> DriveScores:
    test = session.tests[drive]
    bound = nrmse_bound(session.task, session.condition, test.truth)
    found = scores(test.truth, estimate, session.v, session.task.bumps, bound)
    return DriveScores(
        condition=session.condition.label,
        drive=drive,
        road=test.road,
        road_seed=test.seed,
        seed=seed,
        scores={name: value for name, value in found.items() if math.isfinite(value)},
    )


def _trace(session: Session, estimate: Estimate, judged: DriveScores) -> Trace:
    """The first 100 m of the first test drive."""
    truth = session.tests[0].truth
    kept = truth.s < TRACED
    return Trace(
        condition=judged.condition,
        speed_kmh=session.condition.speed_kmh,
        road=judged.road,
        road_seed=judged.road_seed,
        seed=judged.seed,
        scores=judged.scores,
        ds=truth.ds,
        truth=heights(truth.z[:, kept]),
        estimate=heights(estimate.z[:, kept]),
        deviation=None if estimate.z_std is None else heights(estimate.z_std[:, kept]),
    )


def _middle(traces: list[Trace]) -> Trace:
    """The trace of the training in the middle by in-band error: never the best one."""
    ordered = sorted(traces, key=lambda t: t.scores.get("nrmse", math.inf))
    return ordered[(len(ordered) - 1) // 2]
