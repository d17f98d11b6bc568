"""Notes of a report in the order of their weight, and what estimates leave unexplained."""

import math
import re
from collections.abc import Iterable

import numpy as np

from estimators.common.misfit import NOISE_SCALE_WARNING
from leaderboard.drive_report.mean_path import MISFIT_STD, tells_vehicle
from leaderboard.drive_report.posterior_iri import posterior_iri
from road_envs.records.record import Estimate, Record

_MISFIT = r"does not reproduce|times the expected one|heights are reduced"
"""Notes of an estimator whose model does not give the measured motion."""

ONE_ROAD = "one road from"  # words of the note of the road of all passes, which is no doubt
_FITTED = r"was adapted|adapted to the drive"
"""Notes of a vehicle whose parameters or elements were found from the drive itself."""

_SLOW = ": values every"  # words after the name of a column that has fewer samples
_WEIGHTS = (
    r"heights there are not known",
    r"^the record .* is assumed",
    _MISFIT,
    r"IRI has no interval where",
    r"seem to be smoothed",
    r"no side motion",
    r"fits .* better|moved in its mount|the speed and the wheelbase|without tolerances",
    r"swings by itself|wheels were in the air|the unit|is in g|check ",
    r"do not tell left from right",
    rf"known IRI|IRI is multiplied|{_FITTED}|{ONE_ROAD}|not compared",
    r"is taken to lie|are read as|is taken as|split at its pauses|left out",
    r"mounted with|follows the front axle|axle to axle|do not reach|does not reach|lie behind",
    r"",
    r"values every|interpolated|resampled|scaled by",
)
"""Patterns of notes, the weightiest first; a note has the weight of the first that it matches, and
the empty one is that of all others.
"""

_NOTED_RESIDUAL = math.sqrt(NOISE_SCALE_WARNING)
LARGE_RESIDUAL = 3.0  # times the sensors' noise from which on obstacles are only possible ones
_HUGE_RESIDUAL, _HUGE_SHARE = 8.0, 0.2
"""The same from which on the IRI has no interval, if it is also this share of the accelerations. A
saloon whose frame twists has 40 to 120, a share of 0.5 to 0.75, with three or four phones, and an
IRI of 0.4 to 0.7 times the true one; with the frame 3.6 to 18.5, a share of 0.04 to 0.16, and one
that is right to 13 % (`studies/few_sensors.py`). Of two sensors both paths explain most of
anything: LARGE_RESIDUAL is their limit, with 5 to 32 without the frame and up to 2.8 with it.
"""

_LEAST_SURE, _SURE_LENGTH = 0.9, 100.0
"""Logarithm of the upper over the lower limit of an IRI over this length [m] above which sensors on
both sides tell less than one sensor, which has 0.5 to 0.6. With three phones in a saloon of grade
S2 over class B with bumps the last 50 m had an IRI of 9 to 97 mm/m where 4.2 is true; the other
segments of such drives have 1.2 (`studies/few_sensors.py`).
"""


def misfits(estimate: Estimate, is_mean_path: bool) -> bool:
    """Whether the model is far from reproducing the record. The mean path alone can explain any
    record of its sensors, so what it leaves tells as soon as it is noted.
    """
    # the mean path alone can explain any record of its sensors: what it leaves tells once noted
    return residual_of(estimate) >= (_NOTED_RESIDUAL if is_mean_path else LARGE_RESIDUAL)


def misfit_std(estimate: Estimate, is_mean_path: bool) -> float:
    """Return the relative standard deviation of an IRI by what the model does not reproduce.

    It grows with that of both paths up to LARGE_RESIDUAL: three or four phones in a saloon of grade
    S2 that leave 1.4 to 3 have an IRI that errs by 0.08 as RMS (`studies/few_sensors.py`, seeds
    1702 to 1706).
    """
    residual = residual_of(estimate)
    if residual < _NOTED_RESIDUAL:
        return 0.0
    return MISFIT_STD * (1.0 if is_mean_path else min(residual / LARGE_RESIDUAL, 1.0))


def is_far_off(estimate: Estimate, record: Record, noise: float) -> bool:
    """Whether the model with sensors on both sides leaves so much of the record unexplained that
    its IRI may be anything; `noise` [m/s²] is the RMS of the sensors'.
    """
    residual = residual_of(estimate)
    if not tells_vehicle(record.sensors):
        return residual >= LARGE_RESIDUAL
    is_small = residual * noise < _HUGE_SHARE * float(np.nanstd(record.a))
    return residual >= _HUGE_RESIDUAL and not is_small


def is_unsure(estimate: Estimate) -> bool:
    """Whether the model does not reproduce the record, and gives heights that cannot be, or tells
    less of some IRI than the mean path of one sensor would.
    """
    if residual_of(estimate) < LARGE_RESIDUAL:
        return False
    if estimate.draws is None or estimate.unsure is not None:
        return estimate.unsure is not None
    count = max(1, round((estimate.s[-1] - estimate.s[0]) / _SURE_LENGTH))
    edges = np.linspace(estimate.s[0], estimate.s[-1], count + 1)
    iri = posterior_iri(estimate, edges)
    return bool((np.log(iri.high[-1] / iri.low[-1]) > _LEAST_SURE).any())


def residual_of(estimate: Estimate) -> float:
    """Return the residual in times of the sensors' noise; 0 of methods that have none."""
    return estimate.residual or 0.0


def in_order_of_weight(notes: Iterable[str]) -> tuple[str, ...]:
    """Return the notes without repetitions, by _WEIGHTS; equal ones stay in their order.

    Columns of which one thing is said are in one note.
    """
    alike: dict[str, list[str]] = {}
    for note in dict.fromkeys(notes):
        name, slow, rest = note.partition(_SLOW)
        alike.setdefault(slow + rest if slow else note, []).append(name)
    joined = [
        ", ".join(names) + what if what.startswith(_SLOW) else what for what, names in alike.items()
    ]

    def weight(note: str) -> int:
        found = (k for k, text in enumerate(_WEIGHTS) if text and re.search(text, note))
        return next(found, _WEIGHTS.index(""))

    return tuple(sorted(joined, key=weight))


def vehicle_in_words(notes: Iterable[str]) -> str:
    """Return how much of its vehicle an estimate found in the drive, as its `notes` say."""
    found = [note for note in notes if re.search(_FITTED, note)]
    if not found:
        return "as described"
    is_bent = all("body bends" in note for note in found)
    return "as described, but for the bending of its body" if is_bent else "fitted to the drive"
