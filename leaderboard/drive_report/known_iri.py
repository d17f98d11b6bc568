"""Calibration in the field: the factor of one car and mount from a stretch of known IRI."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from leaderboard.drive_report.analysis import DriveResult, KnownFactor
from road_envs.core.config import ConfigError
from road_envs.core.extras import import_pandas
from road_envs.core.reading import parsing

_LASTING_STD, _STRETCH_STD, _STRETCH = 0.04, 0.06, 100.0
"""Relative standard deviation of a factor: the part that stays on other roads, and that of a
stretch of _STRETCH [m], which falls with the root of its length. Assumed; after 100 m of known IRI
reports of a passenger car from three sensors had an RMS error of 5.7 %.
"""

Stretch = tuple[float, float, float]  # begin [m], end [m], IRI [mm/m]
_LEAST_LENGTH = 50.0  # least length [m] of a stretch of known IRI
_LARGEST = 2.0  # largest factor, and the inverse of the smallest, that a car and a mount explain


def read_known_iri(text: str) -> list[Stretch]:
    """Return the stretches of a table with the columns begin_m, end_m and iri, or the whole drive
    for an IRI as "3.2". Raises ConfigError.
    """
    try:
        value = float(text)
    except ValueError:
        pd, path = import_pandas(), Path(text)
        reason = "neither an IRI nor a table of segments (begin_m, end_m, iri)"
        with parsing(path, ConfigError, reason):
            table = pd.read_csv(path)
            rows = zip(table["begin_m"], table["end_m"], table["iri"], strict=True)
            return [_checked(float(a), float(b), float(x), "iri") for a, b, x in rows]
    return [_checked(-np.inf, np.inf, value, "--known-iri")]


def _checked(begin: float, end: float, value: float, name: str) -> Stretch:
    if not (0.1 <= value <= 30.0 and begin < end):
        raise ConfigError(
            f"{name} must be an IRI of 0.1 to 30 mm/m over a stretch that ends behind its begin, "
            f"got {value:g} from {begin:g} to {end:g} m"
        )
    return begin, end, value


def known_factor(result: DriveResult, stretches: Sequence[Stretch]) -> tuple[KnownFactor, str]:
    """Return the factor that gives the IRI of the stretches, and a note.

    Raises ConfigError if less than _LEAST_LENGTH is covered, or if the factor is implausible.
    """
    known, found, length = 0.0, 0.0, 0.0
    for row in result.segments:
        middle, part = 0.5 * (row["begin_m"] + row["end_m"]), row["end_m"] - row["begin_m"]
        if values := [x for begin, end, x in stretches if begin <= middle < end]:
            length += part
            known += part * values[0]
            found += part * row["iri_mean"]
    if length < _LEAST_LENGTH:
        short = f"{length:.0f} m of {result.name} have a known IRI"
        raise ConfigError(f"{short}; at least {_LEAST_LENGTH:g} m are needed")
    factor = known / found
    if not 1.0 / _LARGEST < factor < _LARGEST:
        raise ConfigError(
            f"the known IRI is {factor:.2f} times that of the report, more than a car and a mount "
            "explain: check the stretch, the unit (mm/m), and the vehicle"
        )
    std = float(np.hypot(_LASTING_STD, _STRETCH_STD * np.sqrt(_STRETCH / length)))
    note = (
        f"IRI is multiplied by {factor:.3f} ± {1.96 * std:.0%}, the factor of this car and mount "
        f"by {length:.0f} m of known IRI"
    )
    return KnownFactor(factor, std), note
