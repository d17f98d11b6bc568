"""Reader of OpenCRG files (curved regular grids; ASAM OpenCRG 1.2, sections 6.1 to 6.4.7).

A file is a header of named blocks ("$ROAD_CRG" ... "$"), a line that starts with "$$", and the
data: one row of channels per station u, in one of four formats,

    LRFI, LDFI   text: 10 or 20 characters a number, 80 a record, a row begins a new record
    KRBI, KDBI   big-endian float32 or float64, filled up with NaN to a multiple of 80 bytes

Only heights over (u, v) are read, scaled as the file's modifiers say; a missing height stays NaN.
Heading, slope and banking of the reference line are the lay of the land rather than its
roughness: they are left out, and a note says so where they matter.

Whatever is inconsistent raises SurfaceFileError. Nothing is allocated before the payload has been
found to be as long as the header demands.
"""

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from road_envs.config import ConfigError

RECORD = 80
WIDTHS = {"LRFI": 10, "LDFI": 20, "KRBI": 4, "KDBI": 8}
"""Characters or bytes of one number."""
MAX_HEIGHT = 1e4
"""Heights [m] beyond this are no road of this planet but a damaged file."""
MAX_LENGTH = 1e7
"""Likewise lengths [m]."""
DEFAULT_INCREMENT = 0.01


class SurfaceFileError(ConfigError):
    """A surface file that cannot be used, and why."""


@dataclass(frozen=True, eq=False)
class CurvedGrid:
    """Heights `z` (nu, nv) [m], NaN where unknown, at u = `u_start` + k `du` [m] and `v` (nv,) [m].

    u runs along the reference line, v is positive to the left and increases.
    """

    z: np.ndarray
    u_start: float
    du: float
    v: np.ndarray
    notes: tuple[str, ...] = ()


def read_crg(path: str | Path) -> CurvedGrid:
    """The grid in a file. Raises SurfaceFileError naming file and reason."""
    with error_context(path):
        return parse(read_bytes(path))


def read_bytes(path: str | Path) -> bytes:
    """The bytes of a regular file."""
    if not Path(path).is_file():
        raise SurfaceFileError("no such file")
    return Path(path).read_bytes()


@contextmanager
def error_context(path: str | Path) -> Iterator[None]:
    """Puts the name of the file before what goes wrong with it."""
    try:
        yield
    except OSError as error:
        raise SurfaceFileError(f"{path}: {error.strerror}") from None
    except SurfaceFileError as error:
        raise SurfaceFileError(f"{path}: {error}") from None


def parse(data: bytes) -> CurvedGrid:
    """The grid in the bytes of a file."""
    blocks, payload = _split(data)
    if "ROAD_CRG_FILE" in blocks:
        raise SurfaceFileError("it only refers to another file ($ROAD_CRG_FILE): give that one")
    for name in ("ROAD_CRG", "KD_DEFINITION"):
        if name not in blocks:
            raise SurfaceFileError(f"not an OpenCRG file: no ${name} block")
    road = _virtual_u(blocks["KD_DEFINITION"]) | _numbers(blocks["ROAD_CRG"], "ROAD_CRG")
    scale = _numbers(blocks.get("ROAD_CRG_MODS", []), "ROAD_CRG_MODS")
    data_format, channels = _channels(blocks["KD_DEFINITION"])
    sections, v = _sections(channels, road)
    table = _table(payload, data_format, len(channels), _rows(road))
    z = checked_heights(table[:, sections], scale.get("scale_z_grid", 1.0))
    return CurvedGrid(
        z=z,
        u_start=road.get("reference_line_start_u", 0.0),
        du=_increment(road) * _positive(scale, "scale_length", 1.0),
        v=v * _positive(scale, "scale_width", 1.0),
        notes=_notes(table, channels, road),
    )


