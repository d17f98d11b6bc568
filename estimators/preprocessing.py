"""Cleaning of records, and their signals over distance instead of time."""

import dataclasses

import numpy as np

from road_envs.data.record import PROFILE_SPACING, SENSORS, Profile, Record, profile_stations
from road_envs.sensing.filters import preprocess_accelerations

F_C = 25.0
"""Low-pass cut-off [Hz] of the processed accelerations."""

FS_MIN = 2.4 * F_C
"""Lowest sample rate [Hz] for a bandwidth of F_C."""

SAMPLES_MIN = 32
TRAVEL_MIN = 1.0
"""Smallest number of samples, and shortest distance travelled [m], of a usable record."""

MISSING_SHARE_MAX = 0.2
"""Largest fraction of a channel's samples that is interpolated."""

CLOCK_JITTER_MAX = 0.01
"""Relative deviation of a time step above which the clock is resampled."""


CLIPPING_TOLERANCE, CLIPPING_SAMPLES = 1e-5, 5
"""A sensor within this relative distance of its maximum for so many consecutive samples is clipped:
at 1 kHz no motion above 0.4 Hz has such a flat peak.
"""


class RecordError(ValueError):
    """A record that cannot be used; the message says why."""


def clean_record(record: Record) -> tuple[Record, tuple[str, ...]]:
    """Return `record` on a uniform clock without gaps, and notes on what was changed or tolerated.

    Missing samples (NaN, or steps skipped by the clock) are interpolated linearly. A record that
    needs no change is returned itself. Raises RecordError if a channel's shape differs from the
    clock's, if more than a fifth of its samples are missing, or if clock, sample rate, strut states
    or odometer cannot belong to a drive over the road.
    """
    _check_shapes(record)
    record, gap_notes = _fill_gaps(record)
    record, clock_notes = _resample_evenly(record)
    record, odometer_notes = _check_odometer(record)
    return record, (*gap_notes, *clock_notes, *odometer_notes, *_clipping_notes(record))


def spatial_accelerations(record: Record, margin: int = 0) -> np.ndarray:
    """Return processed accelerations (3, M + 2 margin) [m/s²] at the moments when the front axle
    passed the profile stations and `margin` stations beyond either end; zero outside the record.
    """
    stations = PROFILE_SPACING * np.arange(-margin, profile_stations(record.length).size + margin)
    a = record.interpolate(stations, preprocess_accelerations(record.a, record.fs, F_C))
    a[:, (stations < record.s[0]) | (stations > record.s[-1])] = 0.0
    return a


def sample_profile(truth: Profile, stations: np.ndarray) -> np.ndarray:
    """Return the true heights (2, M) [m] at `stations` (M,) [m]."""
    return np.array([np.interp(stations, truth.s, z) for z in truth.z])


def _check_shapes(record: Record) -> None:
    """Raise RecordError unless shapes, length, clock and strut states are valid."""
    size = np.size(record.t)
    expected = {
        "t": (size,), "a": (len(SENSORS), size), "v": (size,), "s": (size,),
        "spring_stiff": (size, 4), "damper_high": (size, 4),
    }  # fmt: skip
    for name, shape in expected.items():
        actual = np.shape(getattr(record, name))
        if actual != shape:
            raise RecordError(f"{name} of the record must have the shape {shape}, got {actual}")
    if size < SAMPLES_MIN:
        raise RecordError(f"the record has {size} samples; at least {SAMPLES_MIN} are needed")
    if not np.isfinite(record.length) or profile_stations(max(record.length, 0.0)).size < 2:
        raise RecordError(
            f"the road must be longer than {2 * PROFILE_SPACING:.2f} m, got {record.length} m"
        )
    late = np.flatnonzero(~(np.diff(record.t) > 0.0))
    if late.size:
        raise RecordError(f"the times t must increase; they do not after sample {late[0]}")
    if not np.isfinite(record.t).all():
        raise RecordError("the times t must be finite")
    for name in ("spring_stiff", "damper_high"):
        states = np.asarray(getattr(record, name))
        if states.dtype != bool and not np.isin(states, (0, 1)).all():
            raise RecordError(f"the strut states '{name}' must be true or false throughout")


