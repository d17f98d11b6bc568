"""Standings of policies in numbers that can be printed: means, intervals, differences, fronts."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leaderboard.metrics.bootstrap import CONFIDENCE, Interval, bootstrap, interquartile_mean
from leaderboard.policies.comparison import ORACLE, PolicyResult
from leaderboard.policies.ride_metrics import METRICS
from leaderboard.policies.scenarios import Scenarios

REFERENCE = "fixed_ride"
"""The policy from which differences are taken."""

TUNED_POLICIES = ("rrms", "sh_add")
"""Tuned policies of the literature, whose returns others have to beat."""

PARETO_METRICS = ("comfort", "tyre_load")
"""Axes of the Pareto front beside the estimation error: comfort and handling."""


def summarize_results(
    scenarios: Scenarios, results: Sequence[PolicyResult], seeds: Sequence[int], reference: str
) -> dict[str, Any]:
    """All that was found, as plain data: a row for each policy."""
    by_name = {s.policy: s for s in results if s.failure is None}
    base = _reference_statistics(by_name.get(reference))
    rows = [_row(s, base) for s in results]
    for row in rows:
        row["more_than"] = {
            name: _interval_dict(
                paired_difference(mine.metrics["reward"], by_name[name].metrics["reward"])
            )
            for name in dict.fromkeys((reference, *TUNED_POLICIES))
            if name in by_name and (mine := by_name.get(row["policy"]))
        }
    for row, on in zip(rows, pareto(by_name, [s.policy for s in results]), strict=True):
        row["pareto"] = on
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
    """Mean over cases of the interquartile means over roads of `x` (R, C) or (R, C, S), with its
    95 % bootstrap interval over roads, then seeds. A case is a kind of drive and counts as much as
    any other; roads are draws of one kind, of which the odd ones should not rule.
    """
    return _as_interval(_mean(_with_seed_axis(x)), _replicates(x))


def paired_difference(one: np.ndarray, other: np.ndarray) -> Interval:
    """`case_mean` of `one` less that of `other`, (R, C) or (R, C, S), and its paired interval.

    Both are drawn on the same roads again and again, so what makes a road hard falls out.
    """
    mean = _mean(_with_seed_axis(one)) - _mean(_with_seed_axis(other))
    return _as_interval(mean, _replicates(one) - _replicates(other))


def _with_seed_axis(x: np.ndarray) -> np.ndarray:
    return x if x.ndim == 3 else x[:, :, None]


def _mean(x: np.ndarray) -> float:
    per_case = [interquartile_mean(x[:, c].ravel()) for c in range(x.shape[1])]
    return float(np.mean(per_case))


def _replicates(x: np.ndarray) -> np.ndarray:
    """Replicates (B,): with one seed every case is on the same draw of roads."""
    x = _with_seed_axis(x)
    return np.mean([bootstrap(x[:, [c]], seed=0) for c in range(x.shape[1])], axis=0)


def _as_interval(mean: float, drawn: np.ndarray) -> Interval:
    if not np.isfinite(drawn).all():
        return Interval(np.nan, np.nan, np.nan)
    low, high = np.quantile(drawn, [0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2])
    return Interval(mean, float(low), float(high))


def pareto(by_name: Mapping[str, PolicyResult], names: Sequence[str]) -> list[bool]:
    """Who is beaten by nobody in comfort, handling and the error of the first estimator at once.

    The oracle, which is none of them, beats nobody. Without estimators the bound stands for them.
    """
    points = {name: _point(s) for name, s in by_name.items() if name != ORACLE}
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
    return np.array([_mean(_with_seed_axis(x)) for x in values])


ReferenceStatistics = dict[tuple[str, str], tuple[float, np.ndarray]]
"""Of the reference: mean and replicates (B,), by kind and name of what is told."""


def _reference_statistics(result: PolicyResult | None) -> ReferenceStatistics:
    if result is None:
        return {}
    return {
        (kind, name): (_mean(_with_seed_axis(x)), _replicates(x))
        for kind, values in _score_groups(result)
        for name, x in values.items()
    }


def _score_groups(result: PolicyResult) -> tuple[tuple[str, Mapping[str, np.ndarray]], ...]:
    return ("metrics", result.metrics), ("errors", result.errors)


def _row(result: PolicyResult, base: ReferenceStatistics) -> dict[str, Any]:
    row: dict[str, Any] = {
        "policy": result.policy,
        "attainable": result.policy != ORACLE,
        "failure": result.failure,
        "notes": list(result.notes),
    }
    if result.failure is not None:
        return row
    for kind, values in _score_groups(result):
        row[kind] = {name: _cell(x, base.get((kind, name))) for name, x in values.items()}
    return row


def _cell(x: np.ndarray, base: tuple[float, np.ndarray] | None) -> dict[str, Any]:
    mean, drawn = _mean(_with_seed_axis(x)), _replicates(x)
    cell: dict[str, Any] = {
        **_interval_dict(_as_interval(mean, drawn)),
        "cases": [_round(v) for v in interquartile_mean(x, axis=0)],
    }
    if base is not None:
        cell["difference"] = _interval_dict(_as_interval(mean - base[0], drawn - base[1]))
    return cell


def _interval_dict(x: Interval) -> dict[str, float]:
    return {name: _round(value) for name, value in x._asdict().items()}


def _round(x: float) -> float:
    """Five of them: more is noise, and the file is read by people too."""
    return float(f"{x:.5g}")


def format_metric(name: str, value: float) -> str:
    """A metric as printed."""
    metric = METRICS[name]
    return f"{metric.factor * value:.{metric.digits}f}" if np.isfinite(value) else "–"
