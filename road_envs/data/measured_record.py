"""Records of measured drives, from the tables of other data loggers.

The table is Parquet or text, with a header of column names and one row for each sample. In text,
columns are separated by comma, semicolon or tab (with the latter two a decimal comma is allowed),
and leading lines that begin with "#" are skipped:

| column | meaning |
|---|---|
| `t` | time [s] |
| `a_rf`, `a_lr`, `a_rr` | vertical accelerations, upwards, at right front, left and right rear [m/s²]; or `a_rf_g` ... in units of g |
| `v` [m/s] or `v_kmh` [km/h] | speed; may be given once for the whole drive instead |
| `s` | odometer [m]; without it the speed is integrated |
| `mode`, or `mode_front` and `mode_rear` | state of the struts (`ride`, `handling`, ...); may be given once for the whole drive instead |

Other columns are ignored. An empty cell is a lost sample.
"""  # noqa: E501

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from road_envs._extras import optional_import
from road_envs.config import ConfigError
from road_envs.data.record import SENSORS, Record
from road_envs.vehicle.suspension import decode_commands, encode_command

STANDARD_GRAVITY = 9.80665
"""Standard gravity [m/s²], the unit g of acceleration columns."""

GRAVITY_THRESHOLD = 0.5 * STANDARD_GRAVITY
"""A channel includes gravity if the magnitude of its mean exceeds this value [m/s²]."""

CLOCK_TOLERANCE = 0.01
"""Deviation of the clock, relative to the sampling interval, up to which it is not resampled."""

GAP_INTERVALS = 1.5
"""Distance of two rows, in sampling intervals, above which samples between them are lost."""

MIN_SAMPLES = 32
"""Smallest number of samples of a drive."""

MAX_LOST_SHARE = 0.2
"""Largest share of samples that may be lost."""

UNITS = {"m/s²": "", "g": "_g"}
ACCELERATIONS = tuple(f"a_{name.lower()}" for name in SENSORS)

SNIFFED_CHARACTERS = 10_000
"""Number of characters that are searched for a decimal comma."""

Columns = Mapping[str, Any]
"""Columns of a table by name, as pyarrow arrays."""


class MeasuredRecord(NamedTuple):
    """Record, and notes on assumptions and corrections."""

    record: Record
    notes: tuple[str, ...]


def read_measured_record(
    path: Path,
    wheelbase: float,
    *,
    speed_kmh: float | None = None,
    mode: str | Mapping[str, str] | None = None,
) -> MeasuredRecord:
    """Read the record of a measured drive of a vehicle of this `wheelbase` [m].

    `speed_kmh` and `mode` apply to the whole drive; each is required if the table has no such
    column, and invalid otherwise. The road extends from the position of the rear axle at the first
    sample to that of the front axle at the last. Raises ConfigError that names the column, and the
    row if there is one.
    """
    table = read_table(path)
    try:
        return _to_record(table, wheelbase, speed_kmh, mode)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def read_table(path: Path) -> Columns:
    """Read the columns of a table by lower-case name. Raises ConfigError."""
    with optional_import("a table as CSV or Parquet"):
        import pyarrow as pa
        import pyarrow.parquet as pq

    try:
        table = pq.read_table(path) if path.suffix.lower() == ".parquet" else _read_text(path)
    except (OSError, UnicodeDecodeError, pa.ArrowException) as error:
        reason = str(getattr(error, "strerror", None) or error).splitlines()[0]
        raise ConfigError(f"{path}: no readable table: {reason}") from None
    names = [name.strip().lower() for name in table.column_names]
    if duplicates := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"{path}: the column {duplicates[0]} is duplicated")
    return dict(zip(names, table.columns, strict=True))


def _read_text(path: Path) -> Any:
    with optional_import("a table as CSV or Parquet"):
        from pyarrow import csv

    text = path.read_text(encoding="utf-8-sig")
    while text.startswith("#"):
        text = text.partition("\n")[2]
    head, _, rest = text.partition("\n")
    delimiter = next((mark for mark in ";\t," if mark in head), ",")
    comma = delimiter != "," and re.search(r"\d,\d", rest[:SNIFFED_CHARACTERS]) is not None
    return csv.read_csv(
        io.BytesIO(text.encode()),
        parse_options=csv.ParseOptions(delimiter=delimiter),
        convert_options=csv.ConvertOptions(
            decimal_point="," if comma else ".", strings_can_be_null=True
        ),
    )


