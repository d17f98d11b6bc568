"""Reader of OpenCRG files (curved regular grids; ASAM OpenCRG 1.2, sections 6.1 to 6.4.7).

A file has a header of named blocks ("$ROAD_CRG" ... "$"), a line that starts with "$$", and the
payload: one row of channels per station u, in one of four data formats,

    LRFI, LDFI   text: 10 or 20 characters per number, 80 per record, each row on a new record
    KRBI, KDBI   big-endian float32 or float64, padded with NaN to a multiple of 80 bytes

Only the heights over (u, v) are read and scaled by the modifiers of the file; missing heights are
NaN. Heading, slope and banking of the reference line are topography rather than roughness: they are
ignored, with a note if they are not 0.

The length of the payload is checked against the header before anything is allocated, so that a
damaged header cannot exhaust memory.
"""

import math
import re
from dataclasses import dataclass

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.roads.surface import MAX_HEIGHT

RECORD = 80  # characters or bytes of one record
WIDTHS = {"LRFI": 10, "LDFI": 20, "KRBI": 4, "KDBI": 8}  # characters or bytes of one number
MAX_LENGTH = 1e7  # largest length [m] of an intact file
DEFAULT_INCREMENT = 0.01  # increment of u and v [m] if the header states none


class SurfaceFileError(ConfigError):
    """A surface file cannot be used."""


def require(condition: object, sentence: str) -> None:
    """Raise SurfaceFileError with the `sentence` unless the `condition` holds."""
    if not condition:
        raise SurfaceFileError(sentence)


@dataclass(frozen=True, eq=False)
class CurvedGrid:
    """Heights `z` (nu, nv) [m] at u = `u_start` + k `du` [m] and `v` (nv,) [m]; NaN if missing.

    u runs along the reference line; v is positive to the left and increasing.
    """

    z: np.ndarray
    u_start: float
    du: float
    v: np.ndarray
    notes: tuple[str, ...] = ()


def parse(data: bytes) -> CurvedGrid:
    """Return the grid in the bytes of a file. Raises SurfaceFileError."""
    blocks, payload = _split(data)
    if "ROAD_CRG_FILE" in blocks:
        raise SurfaceFileError("it only refers to another file ($ROAD_CRG_FILE); use that file")
    for name in ("ROAD_CRG", "KD_DEFINITION"):
        require(name in blocks, f"not an OpenCRG file: no ${name} block")
    road = _virtual_u(blocks["KD_DEFINITION"]) | _numbers(blocks["ROAD_CRG"], "ROAD_CRG")
    scale = _numbers(blocks.get("ROAD_CRG_MODS", []), "ROAD_CRG_MODS")
    data_format, channels = _channels(blocks["KD_DEFINITION"])
    sections, v = _sections(channels, road)
    du = _positive(road, "reference_line_increment", DEFAULT_INCREMENT)
    read = _binary if data_format.startswith("K") else _text
    table = read(payload, WIDTHS[data_format], len(channels), _rows(road, du))
    require(len(table) >= 2, f"at least 2 rows of data are required, got {len(table)}")
    return CurvedGrid(
        z=checked_heights(table[:, sections], scale.get("scale_z_grid", 1.0)),
        u_start=road.get("reference_line_start_u", 0.0),
        du=du * _positive(scale, "scale_length", 1.0),
        v=v * _positive(scale, "scale_width", 1.0),
        notes=_notes(table, channels, road),
    )


