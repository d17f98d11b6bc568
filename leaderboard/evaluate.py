"""The judge at work on one task: every entry becomes one `Result`, and a failure is a row too.

For every condition the drives are simulated once and shared by all entries; only one condition's
drives are held at a time. Training seeds are kept apart, drive by drive.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from estimators.protocol import Estimator
from leaderboard import metrics
from leaderboard.bounds import nrmse_bound
from leaderboard.drives import Drive, DriveSource, read_only, simulated
from leaderboard.entry import EntryError, Outcome, reconstruct
from leaderboard.environment import environment, version
from leaderboard.results import DriveScores, Result, Trace, heights
from leaderboard.scores import scores
from leaderboard.sentinels import SENTINELS, truth_plus_noise
from leaderboard.tasks import Condition, Task
from road_envs.record import Estimate
from road_envs.simulate import SimulationError

SEEDS = (1, 2, 3)
"""Training seeds of an estimator that learns."""

TRACED = 100.0
"""Length [m] of the first test road that is kept for the figures."""

Entries = Mapping[str, Estimator | None]
"""Who is judged, by name; None stands for the judge's own truth plus noise."""

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


@dataclass
class Row:
    """An entry on its way through a task."""

    name: str
    estimator: Estimator | None
    seeds: tuple[int, ...]  # to run it with
    drives: list[DriveScores] = field(default_factory=list)
    traces: list[Trace] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)
    metres: float = 0.0  # estimated in all
    failure: str | None = None


def run_task(
    task: Task,
    entries: Entries,
    seeds: Sequence[int] = SEEDS,
    *,
    drive: DriveSource = simulated,
    report: Report = lambda text: None,
) -> list[Result]:
    """Results of `entries` on a task.

    An estimator that gives the same answers with the second seed runs with the first alone.
    `report` hears of each of `steps(task, entries)` steps as it begins. Raises ConfigError where
    the task is bad input.
    """
    rows = [Row(name, e, tuple(seeds)) for name, e in entries.items()]
    notes: dict[str, None] = {}
    for condition in task.conditions:
        report(f"{task.name}: driving, {condition.label}")
        session = _session(task, condition, drive)
        for row in rows:
            report(f"{task.name}: {row.name}, {condition.label}")
            if isinstance(session, str):
                row.failure = row.failure or session
            elif row.failure is None:
                _judge(session, row)
        if isinstance(session, Session):
            notes |= dict.fromkeys(note for test in session.tests for note in test.notes)
    return [_result(task, row, tuple(seeds), tuple(notes)) for row in rows]


def steps(task: Task, entries: Entries) -> int:
    """How often `run_task` reports."""
    return len(task.conditions) * (len(entries) + 1)


def settings_of(estimator: Estimator | None) -> dict[str, Any]:
    """What an estimator was constructed with."""
    if estimator is None or not dataclasses.is_dataclass(estimator):
        return {}
    return {f.name: getattr(estimator, f.name) for f in dataclasses.fields(estimator) if f.init}


def _session(task: Task, condition: Condition, drive: DriveSource) -> Session | str:
    """The drives of a condition, or in one sentence why there are none."""
    try:
        training = [read_only(d) for d in drive(task, task.training, condition)]
        tests = [read_only(d) for d in drive(task, task.test, condition)]
    except SimulationError as error:
        return f"{condition.label}: the drive itself failed: {error}"
    return Session(task, condition, training, tests)


def _judge(session: Session, row: Row) -> None:
    """Run an entry under one condition, with every seed, and add what came of it to `row`."""
    traces: list[Trace] = []
    first: list[Estimate] = []
    for seed in row.seeds:
        try:
            outcome = _outcome(session, row, seed)
        except EntryError as error:
            row.failure = f"{session.condition.label}, {error}"
            return
        if not row.traces and _same(outcome.estimates, first):
            row.seeds = row.seeds[:1]  # it draws nothing: one training stands for all
            break
        first = first or outcome.estimates
        judged = [_scored(session, k, z, seed) for k, z in enumerate(outcome.estimates)]
        traces.append(_trace(session, outcome.estimates[0], judged[0]))
        row.drives += judged
        row.outcomes.append(dataclasses.replace(outcome, estimates=[]))
        row.metres += sum(test.record.length for test in session.tests)
    row.traces.append(_middle(traces))


def _same(some: Sequence[Estimate], others: Sequence[Estimate]) -> bool:
    return len(some) == len(others) and all(
        np.array_equal(a.z, b.z) for a, b in zip(some, others, strict=True)
    )


def _outcome(session: Session, row: Row, seed: int) -> Outcome:
    if row.estimator is None:
        band = metrics.scored_band(session.v)
        noisy = [truth_plus_noise(test.truth, band, test.seed) for test in session.tests]
        return Outcome(noisy, 0.0, 0.0, 0)
    training = [(drive.record, drive.truth) for drive in session.training]
    records = [test.record for test in session.tests]
    return reconstruct(row.estimator, training, records, session.task.vehicle, seed)


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
        scores={name: value if math.isfinite(value) else None for name, value in found.items()},
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
    )


def _middle(traces: list[Trace]) -> Trace:
    """The trace of the training in the middle by in-band error: never the best one."""
    ordered = sorted(traces, key=lambda t: _or_infinite(t.scores["nrmse"]))
    return ordered[(len(ordered) - 1) // 2]


def _or_infinite(value: float | None) -> float:
    return math.inf if value is None else value


def _result(task: Task, row: Row, seeds: tuple[int, ...], notes: tuple[str, ...]) -> Result:
    seconds = sum(outcome.estimate_seconds for outcome in row.outcomes)
    failed = row.failure is not None
    return Result(
        task=task.name,
        task_digest=task.digest,
        estimator=row.name,
        role="sentinel" if row.name in SENTINELS else "entry",
        settings=settings_of(row.estimator),
        package_version=version(),
        metric_version=metrics.VERSION,
        seeds=seeds,
        drives=() if failed else tuple(row.drives),
        train_seconds=() if failed else tuple(o.train_seconds for o in row.outcomes),
        estimate_ms_per_100m=1e5 * seconds / row.metres if row.metres and seconds else None,
        parameters=max((outcome.parameters for outcome in row.outcomes), default=None),
        causal=getattr(row.estimator, "causal", None),
        failure=row.failure,
        notes=notes,
        traces=() if failed else tuple(row.traces),
        environment=environment(),
    )
