"""Notes of a report in the order of their weight: what spoils the result comes first."""

import re
from collections.abc import Iterable

MISFIT = r"does not reproduce|times the expected one|heights are reduced"
"""Notes of an estimator whose model does not give the measured motion."""

WEIGHTS = (
    r"heights there are not known",
    MISFIT,
    r"no side motion",
    r"fits .* better|moved in its mount|the speed and the wheelbase|without tolerances",
    r"swings by itself|wheels were in the air|the unit|is in g|check ",
    r"do not tell left from right",
    r"known IRI|was adapted|adapted to the drive|one road from|not compared",
    r"is taken to lie|are read as|is taken as|split at its pauses|left out",
    r"mounted with|follows the front axle|axle to axle|do not reach|does not reach|lie behind",
    r"",
    r"values every|interpolated|resampled|scaled by",
)
"""Patterns of notes, the weightiest first; a note has the weight of the first that it matches, and
the empty one is that of all others.
"""


LARGE_RESIDUAL = 3.0
"""Residual in times of the sensors' noise from which on obstacles are only possible ones."""


def misfits(notes: Iterable[str]) -> bool:
    """Whether a note says that the model is far from reproducing the record."""
    residuals = [re.search(r"residual ([\d.]+) times", note) for note in notes]
    return any(float(found[1]) >= LARGE_RESIDUAL for found in residuals if found)


def in_order_of_weight(notes: Iterable[str]) -> tuple[str, ...]:
    """Return the notes without repetitions, by WEIGHTS; equal ones stay in their order."""
    return tuple(sorted(dict.fromkeys(notes), key=_weight))


def _weight(note: str) -> int:
    others = WEIGHTS.index("")
    matches = [k for k, text in enumerate(WEIGHTS) if text and re.search(text, note)]
    return min(matches, default=others)
