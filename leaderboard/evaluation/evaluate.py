"""Evaluation of entries on the drives of a condition, with a `Result` for each entry.

The drives are simulated once and shared by all entries; only one condition's drives are in memory
at a time. Scores of each training seed are stored separately. A failure is a result too.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from estimators.api import Estimator
from estimators.common.blas import single_blas_thread
from leaderboard.entries.entry import (
    BUILTIN,
    Calibrations,
    Entry,
    EntryError,
    LocalSession,
    TrainingRun,
    get_settings,
    reconstruct_all,
)
from leaderboard.evaluation.bound import nrmse_bound
from leaderboard.evaluation.provenance import describe_environment
from leaderboard.evaluation.results import (
    Result,
    Trace,
    make_table,
    merge_parts,
    unscored_result,
)
from leaderboard.evaluation.tasks import Condition, Task
from leaderboard.evaluation.test_data import (
    DriveSimulation,
    RecordedDrive,
    lock_arrays,
    simulate_drives,
)
from leaderboard.metrics import heights
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.baselines import MEMORY, memory, truth_plus_noise
from leaderboard.metrics.registry import compute_scores
from road_envs.records.record import Estimate, Profile, Record
from road_envs.simulation.drive import SimulationError
from road_envs.vehicle.parameters import VehicleParameters

SEEDS = (1, 2, 3)  # default seeds of trainings
_TRACE_LENGTH = 100.0  # length [m] of the part of the first test road that is stored for plots


class ConditionData(NamedTuple):
    """One condition of a task with its training and test drives."""

    task: Task
    condition: Condition
    training: list[RecordedDrive]
    tests: list[RecordedDrive]

    @property
    def v(self) -> float:
        """Speed [m/s]."""
        return self.condition.speed_kmh / 3.6

    @property
    def inputs(self) -> tuple[list[Any], list[Record], VehicleParameters, Calibrations]:
        """Inputs of an entry: training records with their truths, test records, the vehicle,
        and the calibration drives of the vehicle of each test record, if the task has any.
        """
        training = [(drive.record, drive.truth) for drive in self.training]
        drives = [drive.calibration for drive in self.tests] if self.task.calibration else ()
        car = self.task.vehicle_of(self.condition)
        return training, [drive.record for drive in self.tests], car, drives


EntryRunner = Callable[[Entry, ConditionData, Sequence[int]], Iterable[TrainingRun]]
"""Function that trains and runs an entry: one run per training seed, see `reconstruct_all`."""


def run_task(
    task: Task,
    estimators: Mapping[str, Estimator | None],
    seeds: Sequence[int] = SEEDS,
    *,
    simulate: DriveSimulation = simulate_drives,
    report: Callable[[str], None] = lambda text: None,
) -> list[Result]:
    """Evaluate `estimators` on a task in this process; None is a baseline made from the truth.

    `report` is called with each step as it begins. Raises ConfigError for an invalid task.
    """
    entries = [  # for this process only: their references cannot be resolved elsewhere
        Entry(
            name=name,
            reference=BUILTIN if estimator is None else "in this process",
            settings=get_settings(estimator),
            causal=None if estimator is None else estimator.causal,
        )
        for name, estimator in estimators.items()
    ]
    parts: dict[str, list[Result]] = {entry.name: [] for entry in entries}
    for condition in task.conditions:
        report(f"{task.name}: simulating, {condition.label}")
        data = simulate_condition(task, condition, simulate)
        for entry in entries:
            report(f"{task.name}: {entry.name}, {condition.label}")
            if not any(part.failure for part in parts[entry.name]):
                run = in_process(estimators[entry.name])
                parts[entry.name].append(evaluate_entry(task, condition, data, entry, seeds, run))
    return [merge_parts(results, "") for results in parts.values()]


def in_process(estimator: Estimator | None) -> EntryRunner:
    """Return a runner of an estimator in this process."""

    def run(entry: Entry, data: ConditionData, seeds: Sequence[int]) -> Iterable[TrainingRun]:
        assert estimator is not None
        training, records, car, drives = data.inputs
        return reconstruct_all(LocalSession(estimator, car), training, records, seeds, None, drives)

    return run


@single_blas_thread()  # as in the processes of a board: digits depend on their number
def simulate_condition(
    task: Task, condition: Condition, simulate: DriveSimulation = simulate_drives
) -> ConditionData | str:
    """Simulate the drives of a condition, or return why that failed. Raises ConfigError."""
    try:
        training = [lock_arrays(drive) for drive in simulate(task, task.training, condition)]
        tests = [lock_arrays(drive) for drive in simulate(task, task.test, condition)]
    except (SimulationError, ArithmeticError) as error:  # the latter of a plant
        return f"{condition.label}: the simulation of a drive failed: {error}"
    return ConditionData(task, condition, training, tests)


@single_blas_thread()
def evaluate_entry(
    task: Task,
    condition: Condition,
    data: ConditionData | str,
    entry: Entry,
    seeds: Sequence[int],
    run: EntryRunner,
) -> Result:
    """Run an entry under a condition with every training seed and score its estimates."""
    empty = unscored_result(
        task, entry.name, settings=entry.settings, seeds=tuple(seeds), code=entry.code,
        conditions=(condition.label,), causal=entry.causal, lag=entry.lag,
        environment=describe_environment() | ({"imports": entry.imported} if entry.imports else {}),
    )  # fmt: skip
    failure = entry.failure or (data if isinstance(data, str) else None)
    if failure is not None or isinstance(data, str):
        return dataclasses.replace(empty, failure=failure)
    notes = tuple(dict.fromkeys(note for test in data.tests for note in test.notes))
    try:
        fields = _score_fields(data, entry, _training_runs(data, entry, seeds, run))
    except EntryError as error:
        return dataclasses.replace(empty, failure=f"{condition.label}, {error}", notes=notes)
    return dataclasses.replace(empty, **{**fields, "notes": (*notes, *fields["notes"])})


def _training_runs(
    data: ConditionData, entry: Entry, seeds: Sequence[int], run: EntryRunner
) -> Iterable[TrainingRun]:
    if entry.reference != BUILTIN:
        return run(entry, data, seeds)
    if entry.name == MEMORY:
        truths, delays = [d.truth for d in data.training], data.task.training_delays
        estimates = [memory(truths, delays, test.truth.s) for test in data.tests]
    else:
        band = heights.scored_band(data.v)
        estimates = [truth_plus_noise(test.truth, band, test.seed) for test in data.tests]
    return [TrainingRun(estimates, 0.0, 0.0, 0, seeds[0])]


def _score_fields(
    data: ConditionData, entry: Entry, training_runs: Iterable[TrainingRun]
) -> dict[str, Any]:
    """Return fields of a result: scores of all runs, the trace of the median run, and costs."""
    rows: list[tuple[Any, ...]] = []
    traces: list[Trace] = []
    train: list[float] = []
    seconds, last = 0.0, TrainingRun([], 0.0, 0.0, 0)
    for training_run in training_runs:
        pairs = zip(data.tests, training_run.estimates, strict=True)
        scores = [_score_drive(data, test.truth, estimate) for test, estimate in pairs]
        traces.append(_trace(data, training_run.estimates[0], scores[0], training_run.seed))
        for test, own in zip(data.tests, scores, strict=True):
            run = (data.condition.label, test.index, test.road, test.seed, training_run.seed)
            rows += [(*run, name, value) for name, value in own.items()]
        train.append(training_run.train_seconds)
        seconds += training_run.estimate_seconds
        last = training_run
    traces.sort(key=lambda trace: trace.scores.get("nrmse", math.inf))
    calibrated = last.calibrate_seconds
    metres = len(train) * sum(test.record.length for test in data.tests)
    return {
        "scores": make_table(rows),
        "traces": (traces[(len(traces) - 1) // 2],),  # of the median error, the lower of two
        "train_seconds": tuple(train),
        "calibrates": calibrated is not None if data.task.calibration else None,
        "calibrate_seconds": None if calibrated is None else calibrated / len(data.tests),
        "estimate_ms_per_100m": 1e5 * seconds / metres if seconds else None,
        "parameters": last.parameters,
        "peak_memory": last.peak_memory,
        "isolation": last.isolation,
        "causal": entry.causal and not last.looks_ahead,
        "notes": tuple(f"{entry.name}: {note}" for note in last.notes),
    }


def _score_drive(data: ConditionData, truth: Profile, estimate: Estimate) -> dict[str, float]:
    """Return the defined scores of an estimate of a test drive."""
    bound = nrmse_bound(data.task, data.condition, truth) if data.task.bound else math.nan
    kinds = {"bumps": data.task.bumps, "wandering": data.task.position_noise}
    values = compute_scores(ScoredEstimate(truth, estimate, data.v, bound=bound, **kinds))
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _trace(data: ConditionData, estimate: Estimate, scores: dict[str, float], seed: int) -> Trace:
    """Return the first _TRACE_LENGTH metres of the first test drive."""
    test, truth = data.tests[0], data.tests[0].truth
    kept = truth.s < _TRACE_LENGTH
    return Trace(
        condition=data.condition.label, speed_kmh=data.condition.speed_kmh, road=test.road,
        road_seed=test.seed, seed=seed, scores=scores, ds=truth.ds,
        truth=Trace.quantized(truth.z[:, kept]), estimate=Trace.quantized(estimate.z[:, kept]),
        deviation=None if estimate.z_std is None else Trace.quantized(estimate.z_std[:, kept]),
    )  # fmt: skip
