"""Agreement of two results of the same inputs: within a tolerance, not to the last bit.

Processor, BLAS kernel and number of threads decide the order of a sum, and so the last bits of a
score; an iteration that stops at a threshold enlarges them. Two values of a score are

    |a - b| / max(|a|, |b|, 100 printed steps)

apart: relative to the larger one, and absolute where both are small. A printed step is that of the
last digit of the score's column, 0.001 for an NRMSE. A digest of rounded values would do no better
than one of all bits: of many values, one always lies at a boundary.

With the kernels Haswell and SkylakeX of OpenBLAS, NRMSEs are up to 5.0e-2 apart (`docs/cost.md`).
Scores of waves that no sensor sees, such as the level error, differ more, and counts jump, so with
other kernels the ranking score alone counts.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from leaderboard.evaluation.results import COLUMNS
from leaderboard.metrics.registry import SCORES

SAME_KERNELS = 1e-9
"""Tolerance of two processes with the same processor, kernels and libraries."""

OTHER_KERNELS = 0.1
"""Tolerance of two processors or kernels: twice the largest distance that was measured."""

_PRINTED_STEPS = 100  # steps of the last printed digit that a smaller score is taken relative to


class _Distance(NamedTuple):
    """The score of two results of a drive whose values are the farthest apart, and how far."""

    score: str
    value: float


def distance(score: str, a: float | None, b: float | None) -> float:
    """Return the distance [-] of two values of a score: 0 to 2, and 2 if only one is defined."""
    if a is None or b is None:
        return 0.0 if a is b else 2.0
    form = SCORES[score]
    floor = _PRINTED_STEPS * 10.0**-form.digits / form.factor
    return abs(a - b) / max(abs(a), abs(b), floor)


def largest_distance(
    a: Mapping[str, float], b: Mapping[str, float], names: Iterable[str] = SCORES
) -> _Distance:
    """Largest distance of the scores `names` of two runs of a drive."""
    found = [_Distance(name, distance(name, a.get(name), b.get(name))) for name in names]
    return max(found, key=lambda x: x.value)


def scores_by_run(table: Any) -> dict[tuple[Any, ...], dict[str, float]]:
    """Scores by name of each run of a table of scores, by its values of RUN."""
    found: dict[tuple[Any, ...], dict[str, float]] = {}
    for *run, score, value in table[list(COLUMNS)].itertuples(index=False, name=None):
        found.setdefault(tuple(run), {})[score] = value
    return found
