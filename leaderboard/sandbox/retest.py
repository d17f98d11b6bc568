"""Does an entry look ahead or remember? A second guest is asked again about some test drives.

The second guest, which runs first in half of the cases, estimates drives that the first one also
estimates, after fewer others, and drives whose samples are other ones from a secret point on.
"""

import dataclasses
import random
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from leaderboard.entries.entry import TrainingRun
from road_envs.records.record import Estimate, Record

EQUALITY_TOLERANCE = 1e-9
"""Largest difference [m] of estimates that count as equal, for rounding."""

REPEATED_DRIVES = 2
"""Number of test drives that a second guest estimates again, after other drives than the first."""

REPLACED_FROM = ((0.05, 0.9), (0.9, 1.0))
"""Ranges of the secret points, as shares of a drive, from which on its samples are replaced: one
drive for each range.
"""

LOOKS_AHEAD = "claims to be causal, but its estimate of a test drive depends on later samples"
REMEMBERS = "its estimate of a test drive depends on the drives that it has seen before"
NOT_RETESTED = "could not be run again to test its causality and its memory"


class Question(NamedTuple):
    """A test drive for a second guest: its index, and where [m] its samples were replaced."""

    drive: int
    record: Record
    start: float = np.inf


def draw_questions(
    records: Sequence[Record], order: Sequence[int], causal: bool, secret: random.Random
) -> list[Question]:
    """Return drives to be estimated again, each after fewer drives than in `order`.

    Of a causal entry, also drives with other accelerations from a secret station on.
    """
    places = range(min(1, len(order) - 1), len(order))  # the first drive has none before it
    chosen = secret.sample(places, min(REPEATED_DRIVES, len(places)))
    questions = [Question(order[k], records[order[k]]) for k in sorted(chosen)]
    for low, high in REPLACED_FROM if causal else ():
        drive = secret.randrange(len(records))
        record = records[drive]
        start = record.length * secret.uniform(low, high)
        rng = np.random.default_rng(secret.getrandbits(128))
        noise = np.nanstd(record.a) * rng.standard_normal(record.a.shape)
        a = record.a + np.where(record.s >= start, noise, 0.0)
        questions.append(Question(drive, dataclasses.replace(record, a=a), start))
    return questions


def compare_answers(
    questions: Sequence[Question], run: TrainingRun, again: Sequence[Estimate], lag: float
) -> list[str]:
    """Return notes on estimates of a second guest, `again`, that differ from those of `run`."""
    if not again:
        return [NOT_RETESTED]
    notes = {}
    for (drive, record, start), estimate in zip(questions, again, strict=True):
        # between two samples one may interpolate
        end = start - lag - float(np.diff(record.s).max())
        if _differ(estimate, run.estimates[drive], end):
            notes[LOOKS_AHEAD if np.isfinite(start) else REMEMBERS] = True
    return list(notes)


def _differ(first: Estimate, second: Estimate, end: float) -> bool:
    """Return whether two estimates differ before the station `end` [m]."""
    before = first.s < end
    change = np.abs(first.z - second.z)[:, before]
    return bool(change.max(initial=0.0) > EQUALITY_TOLERANCE)
