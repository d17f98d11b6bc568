"""Tracks in GPX 1.0 and 1.1 (https://www.topografix.com/GPX/1/1/): points with their times.

A speed is that of `<speed>` (GPX 1.0, and extensions of Garmin and others) where all points have
one; otherwise it is left open, and follows from the positions.
"""

import re
from contextlib import suppress
from xml.etree import ElementTree

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.clock import since_1970
from road_envs.drives.recordings.recording import Series, Track

MAX_POINTS = 1_000_000  # most points of a track: eleven days of one a second


def is_gpx(data: bytes) -> bool:
    return re.search(rb"<(\w+:)?gpx[\s>]", data[:2000]) is not None


def parse_gpx(data: bytes) -> Track:
    """Return the track of the points by time. Raises ConfigError."""
    import pandas as pd

    if re.search(rb"<!(DOCTYPE|ENTITY)", data):
        raise ConfigError("a GPX file with a document type or entities is not read")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise ConfigError(f"no readable GPX file: {error}") from None
    points = [p for p in root.iter() if _local(p) == "trkpt"]
    points = points or [p for p in root.iter() if _local(p) in ("rtept", "wpt")]
    if not 2 <= len(points) <= MAX_POINTS:
        raise ConfigError(f"a GPX file of {len(points)} points; 2 to {MAX_POINTS} are read")
    stamps = [_text(p, "time") for p in points]
    if None in stamps:
        raise ConfigError(f"point {stamps.index(None) + 1} of the GPX file has no time")
    t = since_1970(pd.to_datetime(pd.Series(stamps), utc=True, format="ISO8601", errors="coerce"))
    if np.isnan(t).any():
        k = int(np.flatnonzero(np.isnan(t))[0])
        raise ConfigError(f"the time {str(stamps[k])[:60]!r} of point {k + 1} is not in ISO 8601")
    rows = [[_number(p.get("lat")), _number(p.get("lon")), _number(_text(p, "speed")), np.nan]
            for p in points]  # fmt: skip
    t, first = np.unique(t, return_index=True)
    x = np.array(rows)[first]
    if np.isnan(x[:, :2]).any():
        k = int(np.flatnonzero(np.isnan(x[:, :2]).any(axis=1))[0])
        raise ConfigError(f"point {k + 1} of the GPX file has no latitude and longitude")
    if np.isnan(x[:, 2]).any():
        x[:, 2] = np.nan
    return Track(Series(t - t[0], x), float(t[0]))


def _local(element: ElementTree.Element) -> str:
    """Return the name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


def _text(point: ElementTree.Element, name: str) -> str | None:
    return next((e.text for e in point.iter() if _local(e) == name and e.text), None)


def _number(text: str | None) -> float:
    with suppress(ValueError):
        if text is not None and np.isfinite(x := float(text)):
            return x
    return np.nan
