"""Units of the columns of data loggers, and their factors to SI."""

import re
import unicodedata

from road_envs.core.config import ConfigError, folder, read_yaml, shown

STANDARD_GRAVITY = 9.80665  # standard gravity [m/s²], the unit g of acceleration columns

_TABLES = read_yaml(folder() / "units" / "logger_columns.yaml")
FACTORS: dict[str, dict[str, float]] = _TABLES["factors"]
"""Factor to seconds, m/s², m/s, m or degrees, by kind of quantity and unit."""

SUFFIXES = ("g", "kmh", "kph", "mph", "mps", "ms2", "mps2")
"""Units that a header may end in after an underscore or a blank, as in "a_rf_g" and "v_kmh"."""

HEADER = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]$")


def normalise(unit: str) -> str:
    """Return a unit as FACTORS spells it, if it is known there."""
    text = unicodedata.normalize("NFKC", unit).replace("µ", "u").replace("μ", "u")
    text = text.replace("·", "*").replace("−", "-").replace(" ", "").strip("[]()").lower()
    return _TABLES["spellings"].get(text, text)


def factor(kind: str, unit: str) -> float:
    """Return the factor from `unit` to that of SI (degrees for angles). Raises ConfigError."""
    known = FACTORS[kind]
    if (found := known.get(normalise(unit))) is None:
        raise ConfigError(f"the {kind} unit {shown(unit)} is unknown; known: {', '.join(known)}")
    return found


def split_header(header: str, kind: str | None = None) -> tuple[str, str | None]:
    """Return name and unit of a header: "a_rf [g]", "speed (km/h)" or "a_rf_g".

    A length at the end is a unit if the `kind` is distance: "left_in", "left in", but not "t_in".
    """
    if match := HEADER.match(header.strip()):
        return match["name"].strip(), match["unit"].strip()
    name, _, end = header.strip().replace(" ", "_").rpartition("_")
    lengths = FACTORS["distance"] if kind == "distance" else ()
    if name and (end.lower() in SUFFIXES or normalise(end) in lengths):
        return header.strip()[: len(name)], end.lower()
    return header.strip(), None
