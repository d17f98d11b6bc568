"""Messages between host and guest, over pipes: a JSON object and arrays, without pickle.

    4 bytes    size of the JSON text, big endian
    JSON       an object
    arrays     raw numbers in C order, one array after the other

The host sends `arrays`, their types and shapes, in the object. A reply has only float64 arrays of
a shape that the host knows, so it never takes a size from a guest. What a guest sends may be
anything: `parse_head`, `text`, `number` and `settings` raise EntryError for all that is not
expected.
"""

import json
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from leaderboard.entries.entry import EntryError
from road_envs.records.accelerometers import from_plain, to_plain
from road_envs.records.record import LowPass, Profile, Record

HEAD_SIZE = struct.Struct(">I")
MAX_HEAD = 1 << 16  # largest size [bytes] of the JSON text of a reply
MAX_TEXT = 300  # largest number of characters of a text of a guest; the rest is cut off
MAX_SETTINGS, MAX_DEPTH = 4000, 5
"""Largest size [characters] of the settings of an estimator as JSON text, and depth of a reply."""

LARGEST_NUMBER = 1e100  # largest absolute value of a number in the settings of an estimator

Reply = tuple[dict[str, Any], Sequence[np.ndarray]]
"""Object and arrays of a reply."""

Handler = Callable[[dict[str, Any], list[np.ndarray]], Reply]
"""Function of a request and its arrays, in a guest; what it raises is replied as a failure."""

RECORD_ARRAYS = tuple(
    f.name for f in fields(Record) if f.name not in ("length", "sensors", "low_pass")
)


def encode(
    head: Mapping[str, Any], arrays: Sequence[np.ndarray] = (), limit: float = math.inf
) -> bytes:
    """Return a message. Raises ValueError if its JSON text has more than `limit` [bytes]."""
    solid = [np.ascontiguousarray(array) for array in arrays]
    shapes = {"arrays": [[a.dtype.str, *a.shape] for a in solid]} if solid else {}
    text = json.dumps({**head, **shapes}).encode()
    if len(text) > limit:
        raise ValueError(f"a message of {len(text)} bytes, the limit is {limit}")
    return b"".join([HEAD_SIZE.pack(len(text)), text, *(a.tobytes() for a in solid)])


def decode_arrays(head: Mapping[str, Any], read: Any) -> list[np.ndarray]:
    """Return the arrays of a message of the host, in the guest; `read(n)` returns n bytes."""
    arrays = []
    for kind, *shape in head.get("arrays", ()):
        dtype = np.dtype(kind)
        data = bytearray(read(dtype.itemsize * math.prod(shape)))
        arrays.append(np.frombuffer(data, dtype).reshape(shape))
    return arrays


def encode_drives(
    do: str, drives: Sequence[tuple[Record, Profile | None]], **more: object
) -> bytes:
    """Return the request `do` with drives, with or without their road, of one layout of sensors.

    The object has `more`. A guest believes its host: unlike a reply, a request may have any size.
    """
    arrays: list[np.ndarray] = []
    for record, road in drives:
        arrays += [getattr(record, name) for name in RECORD_ARRAYS]
        arrays += [] if road is None else [road.s, road.z]
    head: dict[str, Any] = {"do": do, "lengths": [record.length for record, _ in drives], **more}
    head["roads"] = [road is not None for _, road in drives]
    if drives:
        first = drives[0][0]
        head |= {"sensors": to_plain(first.sensors), "low_pass": first.low_pass}
    return encode(head, arrays)


def decode_drives(
    head: Mapping[str, Any], arrays: Sequence[np.ndarray]
) -> list[tuple[Record, Profile | None]]:
    """Return the drives of `encode_drives`, in the guest."""
    left, drives = iter(arrays), []
    for length, has_road in zip(head["lengths"], head["roads"], strict=True):
        signals = {name: next(left) for name in RECORD_ARRAYS}
        layout = from_plain(head["sensors"], "the record of a request")
        low_pass = LowPass(*head["low_pass"]) if head["low_pass"] else None
        record = Record(**signals, length=length, sensors=layout, low_pass=low_pass)
        drives.append((record, Profile(next(left), next(left)) if has_road else None))
    return drives


def parse_head(text: bytes) -> dict[str, Any]:
    """Return the object of a reply. Raises EntryError."""

    def reject(word: str) -> None:
        raise ValueError(f"{word} is no JSON number")

    try:
        head = json.loads(text, parse_constant=reject)
    except (ValueError, RecursionError, MemoryError):
        raise EntryError("its reply is invalid: not JSON") from None
    if not isinstance(head, dict):
        raise EntryError("its reply is invalid: not a JSON object")
    if _is_deeper(head, MAX_DEPTH):
        raise EntryError(f"its reply is invalid: nested more than {MAX_DEPTH} deep")
    return head


def text(value: object) -> str:
    """Return a text of a guest in one line of printable characters, at most MAX_TEXT."""
    if not isinstance(value, str):
        return "no message"
    words = "".join(c if c.isprintable() else " " for c in value[: 4 * MAX_TEXT]).split()
    line = " ".join(words) or "no message"
    return line if len(line) <= MAX_TEXT else line[:MAX_TEXT] + " ..."


def number(head: Mapping[str, Any], name: str, largest: float) -> float:
    """Return a number of a reply between 0 and `largest`. Raises EntryError."""
    value = head.get(name)
    # compared before it is converted: an integer may be too large for a float
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= largest:
        raise EntryError(f"its reply is invalid: {name} must be a number from 0 to {largest:g}")
    return float(value)


def settings(value: object) -> dict[str, Any]:
    """Return the settings that an estimator reports about itself. Raises EntryError."""
    if not isinstance(value, dict) or not all(key.isidentifier() for key in value):
        raise EntryError("its settings must be a JSON object with names as keys")
    if len(json.dumps(value)) > MAX_SETTINGS:
        raise EntryError(f"its settings are longer than {MAX_SETTINGS} characters")
    _check_settings(value)
    return value


def _check_settings(value: Any) -> None:
    if isinstance(value, str) and value not in ("", text(value)):
        raise EntryError(f"a text in its settings is not one printable line of up to {MAX_TEXT}")
    if isinstance(value, int | float) and not abs(value) <= LARGEST_NUMBER:
        raise EntryError(f"a number in its settings is beyond {LARGEST_NUMBER:g}")
    if isinstance(value, list | dict):
        for item in [*value, *value.values()] if isinstance(value, dict) else value:
            _check_settings(item)


def _is_deeper(value: Any, depth: int) -> bool:
    """Return whether lists and objects are nested more than `depth` deep."""
    if not isinstance(value, dict | list):
        return False
    items = value.values() if isinstance(value, dict) else value
    return depth == 0 or any(_is_deeper(item, depth - 1) for item in items)
