"""Standings of policies in numbers that can be printed: means, intervals, differences, fronts."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leaderboard.league import ORACLE, Standing
from leaderboard.ride import METRICS
from leaderboard.scenarios import Scenarios
from leaderboard.statistics import LEVEL, Interval, bootstrap, interquartile_mean, interval

REFERENCE = "fixed_ride"
"""The policy from which differences are taken."""

FRONT = ("comfort", "tyre_load")
"""Axes of the Pareto front beside the estimation error: comfort and handling."""


def summary(
    scenarios: Scenarios, standings: Sequence[Standing], seeds: Sequence[int], reference: str
) -> dict[str, Any]:
    """All that was found, as plain data: a row for each policy."""
    by_name = {s.policy: s for s in standings if s.failure is None}
    base = by_name.get(reference)
    rows = [_row(s, base) for s in standings]
    for row, on in zip(rows, pareto(by_name, [s.policy for s in standings]), strict=True):
        row["pareto"] = on
    return {
        "scenarios": scenarios.name,
        "title": scenarios.title,
        "cases": [case.label for case in scenarios.cases],
        "seeds": list(seeds),
        "reference": reference,
        "rows": rows,
    }


def difference(one: np.ndarray, other: np.ndarray, seed: int = 0) -> Interval:
    """Interquartile mean of `one` less that of `other`, both (R, C), and its paired interval.

    Both are drawn on the same roads again and again, so what makes a road hard falls out.
    """
    a, b = one[:, :, None], other[:, :, None]
    drawn = bootstrap(a, seed) - bootstrap(b, seed)
    mean = float(interquartile_mean(a.ravel()) - interquartile_mean(b.ravel()))
    if not np.isfinite(drawn).all():
        return Interval(np.nan, np.nan, np.nan)
    low, high = np.quantile(drawn, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
    return Interval(mean, float(low), float(high))


def pareto(by_name: Mapping[str, Standing], names: Sequence[str]) -> list[bool]:
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


def _point(standing: Standing) -> np.ndarray:
    errors = list(standing.errors.values()) or [standing.drives["bound"]]
    values = [*(standing.drives[name] for name in FRONT), errors[0]]
    return np.array([interquartile_mean(x.ravel()) for x in values])


def _row(standing: Standing, base: Standing | None) -> dict[str, Any]:
    row: dict[str, Any] = {
        "policy": standing.policy,
        "attainable": standing.policy != ORACLE,
        "failure": standing.failure,
        "notes": list(standing.notes),
    }
    if standing.failure is not None:
        return row
    for kind, values in (("metrics", standing.drives), ("errors", standing.errors)):
        row[kind] = {name: _told(name, x, base, kind) for name, x in values.items()}
    return row


def _told(name: str, x: np.ndarray, base: Standing | None, kind: str) -> dict[str, Any]:
    told: dict[str, Any] = {
        **interval(x[:, :, None])._asdict(),
        "cases": [float(v) for v in interquartile_mean(x, axis=0)],
    }
    if base is not None:
        other = (base.drives if kind == "metrics" else base.errors)[name]
        told["difference"] = difference(x, other)._asdict()
    return told


def text(name: str, value: float) -> str:
    """A metric as printed."""
    metric = METRICS[name]
    return f"{metric.factor * value:.{metric.digits}f}" if np.isfinite(value) else "–"
