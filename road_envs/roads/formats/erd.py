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
    require,
)
from road_envs.roads.formats.table import WheelPaths, metres, parse_number_rows

FLOAT, TEXT = 1, 5  # number types that can be read


def read(path: str | Path) -> WheelPaths:
    """Read both wheel paths from a file, or from the ".bin" beside it. Raises SurfaceFileError."""
    beside = Path(path).with_suffix(".bin")

    def read_binary() -> bytes:
        require(beside.is_file(), f"its numbers should be in {beside.name}, which is missing")
        return beside.read_bytes()

    return _parse(regular(path).read_bytes(), read_binary)


def _parse(data: bytes, read_binary: Callable[[], bytes]) -> WheelPaths:
    """Return both wheel paths from the bytes of a file; `read_binary` returns the other's."""
    require(data[:9].upper() == b"ERDFILEV2", "not an ERD file: it does not begin with ERDFILEV2")
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    end = re.search(rb"(?m)^END *$", data)
    if end is None:
        raise SurfaceFileError("damaged: the line END of the header is missing")
    lines = data[: end.start()].decode("latin-1").split("\n")
    fields = lines[1].split(",")
    require(len(fields) >= 6, f"damaged: its second line has {len(fields)} numbers instead of 6")
    channels, samples, number_type = (_whole_number(fields[k]) for k in (0, 1, 4))
    require(0 < channels <= 1000, f"damaged: {channels} channels, the number must be 1 to 1000")
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
    table, pair = values.reshape(samples, channels), _left_and_right(channels, keywords)
    return WheelPaths(np.array([checked_heights(table[:, k], scale) for k, scale in pair]), step)


def _text(body: bytes) -> np.ndarray:
    words = body.decode("latin-1").replace(",", " ").split()
    return parse_number_rows(words, comments=None).ravel() if words else np.empty(0)


def _floats(body: bytes) -> np.ndarray:
    require(len(body) % 4 == 0, f"damaged: {len(body)} bytes are not a multiple of 4-byte floats")
    both = [np.frombuffer(body, f"{order}f4") for order in "<>"]
    shares = [_plausible_share(values) for values in both]
    require(max(shares) >= 0.9, "damaged: its numbers are implausible in either byte order")
    return both[int(np.argmax(shares))].astype(float)


def _plausible_share(values: np.ndarray) -> float:
    """Return the fraction of `values` (N,) that are 0, NaN or of a plausible magnitude."""
    size = np.abs(values[(values != 0.0) & ~np.isnan(values)])
    return 1.0 - ((size < 1e-9) | (size > 1e9)).sum() / max(1, values.size)


def _left_and_right(channels: int, keywords: Mapping[str, str]) -> list[tuple[int, float]]:
    """Return the channel index and its unit in metres, for the left and right wheel path."""
    short, long, unit = (
        [keywords.get(key, "")[k * width : (k + 1) * width].strip() for k in range(channels)]
        for key, width in (("SHORTNAM", 8), ("LONGNAME", 32), ("UNITSNAM", 8))
    )
    lengths = [k for k in range(channels) if normalise(unit[k]) in FACTORS["distance"]]
    pair = []
    for letter, word in (("l", "left"), ("r", "right")):
        pattern = re.compile(rf"{letter}\W*elev|.*\b{word}\b", re.IGNORECASE)
        matches = [k for k in lengths if pattern.match(short[k]) or pattern.match(long[k])]
        matches = matches if channels > 1 else [0]
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
    whole = value == round(value) and abs(value) < 1e12
    require(whole, f"damaged: {text.strip()!r:.40} in its second line is not an integer")
    return int(value)
