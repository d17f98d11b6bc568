"""The leaderboard from Python: score an estimate, plot it, run a task.

    record, truth = simulate_record("iso_d", speed_kmh=36, mode="handling", seed=1)
    result = estimate("wiener", record)
    print(score(result, truth))
    plot(result, truth).savefig("estimate.png")
    table = run_task("new_road", ["wiener", "my_package:Mine"], roads=1)

`simulate_record` is in `road_envs`, `estimate` in `estimators`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import estimators
from estimators.api import Estimator
from leaderboard.evaluation import evaluate
from leaderboard.evaluation.tasks import Task, load_task
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.registry import PRINTED_SCORES, SCORES, compute_scores
from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import
from road_envs.records.record import Estimate, Profile


@dataclass(frozen=True)
class ScoreTable:
    """Scores of one estimate by key (`leaderboard.metrics.registry.SCORES`); NaN if undefined."""

    values: dict[str, float]

    def __getitem__(self, key: str) -> float:
        """Return the score of a key as computed, not scaled for printing."""
        return self.values[key]

    def rows(self) -> list[tuple[str, str, str]]:
        """Return key, text with unit and label of each of PRINTED_SCORES that is defined."""
        defined = [key for key in PRINTED_SCORES if math.isfinite(self.values.get(key, math.nan))]
        return [(key, SCORES[key].text(self.values[key]), SCORES[key].label) for key in defined]

    def __str__(self) -> str:
        """Return the main scores as text, one on each line; `to_pandas` has them all."""
        return "\n".join(f"{label:<42}{text:>12}   {key}" for key, text, label in self.rows())

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame with columns label, value and unit, indexed by key.

        Values are in the printed unit. Raises MissingExtraError without pandas.
        """
        with optional_import("a DataFrame"):
            import pandas

        table = {
            key: (SCORES[key].label, SCORES[key].factor * value, SCORES[key].unit)
            for key, value in self.values.items()
        }
        return pandas.DataFrame.from_dict(table, orient="index", columns=["label", "value", "unit"])


def score(estimate: Estimate, truth: Profile, *, speed_kmh: float | None = None) -> ScoreTable:
    """Score an estimate of both wheel paths against the true ones.

    The scored band depends on the speed of the drive, which an estimate of
    `estimators.estimate` carries; give `speed_kmh` for any other. An estimate whose stations are
    uncertain (`s_std`) is also scored after local alignment. Raises ConfigError, TypeError.
    """
    _check_stations(estimate, truth)
    speed, wandering = _speed(estimate, speed_kmh), estimate.s_std is not None
    scored = ScoredEstimate(truth, estimate, speed, bumps=True, wandering=wandering)
    return ScoreTable(compute_scores(scored))


def plot(
    estimate: Estimate, truth: Profile | None = None, *, speed_kmh: float | None = None
) -> Any:
    """Return a matplotlib figure of both wheel paths, raw and in the scored band, over the truth.

    Raises ConfigError, TypeError, and MissingExtraError without matplotlib.
    """
    from leaderboard.report.plots import estimate_figure

    if truth is not None:
        _check_stations(estimate, truth)
    return estimate_figure(truth, estimate, _speed(estimate, speed_kmh))


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


def _speed(estimate: Estimate, speed_kmh: float | None) -> float:
    if speed_kmh is not None:
        return speed_kmh / 3.6
    if estimate.speed is None:
        raise ConfigError("this estimate has no speed: give the speed of its drive as speed_kmh")
    return estimate.speed


def _check_stations(estimate: Estimate, truth: Profile) -> None:
    if not isinstance(estimate, Estimate) or not isinstance(truth, Profile):
        raise TypeError(
            "an Estimate comes first, then the true Profile; given: "
            f"{type(estimate).__name__}, {type(truth).__name__}"
        )
    if estimate.s.shape != truth.s.shape or abs(estimate.s - truth.s).max() > 1e-6:
        raise ConfigError(
            f"the estimate has {estimate.s.size} stations up to {estimate.s[-1]:.2f} m, the truth "
            f"{truth.s.size} up to {truth.s[-1]:.2f} m: both must be on the same ones"
        )