def _to_record(
    table: Columns,
    wheelbase: float,
    speed_kmh: float | None,
    mode: str | Mapping[str, str] | None,
) -> MeasuredRecord:
    t = _time_column(table)
    notes: list[str] = []
    a = np.array([_acceleration_column(table, name, notes) for name in ACCELERATIONS])
    v = _speed_column(table, t, speed_kmh)
    s = _numeric_column(table, "s") if "s" in table else _integrate_speed(t, v)
    bytes_ = _commands(table, t.size, mode)
    if not (np.isfinite(v).all() and np.isfinite(s).all()):
        raise ConfigError("v and s must hold a number in every row")
    if (v < 0.0).any() or (np.diff(s) < 0.0).any():
        raise ConfigError("the vehicle moves backwards: v must not be negative, nor s decrease")
    t, (*a_even, v, s), bytes_ = _resample_uniformly(t, [*a, v, s], bytes_, notes)
    a = np.array(a_even)
    if (share := float(np.isnan(a).any(axis=0).mean())) > MAX_LOST_SHARE:
        raise ConfigError(
            f"{share:.0%} of the samples are lost; at most {MAX_LOST_SHARE:.0%} may be"
        )
    s = s - s[0] + wheelbase
    stiff, high = decode_commands(bytes_)
    return MeasuredRecord(Record(t, a, v, s, stiff, high, float(s[-1])), tuple(notes))


def _time_column(table: Columns) -> np.ndarray:
    t = _numeric_column(table, "t")
    if t.size < MIN_SAMPLES:
        raise ConfigError(f"the table has {t.size} samples; at least {MIN_SAMPLES} are needed")
    if not np.isfinite(t).all():
        raise ConfigError("t must hold a number in every row")
    if (backwards := np.flatnonzero(np.diff(t) <= 0.0)).size:
        raise ConfigError(f"t must increase; it does not after row {backwards[0] + 1}")
    return t - t[0]


def _acceleration_column(table: Columns, name: str, notes: list[str]) -> np.ndarray:
    """Return one channel [m/s²] without gravity; a correction is added to `notes`."""
    given = [unit for unit, suffix in UNITS.items() if name + suffix in table]
    if len(given) != 1:
        problem = "is given twice" if given else "is missing"
        allowed = " or ".join(f"{name}{suffix} [{unit}]" for unit, suffix in UNITS.items())
        raise ConfigError(
            f"the column {name} {problem}; give {allowed} once; {_list_columns(table)}"
        )
    unit = STANDARD_GRAVITY if given[0] == "g" else 1.0
    a = _numeric_column(table, name + UNITS[given[0]]) * unit
    finite = a[np.isfinite(a)]
    if not finite.size:
        raise ConfigError(f"the column {name} holds no number")
    mean = float(finite.mean())
    if mean < -GRAVITY_THRESHOLD:
        raise ConfigError(
            f"{name} has a mean of {mean:.1f} m/s²: its axis points down; invert its sign"
        )
    if mean > GRAVITY_THRESHOLD:
        notes.append(f"{name}: its mean of {mean:.2f} m/s² is taken as gravity and subtracted")
        return a - mean
    return a


def _speed_column(table: Columns, t: np.ndarray, speed_kmh: float | None) -> np.ndarray:
    given = [name for name in ("v", "v_kmh") if name in table]
    if len(given) + (speed_kmh is not None) != 1:
        problem = "given twice" if given else "missing"
        raise ConfigError(
            f"the speed is {problem}: give one of the columns v [m/s] and v_kmh [km/h], "
            f"or one speed for the whole drive; {_list_columns(table)}"
        )
    if speed_kmh is not None:
        return np.full(t.size, speed_kmh / 3.6)
    return _numeric_column(table, given[0]) / (3.6 if given[0] == "v_kmh" else 1.0)


