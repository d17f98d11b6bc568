"""Agreement of two results of the same inputs: within a tolerance, not to the last bit.

Processor, BLAS kernel and number of threads decide the order of a sum, and so the last bits of a
score; an iteration that stops at a threshold enlarges them. Two values of a score are

    |a - b| / max(|a|, |b|, 100 printed steps)

apart: relative to the larger one, and absolute where both are small. A printed step is that of the
last digit of the score's column, 0.001 for an NRMSE. A digest of rounded values would do no better
than one of all bits: of many values, one always lies at a boundary.

The largest distances that were measured by forcing the kernels of OpenBLAS (Haswell, Sandybridge,
SkylakeX) are 1.7e-3 of `map_smoother`, 3.5e-4 of `wiener`, 1.7e-4 of `iterated_wiener`, 9e-8 of
`tcn`, and below 1e-9 of the others. A `discrete` score jumps by a whole step where a value crosses
a threshold, so it is compared with the same kernels only.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from leaderboard.evaluation.results import RUN_DEPENDENT, DriveScores, Result
from leaderboard.metrics.registry import SCORES

SAME_KERNELS = 1e-9
"""Tolerance of two processes with the same processor, kernels and libraries."""

OTHER_KERNELS = 5e-3
"""Tolerance of two processors or kernels: three times the largest distance that was measured."""

PRINTED_STEPS = 100
"""Steps of the last printed digit that a smaller score is taken relative to."""

TRACE_STEPS = 1
"""Difference of the stored heights of two traces, in units of 0.01 mm: that of their rounding."""


LARGEST_DISTANCE = 2.0
"""Distance of a value from its negative; no two values are farther apart."""


class Distance(NamedTuple):
    """The score of two results of a drive whose values are the farthest apart, and how far."""

    score: str
    value: float


def distance(score: str, a: float | None, b: float | None) -> float:
    """Distance [-] of two values of a score, from 0 to 2; 2 if only one of them is defined."""
    if a is None or b is None:
        return 0.0 if a is b else LARGEST_DISTANCE
    form = SCORES[score]
    floor = PRINTED_STEPS * 10.0**-form.digits / form.factor
    return abs(a - b) / max(abs(a), abs(b), floor)


def largest_distance(
    a: Mapping[str, float], b: Mapping[str, float], *, discrete: bool = False
) -> Distance:
    """Return the largest distance of the scores of two runs of a drive; if asked, of all kinds."""
    names = [name for name in SCORES if discrete or not SCORES[name].discrete]
    found = [Distance(name, distance(name, a.get(name), b.get(name))) for name in names]
    return max(found, key=lambda x: x.value)


def disagreements(a: Result, b: Result, tolerance: float = SAME_KERNELS) -> list[str]:
    """Return what differs between two results beyond the tolerance, each in a few words.

    Times, memory, machine and isolation are not compared; discrete scores at SAME_KERNELS only.
    """
    return [*_differing_fields(a, b), *_differing_drives(a, b, tolerance), *_differing_traces(a, b)]


def _differing_fields(a: Result, b: Result) -> Iterator[str]:
    compared_apart = RUN_DEPENDENT | {"drives", "traces"}
    for field in dataclasses.fields(Result):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if field.name not in compared_apart and one != other:
            yield f"{field.name}: {one!r}, {other!r}"


def _differing_drives(a: Result, b: Result, tolerance: float) -> Iterator[str]:
    drives, others = ({run_key(drive): drive for drive in result.drives} for result in (a, b))
    for place in dict.fromkeys([*drives, *others]):
        if place not in drives or place not in others:
            yield f"{place}: driven once only"
            continue
        scores = drives[place].scores, others[place].scores
        score, value = largest_distance(*scores, discrete=tolerance <= SAME_KERNELS)
        if value > tolerance:
            yield f"{place}: {score} differs by {value:.1e}"


def run_key(drive: DriveScores) -> tuple[str, int, str, int, int]:
    """Return what tells a run from the others of its entry: two results have it once each."""
    return drive.condition, drive.drive, drive.road, drive.road_seed, drive.seed


def _differing_traces(a: Result, b: Result) -> Iterator[str]:
    if len(a.traces) != len(b.traces):
        yield f"{len(a.traces)} and {len(b.traces)} traces"
        return
    for one, other in zip(a.traces, b.traces, strict=True):
        for name in ("truth", "estimate", "deviation"):
            x, y = getattr(one, name), getattr(other, name)
            if (x is None) != (y is None) or np.shape(x or ()) != np.shape(y or ()):
                yield f"{one.condition}: {name} of the trace"
            elif x is not None and np.abs(np.subtract(x, y)).max(initial=0) > TRACE_STEPS:
                yield f"{one.condition}: heights of the trace, {name}"
