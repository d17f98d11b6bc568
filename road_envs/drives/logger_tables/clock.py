"""Clock of a drive: time stamps as seconds, and channels at a constant rate where that is needed.

A jittering clock is kept: a model predicts each sample at its own time, while samples of 100 Hz
that a spline has moved to an even clock err by more than the noise of the sensors.
"""

from typing import Any, NamedTuple

import numpy as np
import scipy

from road_envs.core.config import ConfigError, shown
from road_envs.drives.logger_tables.channels import Channels, TableFindings
from road_envs.drives.logger_tables.table import numeric_values, to_si
from road_envs.records import units
from road_envs.records.record import F_C

CLOCK_TOLERANCE = 0.01  # deviation of a clock, in intervals, up to which it is not resampled

REGULAR_REACH, JITTER_REACH = 0.75, 1.25
"""Greatest distance of an instant to the nearest sample, in sampling intervals, at which the
channel is interpolated: of a clock with missing rows, and of one that jitters."""

JITTERING = 0.02  # median deviation of the steps of a jittering clock, in sampling intervals
MAX_LOST_SHARE = 0.2  # largest share of samples that may be lost
MIN_SAMPLES = 32  # smallest number of samples of a drive
SHORTEST_STEP = 1e-12  # smallest increase of a clock [s]; rates of change over less would overflow

CLOSEST_STEP = 0.25
"""Shortest step, in sampling intervals, of times that are believed: those of samples which a device
hands over in bunches are not when they were measured."""

FS_MIN, FS_USABLE, FS_UPSAMPLED = 20.0, 2.4 * F_C, 4.0 * F_C
"""Lowest sample rate [Hz] that is read, lowest of estimators, that of interpolated slower ones."""

# numbers above these are times since 1970 in this unit; no drive lasts that long
EPOCHS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
TIME_OF_DAY = r"\s*\d+:\d\d:\d\d(\.\d*)?\s*"  # pandas would take "5 H" for one as well
Y2001 = 1e9  # seconds from 1970 to September 2001: greater times are those of a calendar


class _Clock(NamedTuple):
    """Time `t` (N,) [s] from the first sample; `epoch` [s] since 1970 of that, None if unknown."""

    t: np.ndarray
    epoch: float | None


def read_clock(channels: Channels) -> _Clock | None:
    """Return the clock of a table; None if there is none, which is added to the problems."""
    header, findings = channels.headers["t"], channels.findings
    if header is None:
        if "t" not in channels.description.columns:
            findings.problems.append(
                "the column t is missing: name it t, time or timestamp, or say which it is with "
                f"--columns t=NAME; {channels.list_columns()}"
            )
        return None
    try:
        t = _seconds(channels.table[header], channels.unit("t"), findings)
    except ValueError as error:
        where = "" if isinstance(error, ConfigError) else f"the column {header}: "
        findings.problems.append(f"{where}{error}")
        return None
    if np.isnan(t).any():
        k = int(np.flatnonzero(np.isnan(t))[0]) + 1
        findings.problems.append(f"{header} must hold a time in every row; row {k} is empty")
        return None
    if (backwards := np.flatnonzero(np.diff(t) <= SHORTEST_STEP)).size:
        why = (
            "its times are rounded: write them with more decimals"
            if backwards.size > 0.1 * t.size and np.diff(t).min() >= 0.0
            else "if the clock starts anew there, cut the file"
        )
        findings.problems.append(
            f"{header} must increase; it does not after row {backwards[0] + 1}: {why}"
        )
        return None
    return _Clock(t - t[0], float(t[0]) if t.size and t[0] > Y2001 else None)


def _seconds(column: Any, unit: str | None, findings: TableFindings) -> np.ndarray:
    """Return times [s] of numbers, calendar dates or times of the day; NaN where empty."""
    import pandas as pd
    import pyarrow as pa

    if pa.types.is_time(column.type):
        return _time_of_day(pd.to_timedelta(column.to_pandas().astype(str), errors="coerce"))
    if pa.types.is_timestamp(column.type) or pa.types.is_date(column.type):
        return since_1970(pd.to_datetime(column.to_pandas(), utc=True))
    if pa.types.is_string(column.type):
        cells = column.to_pandas()
        if pd.to_numeric(cells.head(20), errors="coerce").isna().all():
            of_day = pd.to_timedelta(cells.where(cells.str.fullmatch(TIME_OF_DAY)), errors="coerce")
            if of_day.notna().any():
                return _time_of_day(of_day)
            stamps = pd.to_datetime(cells, errors="coerce", utc=True, format="ISO8601")
            wrong = np.flatnonzero((stamps.isna() & cells.notna()).to_numpy())
            if wrong.size:
                raise ValueError(
                    f"row {wrong[0] + 1}: {shown(cells.iloc[wrong[0]])} is neither a number nor "
                    "a time in ISO 8601"
                )
            return since_1970(stamps)
    t = numeric_values(column)
    if unit is None:
        first = float(np.nanmin(t)) if np.isfinite(t).any() else 0.0
        unit = next((name for limit, name in EPOCHS if first > limit), "s")
        if unit != "s":
            findings.notes.append(f"the times are read as {unit} since 1970")
    return to_si(t, units.factor("time", unit))


