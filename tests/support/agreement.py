"""What differs between two results of the same inputs, made by two processes of one machine."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from leaderboard.evaluation.comparison import SAME_KERNELS, largest_distance, scores_by_run
from leaderboard.evaluation.results import RUN_DEPENDENT, Result

TRACE_STEPS = 1
"""Difference of the stored heights of two traces, in units of 0.01 mm: that of their rounding."""


def disagreements(a: Result, b: Result) -> list[str]:
    """What differs beyond SAME_KERNELS, in a few words each; no times, no memory, no machine."""
    return [*_differing_fields(a, b), *_differing_drives(a, b), *_differing_traces(a, b)]


def _differing_fields(a: Result, b: Result) -> Iterator[str]:
    compared_apart = RUN_DEPENDENT | {"scores", "traces"}
    for field in dataclasses.fields(Result):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if field.name not in compared_apart and one != other:
            yield f"{field.name}: {one!r}, {other!r}"


def _differing_drives(a: Result, b: Result) -> Iterator[str]:
    runs, others = ({} if x.scores is None else scores_by_run(x.scores) for x in (a, b))
    for place in dict.fromkeys([*runs, *others]):
        if place not in runs or place not in others:
            yield f"{place}: driven once only"
            continue
        score, value = largest_distance(runs[place], others[place])
        if value > SAME_KERNELS:
            yield f"{place}: {score} differs by {value:.1e}"


def _differing_traces(a: Result, b: Result) -> Iterator[str]:
    if len(a.traces) != len(b.traces):
        yield f"{len(a.traces)} and {len(b.traces)} traces"
        return
    for one, other in zip(a.traces, b.traces, strict=True):
        for name in ("truth", "estimate", "deviation"):
            x, y = getattr(one, name), getattr(other, name)
            if (x is None) != (y is None) or np.shape(x) != np.shape(y):
                yield f"{one.condition}: {name} of the trace"
            elif x is not None and np.abs(np.subtract(x, y)).max(initial=0) > TRACE_STEPS:
                yield f"{one.condition}: heights of the trace, {name}"