def _split(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Blocks of the header, by upper-case name, and the payload."""
    blocks: dict[str, list[str]] = {}
    block, at = None, 0
    while at < len(data):
        end = data.find(b"\n", at)
        if end < 0:
            break
        line = data[at:end].rstrip(b"\r")[:72].decode("latin-1")
        at = end + 1
        if line.startswith("$$") and block != "CT":
            return blocks, data[at:]
        if line.startswith("$"):
            block = re.split(r"[\s!]", line[1:], maxsplit=1)[0].upper() or None
            if block in blocks and block != "CT":
                raise SurfaceFileError(f"block ${block} appears twice")
            if block:
                blocks.setdefault(block, [])
        elif block and not line.startswith("*"):
            blocks[block].append(line.split("!")[0].strip())
    raise SurfaceFileError("not an OpenCRG file: the line of $ that ends its header is missing")


def _numbers(lines: list[str], block: str) -> dict[str, float]:
    """The settings of a block that are read here, by lower-case key."""
    wanted = re.compile(
        r"reference_line_(start_[usb]|end_[usb]|increment)|long_section_v_\w+|scale_.*"
    )
    values: dict[str, float] = {}
    for line in lines:
        key, _, text = line.partition("=")
        key = key.strip().lower()
        if not wanted.fullmatch(key):
            continue
        if key in values:
            raise SurfaceFileError(f"{key} appears twice in ${block}")
        values[key] = _number(text, key)
    return values


def _virtual_u(lines: list[str]) -> dict[str, float]:
    """Start and increment of u as the data definition has them, rounded for viewing."""
    for line in lines:
        name, *rest = (part.strip() for part in line.split(","))
        if name.lower() == "u:reference line u" and len(rest) == 3:
            keys = ("reference_line_start_u", "reference_line_increment")
            return {key: _number(text, name) for key, text in zip(keys, rest[1:], strict=True)}
    return {}


def _number(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SurfaceFileError(f"{what} = {text.strip()!r} is not a number")
    return value


def _channels(lines: list[str]) -> tuple[str, list[tuple[str, str]]]:
    """Format of the payload, and (name, unit) of each of its channels."""
    data_format, channels = "KRBI", []
    for line in lines:
        if line.startswith("#:"):
            data_format = line[2:].strip().upper()
        elif line.upper().startswith("D:"):
            name, _, unit = line[2:].partition(",")
            channels.append((" ".join(name.lower().split()), unit.split(",")[0].strip().lower()))
    if data_format not in WIDTHS:
        raise SurfaceFileError(f"unknown data format {data_format!r}; known: {', '.join(WIDTHS)}")
    if not channels:
        raise SurfaceFileError("$KD_DEFINITION defines no channel")
    return data_format, channels


def _sections(
    channels: list[tuple[str, str]], road: dict[str, float]
) -> tuple[list[int], np.ndarray]:
    """Columns of the long sections, from right to left, and their v [m]."""
    found = [(k, name, unit) for k, (name, unit) in enumerate(channels) if "long section" in name]
    if len(found) < 2:
        raise SurfaceFileError(f"at least 2 long sections are wanted, got {len(found)}")
    for _, name, unit in found:
        if unit != "m":
            raise SurfaceFileError(f"{name!r} is in {unit!r}, not in m")
    by_place = [re.fullmatch(r"long section at v ?= ?(\S+)", name) for _, name, _ in found]
    by_number = [re.fullmatch(r"long section (\d+)", name) for _, name, _ in found]
    if all(by_place):
        v = np.array([_number(m[1], m[0]) for m in by_place if m])
    elif all(by_number):
        numbers = np.array([float(m[1]) for m in by_number if m])
        if sorted(numbers) != list(range(1, len(found) + 1)):
            raise SurfaceFileError(f"long sections are not numbered 1 to {len(found)}")
        first, increment = _lateral_grid(road, len(found))
        v = first + increment * (numbers - 1.0)
    else:
        raise SurfaceFileError("long sections are neither all numbered nor all placed 'at v = '")
    order = np.argsort(v)
    if not (np.abs(v) < MAX_LENGTH).all():
        raise SurfaceFileError(f"a long section stands at v = {np.abs(v).max():g} m")
    if not (np.diff(v[order]) > 0.0).all():
        raise SurfaceFileError("two long sections stand at the same v")
    return [found[k][0] for k in order], v[order]


def _lateral_grid(road: dict[str, float], sections: int) -> tuple[float, float]:
    """Place v of the rightmost numbered section and distance of two sections [m]."""
    right, left, step = (road.get(f"long_section_v_{k}") for k in ("right", "left", "increment"))
    if step is None and right is not None and left is not None:
        step = (left - right) / (sections - 1)
    step = DEFAULT_INCREMENT if step is None else step
    width = step * (sections - 1)
    if right is None:
        right = -0.5 * width if left is None else left - width
    if not step > 0.0:
        raise SurfaceFileError(f"long_section_v_increment must be positive, got {step:g}")
    if left is not None and abs(right + width - left) > 0.01 * step:
        raise SurfaceFileError(
            f"{sections} sections from v = {right:g} m, {step:g} m apart, do not end at {left:g} m"
        )
    return right, step


def _increment(road: dict[str, float]) -> float:
    return _positive(road, "reference_line_increment", DEFAULT_INCREMENT)


def _positive(values: dict[str, float], key: str, default: float) -> float:
    if not 0.0 < values.get(key, default) < MAX_LENGTH:
        raise SurfaceFileError(f"{key} must be positive and sensible, got {values[key]:g}")
    return values.get(key, default)


def _rows(road: dict[str, float]) -> int | None:
    """Rows that the header announces, if it says where the reference line ends."""
    if "reference_line_end_u" not in road:
        return None
    length = road["reference_line_end_u"] - road.get("reference_line_start_u", 0.0)
    steps = length / _increment(road)
    if not (0.5 < steps < 1e12 and abs(steps - round(steps)) < 0.1):
        raise SurfaceFileError(
            f"a reference line of {length:g} m has no whole number of steps of {_increment(road)} m"
        )
    return round(steps) + 1


def _table(payload: bytes, data_format: str, columns: int, rows: int | None) -> np.ndarray:
    """All channels (nu, columns)."""
    read = _binary if data_format.startswith("K") else _text
    table = read(payload, WIDTHS[data_format], columns, rows)
    if len(table) < 2:
        raise SurfaceFileError(f"at least 2 rows of data are wanted, got {len(table)}")
    return table


def _binary(payload: bytes, width: int, columns: int, rows: int | None) -> np.ndarray:
    whole = len(payload) % RECORD == 0
    if rows is None and not whole:
        raise SurfaceFileError(f"damaged: {len(payload)} bytes of data, no multiple of {RECORD}")
    wanted = (rows or 0) * columns * width
    if len(payload) < wanted or not (whole or len(payload) == wanted):
        padded = -(-wanted // RECORD) * RECORD
        raise SurfaceFileError(
            f"damaged: {len(payload)} bytes of data where the header asks for {padded} "
            f"({rows} rows of {columns} channels); was it transferred as text, or cut off?"
        )
    values = np.frombuffer(payload, f">f{width}", len(payload) // width)
    if rows is None:
        filled = np.flatnonzero(~np.isnan(values))
        rows = -(-int(filled[-1] + 1) // columns) if filled.size else 0
        rows = min(rows, values.size // columns)
    if not np.isnan(values[rows * columns :]).all():
        raise SurfaceFileError(f"damaged: more data than {rows} rows of {columns} channels")
    with np.errstate(invalid="ignore"):  # signalling NaN
        return values[: rows * columns].reshape(rows, columns).astype(float)


def _text(payload: bytes, width: int, columns: int, rows: int | None) -> np.ndarray:
    payload = payload.rstrip()
    per_line = RECORD // width
    counts = [min(per_line, columns - k) for k in range(0, columns, per_line)]
    given, rest = divmod(payload.count(b"\n") + 1, len(counts))
    if rest or given != (rows or given):
        wanted = f"{rows * len(counts)}" if rows else f"a multiple of {len(counts)}"
        raise SurfaceFileError(
            f"damaged: {given * len(counts) + rest} lines of data, the header asks for {wanted}"
        )
    if len(payload) < given * width * (columns - len(counts)):
        raise SurfaceFileError(f"damaged: too short for {given} rows of {columns} values")
    lines = payload.split(b"\n")
    return np.hstack([_fields(lines[k :: len(counts)], n, width) for k, n in enumerate(counts)])


def _fields(lines: list[bytes], count: int, width: int) -> np.ndarray:
    """The `count` numbers that stand on each line; those with a leading asterisk are NaN."""
    for row, line in enumerate(lines, start=1):
        if len(line.rstrip()) <= (count - 1) * width:
            raise SurfaceFileError(f"damaged: row {row} of the data is too short: {line!r}")
    size = count * width
    block = b"".join(line.rstrip()[:size].ljust(size) for line in lines)
    fields = np.char.strip(np.frombuffer(block, f"S{width}").reshape(len(lines), count))
    fields[np.char.startswith(fields, b"*")] = b"nan"
    try:
        return fields.astype(float)
    except ValueError as error:
        raise SurfaceFileError(f"damaged data: {error}") from None


def checked_heights(z: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """`scale` times `z` (any shape) [m], if those are heights of a road; NaN may be among them."""
    with np.errstate(all="ignore"):
        worst = np.nan_to_num(np.abs(scale * z), posinf=np.inf).max()
    if not worst < MAX_HEIGHT:
        raise SurfaceFileError(f"damaged: a height of {worst:g} m")
    return scale * z


def _notes(
    table: np.ndarray, channels: list[tuple[str, str]], road: dict[str, float]
) -> tuple[str, ...]:
    """What of the reference line is left out."""
    column = {name: np.nan_to_num(table[1:, k]) for k, (name, _) in enumerate(channels)}
    none = np.zeros(1)
    left = {
        "heading": np.ptp(column.get("reference line phi", none)),
        "slope": column.get("reference line slope", road.get("reference_line_start_s", none)),
        "banking": column.get("reference line banking", road.get("reference_line_start_b", none)),
    }
    names = [name for name, values in left.items() if np.any(values)]
    return (f"{', '.join(names)} of the reference line left out",) if names else ()