def _split(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Return the lines of the header's blocks by upper-case name, and the payload."""
    blocks: dict[str, list[str]] = {}
    block, position = None, 0
    while (end := data.find(b"\n", position)) >= 0:
        line = data[position:end].rstrip(b"\r")[:72].decode("latin-1")
        position = end + 1
        if line.startswith("$$") and block != "CT":
            return blocks, data[position:]
        if line.startswith("$"):
            block = re.split(r"[\s!]", line[1:], maxsplit=1)[0].upper() or None
            require(block not in blocks or block == "CT", f"block ${block} appears twice")
            if block:
                blocks.setdefault(block, [])
        elif block and not line.startswith("*"):
            blocks[block].append(line.split("!")[0].strip())
    raise SurfaceFileError("not an OpenCRG file: the line of $ that ends its header is missing")


def _numbers(lines: list[str], block: str) -> dict[str, float]:
    """Return the settings of a block that this reader uses, by lower-case key."""
    used = re.compile(
        r"reference_line_(start_[usb]|end_[usb]|increment)|long_section_v_\w+|scale_.*"
    )
    values: dict[str, float] = {}
    for line in lines:
        name, _, text = line.partition("=")
        if used.fullmatch(key := name.strip().lower()):
            require(key not in values, f"{key} appears twice in ${block}")
            values[key] = number(text, key)
    return values


def _virtual_u(lines: list[str]) -> dict[str, float]:
    """Return start and increment of u from the data definition, where they are rounded."""
    for line in lines:
        name, *rest = (part.strip() for part in line.split(","))
        if name.lower() == "u:reference line u" and len(rest) == 3:
            keys = ("reference_line_start_u", "reference_line_increment")
            return {key: number(text, name) for key, text in zip(keys, rest[1:], strict=True)}
    return {}


def number(text: str, what: str) -> float:
    """Return the finite number in a `text` that states `what`. Raises SurfaceFileError."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    require(math.isfinite(value), f"{what} = {text.strip()!r:.40} is not a number")
    return value


def _channels(lines: list[str]) -> tuple[str, list[tuple[str, str]]]:
    """Return the data format of the payload and the (name, unit) of its channels."""
    data_format, channels = "KRBI", []
    for line in lines:
        if line.startswith("#:"):
            data_format = line[2:].strip().upper()
        elif line.upper().startswith("D:"):
            name, _, unit = line[2:].partition(",")
            channels.append((" ".join(name.lower().split()), unit.split(",")[0].strip().lower()))
    if data_format not in WIDTHS:
        raise SurfaceFileError(f"unknown data format {data_format!r}; known: {', '.join(WIDTHS)}")
    require(channels, "$KD_DEFINITION defines no channel")
    return data_format, channels


def _sections(
    channels: list[tuple[str, str]], road: dict[str, float]
) -> tuple[list[int], np.ndarray]:
    """Return the columns of the long sections from right to left, and their v [m]."""
    named = [(k, name, unit) for k, (name, unit) in enumerate(channels) if "long section" in name]
    require(len(named) >= 2, f"at least 2 long sections are required, got {len(named)}")
    for _, name, unit in named:
        require(unit == "m", f"{name!r} is in {unit!r}, the unit must be m")
    by_position = [re.fullmatch(r"long section at v ?= ?(\S+)", name) for _, name, _ in named]
    by_number = [re.fullmatch(r"long section (\d+)", name) for _, name, _ in named]
    if all(by_position):
        v = np.array([number(m[1], m[0]) for m in by_position if m])
    elif all(by_number):
        numbers = np.array([float(m[1]) for m in by_number if m])
        if sorted(numbers) != list(range(1, len(named) + 1)):
            raise SurfaceFileError(f"long sections are not numbered 1 to {len(named)}")
        first, increment = _lateral_grid(road, len(named))
        v = first + increment * (numbers - 1.0)
    else:
        raise SurfaceFileError("long sections are neither all numbered nor all given 'at v = '")
    order = np.argsort(v)
    if not (np.abs(v) < MAX_LENGTH).all():
        raise SurfaceFileError(
            f"v of long sections must be below {MAX_LENGTH:g} m, got {np.abs(v).max():g} m"
        )
    require((np.diff(v[order]) > 0.0).all(), "two long sections have the same v")
    return [named[k][0] for k in order], v[order]


def _lateral_grid(road: dict[str, float], sections: int) -> tuple[float, float]:
    """Return v of the rightmost numbered section and the spacing of the sections [m]."""
    right, left, step = (road.get(f"long_section_v_{k}") for k in ("right", "left", "increment"))
    if step is None and right is not None and left is not None:
        step = (left - right) / (sections - 1)
    step = DEFAULT_INCREMENT if step is None else step
    width = step * (sections - 1)
    if right is None:
        right = -0.5 * width if left is None else left - width
    require(step > 0.0, f"long_section_v_increment must be positive, got {step:g}")
    if left is not None and abs(right + width - left) > 0.01 * step:
        raise SurfaceFileError(
            f"{sections} sections from v = {right:g} m, {step:g} m apart, do not end at {left:g} m"
        )
    return right, step


def _positive(values: dict[str, float], key: str, default: float) -> float:
    x = values.get(key, default)
    require(0.0 < x < MAX_LENGTH, f"{key} must be positive and below {MAX_LENGTH:g}, got {x:g}")
    return x


def _rows(road: dict[str, float], du: float) -> int | None:
    """Return the number of rows stated by the header, or None if it states no end of u."""
    if "reference_line_end_u" not in road:
        return None
    length = road["reference_line_end_u"] - road.get("reference_line_start_u", 0.0)
    steps = length / du
    whole = 0.5 < steps < 1e12 and abs(steps - round(steps)) < 0.1
    require(whole, f"a reference line of {length:g} m is not a whole number of steps of {du} m")
    return round(steps) + 1


def _binary(payload: bytes, width: int, columns: int, rows: int | None) -> np.ndarray:
    whole = len(payload) % RECORD == 0
    if rows is None and not whole:
        raise SurfaceFileError(f"damaged: {len(payload)} bytes of data, not a multiple of {RECORD}")
    expected = (rows or 0) * columns * width
    if len(payload) < expected or not (whole or len(payload) == expected):
        padded = -(-expected // RECORD) * RECORD
        raise SurfaceFileError(
            f"damaged: {len(payload)} bytes of data where the header requires {padded} "
            f"({rows} rows of {columns} channels); was it transferred as text, or truncated?"
        )
    values = np.frombuffer(payload, f">f{width}", len(payload) // width)
    if rows is None:
        filled = np.flatnonzero(~np.isnan(values))
        rows = -(-int(filled[-1] + 1) // columns) if filled.size else 0
        rows = min(rows, values.size // columns)
    if not np.isnan(values[rows * columns :]).all():
        raise SurfaceFileError(f"damaged: more data than {rows} rows of {columns} channels")
    with np.errstate(invalid="ignore"):  # a signalling NaN would warn
        return values[: rows * columns].reshape(rows, columns).astype(float)


def _text(payload: bytes, width: int, columns: int, rows: int | None) -> np.ndarray:
    payload = payload.rstrip()
    per_line = RECORD // width
    counts = [min(per_line, columns - k) for k in range(0, columns, per_line)]
    n_rows, rest = divmod(payload.count(b"\n") + 1, len(counts))
    if rest or n_rows != (rows or n_rows):
        expected = f"{rows * len(counts)}" if rows else f"a multiple of {len(counts)}"
        raise SurfaceFileError(
            f"damaged: {n_rows * len(counts) + rest} lines of data, the header requires {expected}"
        )
    if len(payload) < n_rows * width * (columns - len(counts)):
        raise SurfaceFileError(f"damaged: too short for {n_rows} rows of {columns} values")
    lines = payload.split(b"\n")
    return np.hstack([_fields(lines[k :: len(counts)], n, width) for k, n in enumerate(counts)])


def _fields(lines: list[bytes], count: int, width: int) -> np.ndarray:
    """Return the `count` numbers on each line; a leading asterisk means NaN."""
    for row, line in enumerate(lines, start=1):
        if len(line.rstrip()) <= (count - 1) * width:
            raise SurfaceFileError(f"damaged: row {row} of the data is too short: {line!r}")
    block = b"".join(line.rstrip()[: count * width].ljust(count * width) for line in lines)
    fields = np.char.strip(np.frombuffer(block, f"S{width}").reshape(len(lines), count))
    fields[np.char.startswith(fields, b"*")] = b"nan"
    try:
        return fields.astype(float)
    except ValueError as error:
        raise SurfaceFileError(f"damaged data: {error}") from None


def checked_heights(z: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Return `scale` times `z` (any shape) [m]; NaN is allowed.

    Raises SurfaceFileError if a height is not below MAX_HEIGHT.
    """
    with np.errstate(all="ignore"):
        largest = np.nan_to_num(np.abs(scale * z), posinf=np.inf).max()
    require(largest < MAX_HEIGHT, f"damaged: a height of {largest:g} m")
    return scale * z


def _notes(
    table: np.ndarray, channels: list[tuple[str, str]], road: dict[str, float]
) -> tuple[str, ...]:
    """Return a note on ignored properties of the reference line, if any is not 0."""
    column = {name: np.nan_to_num(table[1:, k]) for k, (name, _) in enumerate(channels)}
    none = np.zeros(1)
    ignored = {
        "heading": np.ptp(column.get("reference line phi", none)),
        "slope": column.get("reference line slope", road.get("reference_line_start_s", none)),
        "banking": column.get("reference line banking", road.get("reference_line_start_b", none)),
    }
    names = [name for name, values in ignored.items() if np.any(values)]
    return (f"{', '.join(names)} of the reference line ignored",) if names else ()
