"""Summary of policy results: means, bootstrap intervals, paired differences, Pareto front."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leaderboard.metrics.bootstrap import Interval, Resampled, interquartile_mean, resample
from leaderboard.policies.comparison import PolicyResult
from leaderboard.policies.ride_metrics import METRICS
from leaderboard.policies.scenarios import Scenarios

REFERENCE = "fixed_ride"
"""Default policy for paired differences."""

TUNED_POLICIES = ("rrms", "sh_add")
"""Tuned policies of the literature, whose returns are compared with those of all others."""

PARETO_METRICS = ("comfort", "tyre_load")
"""Metrics of the Pareto front beside the reconstruction error: comfort and handling."""


def summarize_results(
    scenarios: Scenarios, results: Sequence[PolicyResult], seeds: Sequence[int], reference: str
) -> dict[str, Any]:
    """Return all results as plain data, with a row for each policy."""
    by_name = {s.policy: s for s in results if s.failure is None}
    base = _reference_statistics(by_name.get(reference))
    rows = [_row(s, base) for s in results]
    for row in rows:
        row["more_than"] = {
            name: _interval_dict(
                paired_difference(mine.metrics["return"], by_name[name].metrics["return"])
            )
            for name in dict.fromkeys((reference, *TUNED_POLICIES))
            if name in by_name and (mine := by_name.get(row["policy"]))
        }
    for row, optimal in zip(rows, pareto(by_name, [s.policy for s in results]), strict=True):
        row["pareto"] = optimal
    return {
        "scenarios": scenarios.name,
        "title": scenarios.title,
        "cases": [case.label for case in scenarios.cases],
        "shown": scenarios.cases[scenarios.shown].label,
        "seeds": list(seeds),
        "reference": reference,
        "rows": rows,
    }


def case_mean(x: np.ndarray) -> Interval:
    """Return the mean over cases of the interquartile means over roads, with a 95 % interval.

    `x` is (R, C) or (R, C, S); the bootstrap resamples roads, then seeds. Cases are kinds of drives
    and count equally; roads are samples of one kind, so outliers among them are trimmed.
    """
    return _over_cases(x).interval()


def paired_difference(one: np.ndarray, other: np.ndarray) -> Interval:
    """Return `case_mean` of `one` minus that of `other`, (R, C) or (R, C, S), with its interval.

    Both are resampled on the same roads, so the common effect of a road cancels.
    """
    return _over_cases(one).minus(_over_cases(other)).interval()


def _over_cases(x: np.ndarray) -> Resampled:
    """Return the mean over cases, resampled on the same roads in every case."""
    C = x.shape[1]
    parts = np.split(x if x.ndim == 3 else x[:, :, None], C, axis=1)
    return resample(parts, [1.0 / C] * C)


def pareto(by_name: Mapping[str, PolicyResult], names: Sequence[str]) -> list[bool]:
    """Return whether each policy is Pareto-optimal in comfort, handling and the first error.

    Without estimators the bound is the error.
    """
    points = {name: _point(s) for name, s in by_name.items()}
    return [
        name in points
        and not any(
            (other <= points[name]).all() and (other < points[name]).any()
            for other in points.values()
        )
        for name in names
    ]


def _point(result: PolicyResult) -> np.ndarray:
    errors = list(result.errors.values()) or [result.metrics["bound"]]
    values = [*(result.metrics[name] for name in PARETO_METRICS), errors[0]]
    return np.array([interquartile_mean(x, axis=0).mean() for x in values])


ReferenceStatistics = dict[tuple[str, str], Resampled]
"""Scores of the reference policy, by kind ("metrics", "errors") and name."""


def _reference_statistics(result: PolicyResult | None) -> ReferenceStatistics:
    if result is None:
        return {}
    return {
        (kind, name): _over_cases(x)
        for kind, values in _score_groups(result)
        for name, x in values.items()
    }


def _score_groups(result: PolicyResult) -> tuple[tuple[str, Mapping[str, np.ndarray]], ...]:
    return ("metrics", result.metrics), ("errors", result.errors)


def _row(result: PolicyResult, base: ReferenceStatistics) -> dict[str, Any]:
    row: dict[str, Any] = {
        "policy": result.policy,
        "attainable": True,
        "failure": result.failure,
        "notes": list(result.notes),
    }
    if result.failure is not None:
        return row
    for kind, values in _score_groups(result):
        row[kind] = {name: _cell(x, base.get((kind, name))) for name, x in values.items()}
    return row


def _cell(x: np.ndarray, base: Resampled | None) -> dict[str, Any]:
    mine = _over_cases(x)
    cell: dict[str, Any] = {
        **_interval_dict(mine.interval()),
        "cases": [_round(v) for v in interquartile_mean(x, axis=0)],
    }
    if base is not None:
        cell["difference"] = _interval_dict(mine.minus(base).interval())
    return cell


def _interval_dict(x: Interval) -> dict[str, float]:
    return {name: _round(value) for name, value in x._asdict().items()}


def _round(x: float) -> float:
    """Return `x` with five digits: more is noise, and people read the file."""
    return float(f"{x:.5g}")


def format_metric(name: str, value: float) -> str:
    """Return the text of a metric."""
    return METRICS[name].format_value(value)