def _time_of_day(times: Any) -> np.ndarray:
    """Return seconds of pandas' times of the day, beyond midnight if need be; NaN where empty."""
    x = times.dt.total_seconds().to_numpy(dtype=float, copy=True)
    known = np.isfinite(x)
    x[known] = np.unwrap(x[known], period=86400.0)
    return x


def since_1970(stamps: Any) -> np.ndarray:
    """Return seconds since 1970 of pandas' time stamps, NaN where empty."""
    x = stamps.astype("datetime64[ns, UTC]").astype("int64").to_numpy() * 1e-9
    return np.where(stamps.isna().to_numpy(), np.nan, x)


def check_rate(t: np.ndarray, findings: TableFindings) -> float:
    """Return the sampling interval [s] of the times `t` (N,); problems are added."""
    if t.size < MIN_SAMPLES:
        findings.problems.append(
            f"the table has {t.size} samples; at least {MIN_SAMPLES} are needed"
        )
        return 0.0
    steps = np.diff(t)
    dt = float(np.median(steps))
    longest = 2.5 if _jitters(steps, dt) else 1.5
    dt = float(steps[steps < longest * dt].mean())  # stamps are rounded, and the median with them
    if 1.0 / dt < FS_MIN * (1.0 - CLOCK_TOLERANCE):
        unit = next((u for least, u in ((1e6, "ns"), (1e3, "us"), (1.0, "ms")) if dt >= least), "")
        unit = unit and f"; are the times in {unit} (--units t={unit})?"
        findings.problems.append(
            f"the accelerations are sampled at {1.0 / dt:.3g} Hz; at least {FS_MIN:g} Hz are "
            f"needed{unit}"
        )
    elif 1.0 / dt > 1e5:
        findings.problems.append(
            f"the clock has steps of {dt:.2g} s: check the unit of the times (--units t=...)"
        )
    lost = float(t[-1]) / dt + 1.0 - t.size
    if lost > MAX_LOST_SHARE * (t.size + lost):
        k = int(np.argmax(steps))
        findings.problems.append(
            f"{lost / (t.size + lost):.0%} of the samples are lost; at most {MAX_LOST_SHARE:.0%} "
            f"may be; the longest gap is {steps[k]:.3g} s after row {k + 1}: cut the file there"
        )
    return dt


def resample(
    t: np.ndarray, a: np.ndarray, dt: float, findings: TableFindings
) -> tuple[np.ndarray, np.ndarray]:
    """Return a clock (M,) [s] and the channels `a` (k, N) on it, NaN where samples are lost.

    The clock is even, or that of the samples if it jitters and all channels have the same. Between
    samples the channels are cubic splines of their own samples.
    """
    steps = np.diff(t)
    even = bool(np.abs(steps - dt).max() <= CLOCK_TOLERANCE * dt)
    up = 1 if FS_USABLE * dt <= 1.0 else int(np.ceil(FS_UPSAMPLED * dt))
    jitters = _jitters(steps, dt) and steps.min() >= CLOSEST_STEP * dt and np.isfinite(a).all()
    if up == 1 and (even or jitters):
        return t, a
    reach = JITTER_REACH if _jitters(steps, dt) else REGULAR_REACH
    grid = dt / up * np.arange(int(t[-1] / dt * up + 1e-6) + 1)
    out = np.full((a.shape[0], grid.size), np.nan)
    for row, x in zip(out, a, strict=True):
        good = np.flatnonzero(np.isfinite(x))
        if good.size < MIN_SAMPLES:
            continue
        after = np.clip(np.searchsorted(t[good], grid), 1, good.size - 1)
        nearest = np.minimum(np.abs(grid - t[good[after - 1]]), np.abs(t[good[after]] - grid))
        inside = (grid >= t[good[0]] - reach * dt) & (grid <= t[good[-1]] + reach * dt)
        known = (nearest <= reach * dt) & inside
        apart = _spread_out(t[good], x[good], CLOSEST_STEP * dt)
        row[known] = scipy.interpolate.CubicSpline(*apart)(grid[known])
    lost = np.isnan(out).any(axis=0).mean()
    if not even:
        findings.notes.append(
            f"the clock is uneven (intervals of {1e3 * steps.min():.3g} to "
            f"{1e3 * steps.max():.3g} ms); resampled to {1.0 / dt:.4g} Hz, {lost:.1%} of the "
            "samples lost"
        )
    if up > 1:
        findings.notes.append(
            f"the accelerations are sampled at {1.0 / dt:.3g} Hz and interpolated to "
            f"{up / dt:.3g} Hz: nothing above {0.4 / dt:.2g} Hz is measured"
        )
    return grid, out


def _jitters(steps: np.ndarray, dt: float) -> bool:
    return float(np.median(np.abs(steps - dt))) > JITTERING * dt


def _spread_out(t: np.ndarray, x: np.ndarray, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """Return samples at least `apart` [s]: closer ones would make a spline swing by their noise."""
    group = np.cumsum(np.r_[0, np.diff(t) >= apart])
    count = np.bincount(group)
    return np.bincount(group, t) / count, np.bincount(group, x) / count