def _fill_gaps(record: Record) -> tuple[Record, list[str]]:
    """Return the record with non-finite samples interpolated, and notes."""
    channels = {**dict(zip(SENSORS, record.a, strict=True)), "v": record.v, "s": record.s}
    filled, notes = {}, []
    for name, x in channels.items():
        bad = ~np.isfinite(x)
        share = bad.mean()
        if share > MISSING_SHARE_MAX:
            raise RecordError(
                f"{name} is not finite in {share:.0%} of its samples; "
                f"at most {MISSING_SHARE_MAX:.0%} can be interpolated"
            )
        filled[name] = np.interp(record.t, record.t[~bad], x[~bad]) if bad.any() else x
        if bad.any():
            notes.append(f"{name}: {share:.1%} of the samples were missing and are interpolated")
    if not notes:
        return record, notes
    a = np.array([filled[name] for name in SENSORS])
    return dataclasses.replace(record, a=a, v=filled["v"], s=filled["s"]), notes


def _resample_evenly(record: Record) -> tuple[Record, list[str]]:
    """Return the record on a uniform clock at its median time step, and notes."""
    steps = np.diff(record.t)
    dt = float(np.median(steps))
    if 1.0 / dt < FS_MIN:
        raise RecordError(
            f"the record is sampled at {1.0 / dt:.4g} Hz; "
            f"at least {FS_MIN:g} Hz are needed for a bandwidth of {F_C:g} Hz"
        )
    if np.abs(steps - dt).max() <= CLOCK_JITTER_MAX * dt:
        return record, []
    t = record.t[0] + dt * np.arange(int((record.t[-1] - record.t[0]) / dt + 1e-6) + 1)
    lost = 1.0 - record.t.size / t.size
    if lost > MISSING_SHARE_MAX:
        raise RecordError(
            f"{lost:.0%} of the samples were dropped; "
            f"at most {MISSING_SHARE_MAX:.0%} can be interpolated"
        )
    # strut states are switches: the last known value holds, it is not interpolated
    before = np.clip(np.searchsorted(record.t, t, side="right") - 1, 0, record.t.size - 1)
    resampled = dataclasses.replace(
        record,
        t=t,
        a=np.array([np.interp(t, record.t, x) for x in record.a]),
        v=np.interp(t, record.t, record.v),
        s=np.interp(t, record.t, record.s),
        spring_stiff=record.spring_stiff[before],
        damper_high=record.damper_high[before],
    )
    longest = steps.max()
    what = f"{lost:.1%} of the samples were dropped" if lost > 0 else "the clock is not uniform"
    return resampled, [f"{what} (longest step {longest:.3f} s); the record is resampled"]


def _check_odometer(record: Record) -> tuple[Record, list[str]]:
    """Return the record with a non-decreasing odometer, and notes."""
    notes = []
    forward = np.maximum.accumulate(record.s)
    if (back := float((forward - record.s).max())) > 0.1:
        raise RecordError(f"the odometer decreases by {back:.2f} m; a drive must go forward")
    if (moved := float(forward[-1] - forward[0])) < TRAVEL_MIN:
        raise RecordError(f"the vehicle moved by {moved:.2f} m; at least {TRAVEL_MIN:g} m are needed")
    if back > 0.0:
        record = dataclasses.replace(record, s=forward)
    still = float(np.sum(np.diff(forward) <= 0.0) / record.fs)
    if still > 0.1:
        notes.append(f"the vehicle stood still for {still:.1f} s; these samples carry no road information")
    for missed, where in (
        (forward[0], f"the first {forward[0]:.2f} m"),
        (record.length - forward[-1], f"the last {record.length - forward[-1]:.2f} m"),
    ):
        if missed > PROFILE_SPACING:
            notes.append(f"the record does not reach {where} of the road")
    return record, notes


def _clipping_notes(record: Record) -> list[str]:
    """Return a note for each sensor that stays at its limit."""
    notes = []
    for name, a in zip(SENSORS, record.a, strict=True):
        limit = np.abs(a).max()
        at_limit = np.abs(a) >= (1.0 - CLIPPING_TOLERANCE) * limit
        in_a_row = np.lib.stride_tricks.sliding_window_view(at_limit, CLIPPING_SAMPLES).all(axis=1)
        if limit > 0.0 and in_a_row.any():
            notes.append(
                f"{name} is clipped at {limit:.1f} m/s² in {at_limit.mean():.1%} "
                "of the samples; the road is underestimated there"
            )
    return notes
