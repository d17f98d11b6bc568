"""Standings of policies in numbers that can be printed: means, intervals, differences, fronts."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from leaderboard.metrics.bootstrap import LEVEL, Interval, bootstrap, interquartile_mean
from leaderboard.policies.comparison import ORACLE, Standing
from leaderboard.policies.ride_metrics import METRICS
from leaderboard.policies.scenarios import Scenarios

REFERENCE = "fixed_ride"
"""The policy from which differences are taken."""

RIVALS = ("rrms", "sh_add")
"""Tuned policies of the literature, whose returns others have to beat."""

FRONT = ("comfort", "tyre_load")
"""Axes of the Pareto front beside the estimation error: comfort and handling."""


def summary(
    scenarios: Scenarios, standings: Sequence[Standing], seeds: Sequence[int], reference: str
) -> dict[str, Any]:
    """All that was found, as plain data: a row for each policy."""
    by_name = {s.policy: s for s in standings if s.failure is None}
    base = _drawn_once(by_name.get(reference))
    rows = [_row(s, base) for s in standings]
    for row in rows:
        row["more_than"] = {
            name: _plain(difference(mine.drives["reward"], by_name[name].drives["reward"]))
            for name in dict.fromkeys((reference, *RIVALS))
            if name in by_name and (mine := by_name.get(row["policy"]))
        }
    for row, on in zip(rows, pareto(by_name, [s.policy for s in standings]), strict=True):
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


def averaged(x: np.ndarray) -> Interval:
    """Mean over cases of the interquartile means over roads of `x` (R, C) or (R, C, S), with its
    95 % bootstrap interval over roads, then seeds. A case is a kind of drive and counts as much as
    any other; roads are draws of one kind, of which the odd ones should not rule.
    """
    return _interval(_mean(_seeds(x)), _drawn(x))


def difference(one: np.ndarray, other: np.ndarray) -> Interval:
    """`averaged` of `one` less that of `other`, (R, C) or (R, C, S), and its paired interval.

    Both are drawn on the same roads again and again, so what makes a road hard falls out.
    """
    mean = _mean(_seeds(one)) - _mean(_seeds(other))
    return _interval(mean, _drawn(one) - _drawn(other))


def _seeds(x: np.ndarray) -> np.ndarray:
    return x if x.ndim == 3 else x[:, :, None]


def _mean(x: np.ndarray) -> float:
    per_case = [interquartile_mean(x[:, c].ravel()) for c in range(x.shape[1])]
    return float(np.mean(per_case))


def _drawn(x: np.ndarray) -> np.ndarray:
    """Replicates (B,): with one seed every case is on the same draw of roads."""
    x = _seeds(x)
    return np.mean([bootstrap(x[:, [c]], seed=0) for c in range(x.shape[1])], axis=0)


def _interval(mean: float, drawn: np.ndarray) -> Interval:
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
    return np.array([_mean(_seeds(x)) for x in values])


Base = dict[tuple[str, str], tuple[float, np.ndarray]]
"""Of the reference: mean and replicates (B,), by kind and name of what is told."""


def _drawn_once(standing: Standing | None) -> Base:
    if standing is None:
        return {}
    return {
        (kind, name): (_mean(_seeds(x)), _drawn(x))
        for kind, values in _kinds(standing)
        for name, x in values.items()
    }


def _kinds(standing: Standing) -> tuple[tuple[str, Mapping[str, np.ndarray]], ...]:
    return ("metrics", standing.drives), ("errors", standing.errors)


def _row(standing: Standing, base: Base) -> dict[str, Any]:
    row: dict[str, Any] = {
        "policy": standing.policy,
        "attainable": standing.policy != ORACLE,
        "failure": standing.failure,
        "notes": list(standing.notes),
    }
    if standing.failure is not None:
        return row
    for kind, values in _kinds(standing):
        row[kind] = {name: _told(x, base.get((kind, name))) for name, x in values.items()}
    return row


def _told(x: np.ndarray, base: tuple[float, np.ndarray] | None) -> dict[str, Any]:
    mean, drawn = _mean(_seeds(x)), _drawn(x)
    told: dict[str, Any] = {
        **_plain(_interval(mean, drawn)),
        "cases": [_digits(v) for v in interquartile_mean(x, axis=0)],
    }
    if base is not None:
        told["difference"] = _plain(_interval(mean - base[0], drawn - base[1]))
    return told


def _plain(x: Interval) -> dict[str, float]:
    return {name: _digits(value) for name, value in x._asdict().items()}


def _digits(x: float) -> float:
    """Five of them: more is noise, and the file is read by people too."""
    return float(f"{x:.5g}")


def text(name: str, value: float) -> str:
    """A metric as printed."""
    metric = METRICS[name]
    return f"{metric.factor * value:.{metric.digits}f}" if np.isfinite(value) else "–"
