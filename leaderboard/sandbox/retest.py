"""Does an entry look ahead or remember? A second guest is asked again about some test drives.

The second guest, which runs first in half of the cases, estimates drives that the first one also
estimates, after fewer others, and drives whose accelerations, speeds and odometer are other ones
from a secret point on. Heights and standard deviations are compared.
"""

import dataclasses
import random
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from leaderboard.entries.entry import TrainingRun
from road_envs.records.record import Estimate, Record

EQUALITY_TOLERANCE = 1e-6
"""Largest difference [m] of estimates that count as equal: single precision rounds heights of some
metres so, and convolutions by its Fourier transforms leave 2e-8 m.
"""

REPEATED_DRIVES = 2
"""Number of test drives that a second guest estimates again, after other drives than the first."""

REPLACED_FROM = ((0.05, 0.45), (0.45, 0.9), (0.9, 1.0))
"""Shares of a drive between which its samples are replaced from a secret point on: a drive each."""

LOOKS_AHEAD = "claims to be causal, but its estimate of a test drive depends on later samples"
REMEMBERS = "its estimate of a test drive depends on the drives that it has seen before"
UNTESTABLE = "claims to be causal, which cannot be tested of what depends on the drives before"
NOT_CAUSAL = (LOOKS_AHEAD, UNTESTABLE)
NOT_RETESTED = "could not be run again to test its causality and its memory"
"""It begins a note; the reason follows."""

HARD_ACCELERATION = 8.0
"""Acceleration [m/s^2] with which replaced speeds leave the true ones: of a car on a dry road."""


class _Question(NamedTuple):
    """A test drive for a second guest: its index, and where [m] its samples were replaced."""

    drive: int
    record: Record
    start: float = np.inf


def draw_questions(
    records: Sequence[Record], order: Sequence[int], causal: bool, secret: random.Random
) -> list[_Question]:
    """Return drives to be estimated again, most after fewer drives than in `order`.

    Of a causal entry, also drives with other samples from a secret station on, which the second
    guest has not seen as they are: it could remember how they go on. Any drive may be among them;
    of two or three replaced ones of one drive, that which is replaced first is asked first.
    """
    places = range(min(1, len(order) - 1), len(order))  # the first drive has none before it
    chosen = [order[k] for k in sorted(secret.sample(places, min(REPEATED_DRIVES, len(places))))]
    repeated = [_Question(drive, records[drive]) for drive in chosen]
    unseen = [drive for drive in order if drive not in chosen]
    drives = secret.sample(unseen, len(unseen)) + secret.sample(chosen, len(chosen))
    replaced = []
    for k, (low, high) in enumerate(REPLACED_FROM if causal else ()):
        record = records[drive := drives[k % len(drives)]]
        start = record.length * secret.uniform(low, high)
        rng = np.random.default_rng(secret.getrandbits(128))
        replaced.append(_Question(drive, with_other_future(record, start, rng), start))
    return [*replaced, *repeated] if len(unseen) < len(replaced) else [*repeated, *replaced]


def compare_answers(
    questions: Sequence[_Question], run: TrainingRun, again: Sequence[Estimate], lag: float
) -> list[str]:
    """Return notes on estimates of a second guest, `again`, that differ from those of `run`."""
    notes = {}
    for (drive, record, start), estimate in zip(questions, again, strict=True):
        if largest_change(estimate, run.estimates[drive], start, lag, record) > EQUALITY_TOLERANCE:
            notes[LOOKS_AHEAD if np.isfinite(start) else REMEMBERS] = True
    # of a replaced drive, too, the second guest has seen other ones before
    return [REMEMBERS, UNTESTABLE] if {LOOKS_AHEAD, REMEMBERS} == notes.keys() else list(notes)


def with_other_future(record: Record, start: float, rng: np.random.Generator) -> Record:
    """Return a record with other signals from the station `start` [m] on, but for the states.

    The accelerations there are those of the rest backwards, each sensor's louder or softer by 5 to
    10 dB, and noise: what is left of no wave, level or spectrum tells how the drive goes on. The
    speed rises or falls by up to 3 %, as cars can, and the odometer with it: an entry may refuse
    what cannot be true.
    """
    later = record.s >= start
    noise = np.nanstd(record.a) * rng.standard_normal(record.a.shape)
    loudness = np.exp(rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.2, (len(record.a), 1)))
    other = record.a.copy()
    other[:, later] = loudness * record.a[:, later][:, ::-1]
    way = max(100.0, record.s[-1] - start)  # an error of 3 m at most: the rear axle arrives, too
    gain = rng.choice([-1, 1]) * rng.uniform(1.0, 3.0) / way  # its end tells an odometer's error
    begin = int(np.argmax(later))
    seconds = abs(gain) * record.v[begin] / HARD_ACCELERATION
    risen = np.clip((record.t - record.t[begin]) / max(seconds, 1.0 / record.fs), 0.0, 1.0)
    return dataclasses.replace(
        record,
        a=other + np.where(later, noise, 0.0),
        v=record.v * np.where(later, 1.0 + gain * risen, 1.0),
        s=record.s + gain * np.where(later, record.s - start, 0.0),
    )


def largest_change(
    first: Estimate, second: Estimate, start: float, lag: float, record: Record
) -> float:
    """Return the largest difference [m] of two estimates, of heights or of deviations.

    Only stations count whose estimate may not depend on the samples from `start` [m] on, with that
    `lag` [m]: it may know better than the odometer where these are, by as much as that has wandered
    against the speed. It is infinite if only one of them has deviations.
    """
    if (first.z_std is None) != (second.z_std is None):
        return np.inf
    way = cumulative_trapezoid(record.v, record.t, initial=0.0)
    wander = float(np.ptp((record.s - way)[: max(1, np.argmax(record.s >= start))]))
    before = first.s < start - lag - wander - float(np.diff(record.s).max())  # one may interpolate
    pairs = [(first.z, second.z), (first.z_std, second.z_std)]
    changes = [np.abs(a - b)[:, before] for a, b in pairs if a is not None and b is not None]
    return float(max(change.max(initial=0.0) for change in changes))
