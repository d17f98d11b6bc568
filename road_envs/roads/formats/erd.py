"""Reader of ERD files, the exchange format of profilers and road-profile software by UMTRI's
Engineering Research Division (M.W. Sayers, S.M. Karamihas, "ERD file format for storage and
analysis of road profiles", UMTRI; M. Sayers, UMTRI-87-2, 1987).

    ERDFILEV2.00
    channels, samples, records, bytes, type, step, ...      storage of the numbers
    SHORTNAMLElev.  RElev.                                  keyword of 8 characters, then its text
    UNITSNAMmm      mm                                      8 characters per channel
    XUNITS  m                                               unit of the step
    END

The numbers follow sample by sample, one number per channel: as text (type 5), or as 4-byte floats
(type 1) in a second file with the suffix ".bin". The header does not state the byte order of these
floats; the reader takes the order in which most of them have a plausible magnitude.

The wheel paths are the channels with a unit of length that are called left and right; a single
channel is used for both paths. Channels without a unit and other number types are errors.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from road_envs.core.reading import regular
from road_envs.records.units import FACTORS, normalise
from road_envs.roads.formats.opencrg import (
    MAX_LENGTH,
    SurfaceFileError,
    checked_heights,
    number,
)
from road_envs.roads.formats.table import WheelPaths, metres, parse_number_rows

FLOAT, TEXT = 1, 5  # number types that can be read
PLAUSIBLE_RANGE = (1e-9, 1e9)  # range of the magnitude of plausible numbers other than 0

MIN_PLAUSIBLE_SHARE = 0.9
"""Least fraction of plausible numbers that the better byte order must reach."""

MAX_CHANNELS = 1000


def read(path: str | Path) -> WheelPaths:
    """Read both wheel paths from a file, or from the ".bin" beside it. Raises SurfaceFileError."""
    beside = Path(path).with_suffix(".bin")

    def read_binary() -> bytes:
        if not beside.is_file():
            raise SurfaceFileError(f"its numbers should be in {beside.name}, which is missing")
        return beside.read_bytes()

    return _parse(regular(path).read_bytes(), read_binary)


def _parse(data: bytes, read_binary: Callable[[], bytes]) -> WheelPaths:
    """Return both wheel paths from the bytes of a file; `read_binary` returns those of the other.

    Raises SurfaceFileError.
    """
    if data[:9].upper() != b"ERDFILEV2":
        raise SurfaceFileError("not an ERD file: it does not begin with ERDFILEV2")
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    end = re.search(rb"(?m)^END *$", data)
    if end is None:
        raise SurfaceFileError("damaged: the line END of the header is missing")
    lines = data[: end.start()].decode("latin-1").split("\n")
    fields = lines[1].split(",")
    if len(fields) < 6:
        raise SurfaceFileError(f"damaged: its second line has {len(fields)} numbers instead of 6")
    channels, samples, number_type = (_whole_number(fields[k]) for k in (0, 1, 4))
    if not 0 < channels <= MAX_CHANNELS:
        raise SurfaceFileError(
            f"damaged: {channels} channels, the number must be 1 to {MAX_CHANNELS}"
        )
    if number_type not in (FLOAT, TEXT):
        raise SurfaceFileError(
            f"unknown number type {number_type}; known: 1 (4-byte float) and 5 (text)"
        )
    # the first of repeated keywords counts
    keywords = {line[:8].strip().upper(): line[8:] for line in reversed(lines[2:])}
    step = number(fields[5], "the step") * metres(keywords.get("XUNITS", ""), "the step")
    if not 0.0 < step < MAX_LENGTH:
        raise SurfaceFileError(
            f"the step must be positive and below {MAX_LENGTH:g} m, got {step:g} m"
        )
    values = _text(data[end.end() :]) if number_type == TEXT else _floats(read_binary())
    stated = max(0, samples)  # a header need not state their number
    samples, rest = divmod(values.size, channels)
    if rest or not samples or samples != (stated or samples):
        raise SurfaceFileError(
            f"damaged: {values.size} numbers, but the header states {stated or 'complete'} "
            f"samples of {channels} channels"
        )
    table = values.reshape(samples, channels)
    pair = _left_and_right(channels, keywords)
    z = [checked_heights(table[:, k], scale) for k, scale in pair]
    return WheelPaths(np.array(z), step)


def _text(body: bytes) -> np.ndarray:
    words = body.decode("latin-1").replace(",", " ").split()
    if not words:
        return np.empty(0)
    return parse_number_rows(words, comments=None).ravel()


def _floats(body: bytes) -> np.ndarray:
    if len(body) % 4:
        raise SurfaceFileError(f"damaged: {len(body)} bytes are not a multiple of 4-byte floats")
    both = [np.frombuffer(body, f"{order}f4") for order in "<>"]
    shares = [_plausible_share(values) for values in both]
    if max(shares) < MIN_PLAUSIBLE_SHARE:
        raise SurfaceFileError("damaged: its numbers are implausible in either byte order")
    return both[int(np.argmax(shares))].astype(float)


def _plausible_share(values: np.ndarray) -> float:
    """Return the fraction of `values` (N,) that are 0, NaN or of a plausible magnitude."""
    size = np.abs(values[(values != 0.0) & ~np.isnan(values)])
    implausible = (size < PLAUSIBLE_RANGE[0]) | (size > PLAUSIBLE_RANGE[1])
    return 1.0 - implausible.sum() / max(1, values.size)


def _left_and_right(channels: int, keywords: Mapping[str, str]) -> list[tuple[int, float]]:
    """Return the channel index and its unit in metres, for the left and right wheel path."""
    short, long, unit = (
        [keywords.get(key, "")[k * width : (k + 1) * width].strip() for k in range(channels)]
        for key, width in (("SHORTNAM", 8), ("LONGNAME", 32), ("UNITSNAM", 8))
    )
    lengths = [k for k in range(channels) if normalise(unit[k]) in FACTORS["distance"]]
    if channels == 1:
        pair = [0, 0]
    else:
        pair = []
        for letter, word in (("l", "left"), ("r", "right")):
            pattern = re.compile(rf"{letter}\W*elev|.*\b{word}\b", re.IGNORECASE)
            matches = [k for k in lengths if pattern.match(short[k]) or pattern.match(long[k])]
            if len(matches) != 1:
                known = ", ".join(f"{name} [{u}]" for name, u in zip(short, unit, strict=True))
                raise SurfaceFileError(
                    f"{len(matches)} channels match the {word} wheel path, expected 1 among: "
                    f"{known:.200}"
                )
            pair += matches
    return [(k, metres(unit[k], f"channel {k + 1}")) for k in pair]


def _whole_number(text: str) -> int:
    value = number(text, "a number in its second line")
    if value != round(value) or not abs(value) < 1e12:
        raise SurfaceFileError(
            f"damaged: {text.strip()!r:.40} in its second line is not an integer"
        )
    return int(value)
