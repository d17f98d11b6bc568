"""The judge at work: what an entry makes of the drives of one condition, as a `Result`.

The drives are simulated once and shared by all entries; only one condition's drives are held at a
time. Training seeds are kept apart, drive by drive. A failure is a result too.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from estimators.api import Estimator
from leaderboard.evaluation.code_version import evaluation_version
from leaderboard.evaluation.entry import (
    BUILTIN,
    Entry,
    EntryError,
    TrainingRun,
    get_settings,
    reconstruct_all,
)
from leaderboard.evaluation.provenance import describe_environment, package_version
from leaderboard.evaluation.results import DriveScores, Result, Trace, merge_parts, quantize_heights
from leaderboard.evaluation.tasks import Condition, Task
from leaderboard.evaluation.test_data import (
    DriveSimulation,
    RecordedDrive,
    lock_arrays,
    simulate_drives,
)
from leaderboard.metrics import heights
from leaderboard.metrics.baselines import BASELINES, truth_plus_noise
from leaderboard.metrics.bound import nrmse_bound
from leaderboard.metrics.registry import compute_scores
from road_envs.data.record import Estimate
from road_envs.simulation.drive import SimulationError

SEEDS = (1, 2, 3)
"""Training seeds of an estimator that learns."""

TRACE_LENGTH = 100.0
"""Length [m] of the first test road that is kept for the figures."""


StatusCallback = Callable[[str], None]


class ConditionData(NamedTuple):
    """One condition of a task, and all that was driven under it."""

    task: Task
    condition: Condition
    training: list[RecordedDrive]
    tests: list[RecordedDrive]

    @property
    def v(self) -> float:
        """Speed [m/s]."""
        return self.condition.speed_kmh / 3.6


EntryRunner = Callable[[Entry, ConditionData, Sequence[int]], Iterable[TrainingRun]]
"""How an entry is run on a session's records: one outcome for each training seed that tells
something new. Raises EntryError; `in_process` is the plain one.
"""


def run_task(
    task: Task,
    estimators: Mapping[str, Estimator | None],
    seeds: Sequence[int] = SEEDS,
    *,
    drive: DriveSimulation = simulate_drives,
    report: StatusCallback = lambda text: None,
) -> list[Result]:
    """Results of `estimators` on a task, run in this process; None is the judge's noisy truth.

    `report` hears of each of `steps(task, estimators)` steps as it begins. Raises ConfigError where
    the task is bad input.
    """
    entries = [_local_entry(name, estimator) for name, estimator in estimators.items()]
    parts: dict[str, list[Result]] = {entry.name: [] for entry in entries}
    for condition in task.conditions:
        report(f"{task.name}: driving, {condition.label}")
        condition_data = simulate_condition(task, condition, drive)
        for entry in entries:
            report(f"{task.name}: {entry.name}, {condition.label}")
            if not any(part.failure for part in parts[entry.name]):
                run = in_process(estimators[entry.name])
                parts[entry.name].append(
                    evaluate_entry(task, condition, condition_data, entry, seeds, run)
                )
    return [merge_parts(found, "") for found in parts.values()]


def steps(task: Task, estimators: Mapping[str, Estimator | None]) -> int:
    """How often `run_task` reports."""
    return len(task.conditions) * (len(estimators) + 1)


def _local_entry(name: str, estimator: Estimator | None) -> Entry:
    """An entry that is run here and need not be found again."""
    reference = BUILTIN if estimator is None else type(estimator).__name__
    causal = getattr(estimator, "causal", None)
    return Entry(name=name, reference=reference, settings=get_settings(estimator), causal=causal)


def in_process(estimator: Estimator | None) -> EntryRunner:
    """Run an estimator in this process."""

    def run(
        entry: Entry, condition_data: ConditionData, seeds: Sequence[int]
    ) -> Iterable[TrainingRun]:
        assert estimator is not None
        records = [test.record for test in condition_data.tests]
        return reconstruct_all(
            estimator, training_pairs(condition_data), records, condition_data.task.vehicle, seeds
        )

    return run


def training_pairs(condition_data: ConditionData) -> list[tuple]:
    """Training records with their truths."""
    return [(drive.record, drive.truth) for drive in condition_data.training]


def simulate_condition(
    task: Task, condition: Condition, drive: DriveSimulation = simulate_drives
) -> ConditionData | str:
    """The drives of a condition, or in one sentence why there are none. Raises ConfigError."""
    try:
        training = [lock_arrays(d) for d in drive(task, task.training, condition)]
        tests = [lock_arrays(d) for d in drive(task, task.test, condition)]
    except SimulationError as error:
        return f"{condition.label}: the drive itself failed: {error}"
    return ConditionData(task, condition, training, tests)


def evaluate_entry(
    task: Task,
    condition: Condition,
    condition_data: ConditionData | str,
    entry: Entry,
    seeds: Sequence[int],
    run: EntryRunner,
) -> Result:
    """What an entry did under a condition, trained with every seed."""
    nothing = Result(
        task=task.name,
        task_digest=task.digest,
        estimator=entry.name,
        role="sentinel" if entry.name in BASELINES else "entry",
        settings=entry.settings,
        package_version=package_version(),
        metric_version=heights.VERSION,
        seeds=tuple(seeds),
        code=entry.code,
        judge=evaluation_version(),
        conditions=(condition.label,),
        causal=entry.causal,
        environment=describe_environment(),
    )
    why = entry.failure or (condition_data if isinstance(condition_data, str) else None)
    if why is not None or isinstance(condition_data, str):
        return dataclasses.replace(nothing, failure=why)
    notes = tuple(dict.fromkeys(note for test in condition_data.tests for note in test.notes))
    try:
        found = _score_fields(condition_data, _training_runs(condition_data, entry, seeds, run))
    except EntryError as error:
        failure = f"{condition.label}, {error}"
        return dataclasses.replace(nothing, failure=failure, notes=notes)
    return dataclasses.replace(nothing, notes=notes, **found)


def _training_runs(
    condition_data: ConditionData, entry: Entry, seeds: Sequence[int], run: EntryRunner
) -> Iterable[TrainingRun]:
    if entry.reference != BUILTIN:
        return run(entry, condition_data, seeds)
    band = heights.scored_band(condition_data.v)
    noisy = [truth_plus_noise(test.truth, band, test.seed) for test in condition_data.tests]
    return [TrainingRun(noisy, 0.0, 0.0, 0, seeds[0])]


def _score_fields(condition_data: ConditionData, training_runs: Iterable[TrainingRun]) -> dict:
    """Fields of a result: scores of every outcome, the middle trace, and the costs."""
    drives: list[DriveScores] = []
    traces: list[Trace] = []
    train: list[float] = []
    seconds, last = 0.0, TrainingRun([], 0.0, 0.0, 0)
    for training_run in training_runs:
        judged = [
            _score_drive(condition_data, k, z, training_run.seed)
            for k, z in enumerate(training_run.estimates)
        ]
        traces.append(_trace(condition_data, training_run.estimates[0], judged[0]))
        drives += judged
        train.append(training_run.train_seconds)
        seconds += training_run.estimate_seconds
        last = training_run
    metres = len(train) * sum(test.record.length for test in condition_data.tests)
    return {
        "drives": tuple(drives),
        "traces": (_median_trace(traces),),
        "train_seconds": tuple(train),
        "estimate_ms_per_100m": 1e5 * seconds / metres if seconds else None,
        "parameters": last.parameters,
        "peak_memory": last.peak_memory,
        "isolation": last.isolation,
    }


def _score_drive(
    condition_data: ConditionData, drive: int, estimate: Estimate, seed: int
) -> DriveScores:
    test = condition_data.tests[drive]
    bound = nrmse_bound(condition_data.task, condition_data.condition, test.truth)
    found = compute_scores(test.truth, estimate, condition_data.v, condition_data.task.bumps, bound)
    return DriveScores(
        condition=condition_data.condition.label,
        drive=drive,
        road=test.road,
        road_seed=test.seed,
        seed=seed,
        scores={name: value for name, value in found.items() if math.isfinite(value)},
    )


def _trace(condition_data: ConditionData, estimate: Estimate, judged: DriveScores) -> Trace:
    """The first 100 m of the first test drive."""
    truth = condition_data.tests[0].truth
    kept = truth.s < TRACE_LENGTH
    return Trace(
        condition=judged.condition,
        speed_kmh=condition_data.condition.speed_kmh,
        road=judged.road,
        road_seed=judged.road_seed,
        seed=judged.seed,
        scores=judged.scores,
        ds=truth.ds,
        truth=quantize_heights(truth.z[:, kept]),
        estimate=quantize_heights(estimate.z[:, kept]),
        deviation=None if estimate.z_std is None else quantize_heights(estimate.z_std[:, kept]),
    )


def _median_trace(traces: list[Trace]) -> Trace:
    """The trace of the training in the middle by in-band error: never the best one."""
    ordered = sorted(traces, key=lambda t: t.scores.get("nrmse", math.inf))
    return ordered[(len(ordered) - 1) // 2]