def _integrate_speed(t: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the distance [m] by the trapezoidal rule."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])


def _commands(table: Columns, size: int, mode: str | Mapping[str, str] | None) -> np.ndarray:
    """Return the command bytes (N,) of the strut states."""
    axles = [name for name in ("mode_front", "mode_rear") if name in table]
    columns = [name for name in ("mode", *axles) if name in table]
    if columns not in ([], ["mode"], ["mode_front", "mode_rear"]) or bool(columns) == (
        mode is not None
    ):
        problem = f"given as {', '.join(columns)}" if columns else "missing"
        also = " and for the whole drive" if columns and mode is not None else ""
        raise ConfigError(
            f"the state of the struts is {problem}{also}: give the column mode, or mode_front and "
            f"mode_rear, or one mode for the whole drive; {_list_columns(table)}"
        )
    if mode is not None:
        return np.full(size, encode_command(mode), dtype=np.uint8)
    if columns == ["mode"]:
        return _encode_pairs([(name, name) for name in _text_column(table, "mode")])
    return _encode_pairs(list(zip(*(_text_column(table, name) for name in axles), strict=True)))


def _text_column(table: Columns, name: str) -> list[str]:
    return [str(cell).strip() for cell in table[name].to_pylist()]


def _encode_pairs(pairs: list[tuple[str, str]]) -> np.ndarray:
    """Return the command bytes (N,) of states in front and at the rear. Raises ConfigError."""
    encoded = {
        (front, rear): encode_command({"front": front, "rear": rear}) for front, rear in set(pairs)
    }
    return np.array([encoded[pair] for pair in pairs], dtype=np.uint8)


def _resample_uniformly(
    t: np.ndarray, channels: list[np.ndarray], commands: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Resample all channels to a constant rate; NaN where adjacent rows are too far apart."""
    steps = np.diff(t)
    dt = float(np.median(steps))
    if np.abs(steps - dt).max() <= CLOCK_TOLERANCE * dt:
        return t, channels, commands
    even = dt * np.arange(int(t[-1] / dt + 1e-6) + 1)
    after = np.clip(np.searchsorted(t, even), 1, t.size - 1)
    nearest = after - (even - t[after - 1] < t[after] - even)
    matched = np.abs(even - t[nearest]) <= CLOCK_TOLERANCE * dt
    lost = ~matched & (steps[after - 1] > GAP_INTERVALS * dt)
    *sensed, v, s = (np.interp(even, t, x) for x in channels)
    for a, sampled in zip(sensed, channels, strict=False):
        # interpolation loses a sample whose neighbour is lost: restore it
        np.copyto(a, sampled[nearest], where=matched & np.isnan(a))
        a[lost] = np.nan
    before = np.where(matched, nearest, after - 1)
    notes.append(
        f"the clock is uneven (intervals of {1e3 * steps.min():.3g} to {1e3 * steps.max():.3g} ms)"
        f"; resampled to {1.0 / dt:.4g} Hz, {lost.mean():.1%} of the samples lost"
    )
    return even, [*sensed, v, s], commands[before]


def _numeric_column(table: Columns, name: str) -> np.ndarray:
    """Return a column as numbers, NaN for empty cells. Raises ConfigError that names the row."""
    with optional_import("a table as CSV or Parquet"):
        import pyarrow as pa

    if name not in table:
        raise ConfigError(f"the column {name} is missing; {_list_columns(table)}")
    try:
        column = table[name].cast(pa.float64())
    except pa.ArrowException:
        k, cell = next(
            (k, cell)
            for k, cell in enumerate(table[name].to_pylist(), start=1)
            if cell is not None and not _is_number(cell)
        )
        raise ConfigError(f"row {k} of {name}: {cell!r} is not a number") from None
    return np.asarray(column.to_numpy(zero_copy_only=False), dtype=float)


def _is_number(cell: object) -> bool:
    try:
        float(str(cell))
    except ValueError:
        return False
    return True


def _list_columns(table: Columns) -> str:
    return f"the table has {', '.join(table)}"
