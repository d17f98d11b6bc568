"""The leaderboard from Python: score an estimate, plot it, run a task.

    record, truth = simulate_record("iso_d", speed_kmh=36, mode="handling", seed=1)
    result = estimate("wiener", record)
    print(score(result, truth))
    plot(result, truth).savefig("estimate.png")
    table = run_task("new_road", ["wiener", "my_package:Mine"], roads=1)

`simulate_record` is in `road_envs`, `estimate` in `estimators`.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import estimators
from estimators.api import Estimator
from leaderboard.evaluation import evaluate
from leaderboard.evaluation.tasks import Task, load_task
from leaderboard.metrics.registry import SCORES
from leaderboard.scoring import ScoreTable, band_speed, check_stations, score
from road_envs.core.extras import optional_import
from road_envs.records.record import Estimate, Profile

__all__ = ["ScoreTable", "plot", "run_task", "score"]


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
    of the rows to these or to estimators; `roads` is the number of test
    drives per condition, `seeds` are those of trainings. `report` is called with each step as it
    begins. An estimator that fails has one row with the reason under `failure`. Columns are keys of
    SCORES, which has their units; their labels are in `table.attrs["labels"]`. For estimators of
    other people use `road-recon leaderboard`, which runs each in a process of its own. Raises
    ConfigError, and MissingExtraError without pandas.
    """
    with optional_import("a DataFrame"):
        import pandas

        from leaderboard.evaluation.results import RUN, scores_table

    chosen = task if isinstance(task, Task) else load_task(task)
    if roads is not None:
        chosen = chosen.with_test_drives(roads)
    named = entries if isinstance(entries, Mapping) else {name: name for name in entries}
    made = {
        name: estimators.make_estimator(entry) if isinstance(entry, str) else entry
        for name, entry in named.items()
    }
    results = evaluate.run_task(chosen, made, seeds, report=report)
    failed = [(result.estimator, result.failure) for result in results if result.failure]
    failures = pandas.DataFrame(failed, columns=["estimator", "failure"])
    scores, runs = scores_table(results), ["estimator", *RUN]
    wide = scores.pivot(index=runs, columns="score", values="value")
    in_order = pandas.MultiIndex.from_frame(scores[runs].drop_duplicates())
    drives = wide.reindex(index=in_order, columns=list(SCORES)).reset_index()
    table = pandas.concat([drives, failures], ignore_index=True)
    table.attrs["labels"] = {key: form.label for key, form in SCORES.items()}
    return table
