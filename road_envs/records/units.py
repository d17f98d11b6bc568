"""Units of the columns of data loggers, and their factors to SI."""

import re
import unicodedata

from road_envs.core.config import ConfigError, shown

STANDARD_GRAVITY = 9.80665  # standard gravity [m/s²], the unit g of acceleration columns

FACTORS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "acceleration": {"m/s2": 1.0, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY},
    "speed": {"m/s": 1.0, "km/h": 1.0 / 3.6, "mph": 0.44704, "kn": 1852.0 / 3600.0},
    "distance": {
        "m": 1.0,
        "km": 1e3,
        "cm": 1e-2,
        "mm": 1e-3,
        "mi": 1609.344,
        "ft": 0.3048,
        "in": 0.0254,
        "mil": 25.4e-6,
    },
    "angle": {"deg": 1.0, "rad": 57.29577951308232},
}
"""Factor to seconds, m/s², m/s, m or degrees, by kind of quantity and unit."""

SPELLINGS = {
    "m/s^2": "m/s2", "m/s**2": "m/s2", "m/s/s": "m/s2", "ms-2": "m/s2", "m*s-2": "m/s2",
    "ms2": "m/s2", "mps2": "m/s2", "mps": "m/s", "ms-1": "m/s", "kmh": "km/h", "kph": "km/h",
    "km/hr": "km/h", "mi/h": "mph", "knots": "kn", "kt": "kn", "sec": "s", "second": "s",
    "seconds": "s", "msec": "ms", "millis": "ms", "usec": "us", "degrees": "deg",
    "degree": "deg", "°": "deg", "metre": "m", "meter": "m", "metres": "m", "meters": "m",
    "feet": "ft", "inch": "in", "inches": "in", "mils": "mil",
}  # fmt: skip

SUFFIXES = ("g", "kmh", "kph", "mph", "mps", "ms2", "mps2")
"""Units that a header may end in after an underscore, as in "a_rf_g" and "v_kmh"."""

HEADER = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]$")


def normalise(unit: str) -> str:
    """Return a unit as FACTORS spells it, if it is known there."""
    text = unicodedata.normalize("NFKC", unit).replace("µ", "u").replace("μ", "u")
    text = text.replace("·", "*").replace("−", "-").replace(" ", "").strip("[]()").lower()
    return SPELLINGS.get(text, text)


def is_unit(text: str) -> bool:
    """Return whether a text is a unit of any kind of quantity."""
    return any(normalise(text) in factors for factors in FACTORS.values())


def factor(kind: str, unit: str) -> float:
    """Return the factor from `unit` to that of SI (degrees for angles). Raises ConfigError."""
    known = FACTORS[kind]
    if (found := known.get(normalise(unit))) is None:
        raise ConfigError(f"the {kind} unit {shown(unit)} is unknown; known: {', '.join(known)}")
    return found


def split_header(header: str) -> tuple[str, str | None]:
    """Return name and unit of a header: "a_rf [g]", "speed (km/h)" or "a_rf_g"."""
    if match := HEADER.match(header.strip()):
        return match["name"].strip(), match["unit"].strip()
    name, _, end = header.strip().rpartition("_")
    if name and end.lower() in SUFFIXES:
        return name, end.lower()
    return header.strip(), None
