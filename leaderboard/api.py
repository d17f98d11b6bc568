"""The leaderboard from Python: score an estimate, plot it, run a task, also as plain arrays.

    record, truth = simulate_record("iso_d", speed_kmh=36, mode="handling", seed=1)
    result = estimate("wiener", record)
    print(score(result, truth))
    plot(result, truth).savefig("estimate.png")
    table = run_task("new_road", ["wiener", "my_package:Mine"], roads=1)

`simulate_record` is in `road_envs`, `estimate` in `estimators`. For methods in MATLAB, Julia or JAX
that know nothing of the classes of this package, every drive is a dictionary of NumPy arrays; the
truth of test drives is kept back and used by `score_arrays`:

    task = load_task("new_road")
    heights = [my_method(drive, task.training) for drive in task.test]
    print(score_arrays(task, heights))
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import estimators
from estimators.api import Estimator
from leaderboard.entries.entries import entry_refit_per_case
from leaderboard.entries.entry import Entry, TrainingRun
from leaderboard.evaluation import evaluate, results, tasks
from leaderboard.evaluation.evaluate import ConditionData
from leaderboard.evaluation.tasks import Task
from leaderboard.evaluation.test_data import DriveSimulation, RecordedDrive, simulate_drives
from leaderboard.metrics.bootstrap import interquartile_mean
from leaderboard.metrics.registry import SCORES
from leaderboard.scoring import ScoreTable, band_speed, check_stations, score
from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import
from road_envs.records.record import Estimate, Profile, Record, profile_stations

__all__ = ["ScoreTable", "load_task", "plot", "run_task", "score", "score_arrays"]


def plot(
    estimate: Estimate, truth: Profile | None = None, *, speed_kmh: float | None = None
) -> Any:
    """Return a matplotlib figure of both wheel paths, raw and in the scored band, over the truth.

    Raises ConfigError, TypeError, and MissingExtraError without matplotlib.
    """
    from leaderboard.report.plots import estimate_figure

    if truth is not None:
        check_stations(estimate, truth)
    return estimate_figure(truth, estimate, band_speed(estimate, speed_kmh))


def run_task(
    task: str | Path | Task,
    entries: Sequence[str] | Mapping[str, str | Estimator],
    *,
    roads: int | None = None,
    seeds: Sequence[int] = (1,),
    report: Callable[[str], None] = lambda text: None,
) -> Any:
    """Evaluate estimators on a task in this process; return a DataFrame, a row per estimated drive.

    `entries` are registered names, files of `train` or "module:Class", or a mapping from the names
    of the rows to these or to estimators; registered names are trained as on a board. `roads` is
    the number of test drives per condition, `seeds` are those of trainings. `report` is called with
    each step as it begins. An estimator that fails has one row with the reason under `failure`.
    Columns are keys of SCORES, which has their units; their labels are in `table.attrs["labels"]`.
    For estimators of other people use `road-recon leaderboard`, which runs each in a process of its
    own. Raises ConfigError, and MissingExtraError without pandas.
    """
    with optional_import("a DataFrame"):
        import pandas

    chosen = _sized(task, roads)
    named = entries if isinstance(entries, Mapping) else {name: name for name in entries}
    made = {
        name: _make(entry, chosen.trains_on_test_road) if isinstance(entry, str) else entry
        for name, entry in named.items()
    }
    found = evaluate.run_task(chosen, made, seeds, report=report)
    failed = [(result.estimator, result.failure) for result in found if result.failure]
    failures = pandas.DataFrame(failed, columns=["estimator", "failure"])
    scores, runs = results.scores_table(found), ["estimator", *results.RUN]
    wide = scores.pivot(index=runs, columns="score", values="value")
    in_order = pandas.MultiIndex.from_frame(scores[runs].drop_duplicates())
    drives = wide.reindex(index=in_order, columns=list(SCORES)).reset_index()
    table = pandas.concat([drives, failures], ignore_index=True)
    table.attrs["labels"] = {key: form.label for key, form in SCORES.items()}
    return table


@dataclass(frozen=True, eq=False)
class TaskArrays:
    """The drives of a task. Each is a dictionary with

    `condition` (str), times `t` (N,) [s], accelerations `a` (C, N) [m/s²] of the sensors
    `channels`, speed `v` (N,) [m/s], station `s` (N,) [m] of the front axle, `spring_stiff` and
    `damper_high` (N, 4) of the wheels FL, FR, RL, RR, `stations` (M,) [m], and `vehicle`, the
    parameters of the one that an estimator is told under this condition. Those of `training` also
    have the true heights `z` (2, M) [m] of the left and the right wheel path. A training drive
    serves the test drives of its condition. Those have a list `calibration` of earlier drives of
    the same vehicle, with `z` where their road was surveyed. The field `vehicle` below has the
    parameters of the task's nominal vehicle.
    """

    name: str
    training: tuple[dict[str, Any], ...]
    test: tuple[dict[str, Any], ...]
    vehicle: dict[str, Any]
    _data: tuple[ConditionData, ...] = field(repr=False)

    @property
    def identity(self) -> str:
        """Name and digest of the task with these test drives, and version of the code behind."""
        return f"{self.name}-{self._data[0].task.digest[:12]}-{results.evaluation_version()}"


def load_task(
    task: str | Path | Task,
    *,
    roads: int | None = None,
    simulate: DriveSimulation = simulate_drives,
) -> TaskArrays:
    """Simulate the drives of a task, of `roads` test drives per condition if that is given.

    Raises ConfigError.
    """
    chosen, data = _sized(task, roads), []
    for condition in chosen.conditions:
        made = evaluate.simulate_condition(chosen, condition, simulate)
        if isinstance(made, str):
            raise ConfigError(f"{chosen.name}: {made}")
        data.append(made)
    training = tuple(_arrays(x, drive.record, drive.truth) for x in data for drive in x.training)
    test = tuple(_test_arrays(x, drive) for x in data for drive in x.tests)
    return TaskArrays(chosen.name, training, test, asdict(chosen.vehicle), tuple(data))


def score_arrays(
    task: TaskArrays, heights: Sequence[Any], std: Sequence[Any] | None = None
) -> ScoreTable:
    """Score heights (2, M) [m] of every test drive, in the order of `task.test`.

    `std`: standard deviations of the same shapes. Returns the row of a board: interquartile means
    over roads and conditions. Raises ConfigError for another number or shape of arrays.
    """
    given = {"heights": heights, **({} if std is None else {"standard deviations": std})}
    for what, arrays in given.items():
        if len(arrays) != len(task.test):
            raise ConfigError(
                f"{task.name} has {len(task.test)} test drives, got {len(arrays)} {what}"
            )
    left = _estimates(task, given)

    def run(entry: Entry, data: ConditionData, seeds: Sequence[int]) -> list[TrainingRun]:
        return [TrainingRun([next(left) for _ in data.tests], 0.0, 0.0, 0, seeds[0])]

    entry = Entry(name="arrays", reference="arrays")
    parts = [evaluate.evaluate_entry(x.task, x.condition, x, entry, (1,), run) for x in task._data]
    scores = results.score_arrays(results.merge_parts(parts, "").scores)
    means = interquartile_mean(scores.reshape(len(SCORES), -1))
    return ScoreTable(dict(zip(SCORES, means.tolist(), strict=True)))


def _make(reference: str, each_case: bool) -> Estimator:
    entry = Entry(name=reference, reference=reference)
    settings = entry_refit_per_case(entry).settings if each_case else {}
    return estimators.make_estimator(reference, **settings)


def _sized(task: str | Path | Task, roads: int | None) -> Task:
    chosen = task if isinstance(task, Task) else tasks.load_task(task)
    return chosen if roads is None else chosen.with_test_drives(roads)


def _test_arrays(data: ConditionData, drive: RecordedDrive) -> dict[str, Any]:
    earlier = [_arrays(data, x.record, x.profile) for x in drive.calibration]
    return _arrays(data, drive.record, None) | {"calibration": earlier}


def _arrays(data: ConditionData, record: Record, profile: Profile | None) -> dict[str, Any]:
    names = ("t", "a", "v", "s", "spring_stiff", "damper_high")
    return {
        "condition": data.condition.label,
        "channels": record.channels,
        **{name: getattr(record, name) for name in names},
        "stations": profile_stations(record.length),
        "vehicle": asdict(data.task.vehicle_of(data.condition)),
        **({"z": profile.z} if profile is not None else {}),
    }


def _estimates(task: TaskArrays, given: Mapping[str, Sequence[Any]]) -> Iterator[Estimate]:
    """Yield the estimates of all test drives. Raises ConfigError for arrays of another shape."""
    for k, drive in enumerate(task.test):
        shape = (2, drive["stations"].size)
        arrays = [real_numbers(values[k]) for values in given.values()]
        for what, array in zip(given, arrays, strict=True):
            if array.shape != shape or not np.isfinite(array).all():
                wanted = f"test drive {k + 1} needs finite {what} of the shape {shape}"
                raise ConfigError(f"{wanted}, got {array.shape}")
            if what != "heights" and (array < 0.0).any():
                raise ConfigError(f"test drive {k + 1} has negative {what}")
        yield Estimate(drive["stations"], arrays[0], arrays[1] if len(arrays) > 1 else None)


def real_numbers(values: Any) -> np.ndarray:
    """Return real numbers as an array; an empty one of anything else, and of masked numbers."""
    rows = values if isinstance(values, list | tuple) else [values]
    try:
        array = np.asarray(values)
        if array.dtype == object and not any(isinstance(x, bool | np.bool) for x in array.flat):
            array = array.astype(float)
    except (TypeError, ValueError, RuntimeError):  # ragged lists; tensors with gradients
        return np.empty(0)
    is_real = array.dtype.kind in "iuf" and not any(np.ma.is_masked(row) for row in rows)
    return array.astype(float) if is_real else np.empty(0)
