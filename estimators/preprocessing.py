"""Checks and cleaning of records: refusal of unusable ones, validity of samples, notes.

Three views follow the same rules. An estimator that can leave samples out takes the first, one
whose model predicts samples at any time the second, one that needs every sample the third, which
also limits how much of a channel may be missing:

    mask_record(record, instruments)   an even clock, and which samples are valid
    restore_times(masked, record, ...) the same, with each sample at its own time
    clean_record(record)               an even clock, with missing samples interpolated

A sample is valid if it is finite, below the instruments' range, and not within the reach of the
anti-alias filter from one beyond it. Samples at standstill are valid, as the vehicle model
explains them; a note says how long the vehicle stood. A low-pass that the accelerations have passed
is undone (`estimators.low_pass`).
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from estimators.even_clock import resample_evenly, with_lost_samples
from estimators.low_pass import smoothing_notes, undo_low_pass
from road_envs.kernels.filters import preprocess_accelerations
from road_envs.records.record import (
    F_C,
    PROFILE_SPACING,
    SENSORS,
    Profile,
    Record,
    profile_stations,
)
from road_envs.sensing.instruments import Instruments

# Words of a note that is true of the first section of a drive alone: others begin on a road
LATE_START = "lie behind the front axle at the start"
# Lowest sample rate [Hz]: twice the bandwidth, and a fifth for the flank of the low-pass
_FS_MIN = 2.4 * F_C
_DURATION_MIN = 1.0  # shortest duration [s]: one period of the body's bounce
# Shortest distance travelled [m]: less than two of the shortest scored waves, of 0.56 m
_TRAVEL_MIN = 1.0
# Mean speed [m/s] below which the vehicle stands, and backward speed that counts as noise
SPEED_MIN = 0.1
# Largest decrease of the odometer [m], as of a vehicle that settles at a stop, and largest step
# from one sample to the next: 60 m/s at the lowest sample rate
BACKWARD_MAX, JUMP_MAX = 0.1, 1.0
# Largest fraction of a channel's samples that is interpolated: ten times what loggers are assumed
# to lose, and few enough for the measured samples to decide the estimate
_MISSING_SHARE_MAX = 0.2
# Share of the instruments' range from which on a sample is clipped: the sensors' gain errors are
# below 2 %
_RANGE_SHARE = 0.98
# A sensor within this relative distance of its peak for so many consecutive samples is clipped:
# at 1 kHz no motion above 0.4 Hz has such a flat peak
_CLIPPING_TOLERANCE, _CLIPPING_SAMPLES = 1e-5, 5
# Samples to either side of a clipped one that the anti-alias filter mixes with it
ANTIALIAS_SPREAD = 3


class RecordError(ValueError):
    """A record that cannot be used; the message says why."""


class MaskedRecord(NamedTuple):
    """A `record` on an even clock with finite `v` and `s`, the `valid` (k, N) samples of its
    accelerations, which are NaN where missing, and `notes` on what was changed or tolerated.
    """

    record: Record
    valid: np.ndarray
    notes: tuple[str, ...]


def mask_record(record: Record, instruments: Instruments | None = None) -> MaskedRecord:
    """Return `record` on an even clock, itself if it needs no change, its valid samples, and notes.
    The `instruments` are those of the record (`instruments_of`); without them no sample counts as
    out of range. Raises RecordError if a channel's shape differs from the clock's, if clock, strut
    states or odometer cannot belong to a drive over the road, or if all accelerations are missing.
    """
    names = record.channels if instruments is None else tuple(instruments.accelerometers)
    _check_shapes(record, names)
    record, gap_notes = _fill_odometer(record)
    record, clock_notes = resample_evenly(record)
    record, drive_notes = _check_drive(record)
    finite = np.isfinite(record.a)
    if not finite.any():
        raise RecordError("the record has no finite acceleration: check the sensors' channels")
    if np.isinf(record.a).any():
        record = dataclasses.replace(record, a=np.where(finite, record.a, np.nan))
    gap_notes += [
        f"{name}: {share:.1%} of the samples are missing"
        for name, share in zip(names, np.mean(~finite, axis=1), strict=True)
        if share > 0.0
    ]
    size = np.abs(np.where(finite, record.a, 0.0))
    out_of_range = _is_out_of_range(size, instruments)
    gap_notes += [
        f"{name} is {x[np.isfinite(x)][0]:g} in all samples: the sensor is dead"
        for name, x in zip(names, record.a, strict=True)
        if np.isfinite(x).any() and np.nanmax(x) == np.nanmin(x)
    ]
    valid = _is_valid(finite, out_of_range)
    clipping_notes = _clipping_notes(names, size, out_of_range)
    density = instruments.noise_densities.max() if instruments else 0.0
    record, valid, filter_notes = undo_low_pass(record, valid, density)
    if density > 0.0 and instruments:
        filter_notes += smoothing_notes(record, instruments)
    notes = (*gap_notes, *clock_notes, *drive_notes, *clipping_notes, *filter_notes)
    return MaskedRecord(record, valid, notes)


def restore_times(masked: MaskedRecord, record: Record, instruments: Instruments) -> MaskedRecord:
    """Return a `masked` record with the samples of an uneven clock as and when they were measured,
    in the `record` that it was made from; lost ones are NaN at the times that they should have. A
    record whose samples a low-pass has mixed stays resampled.
    """
    uneven = with_lost_samples(_fill_odometer(record)[0])
    if masked.record.low_pass is not None or uneven is None:
        return masked
    found, _ = _check_drive(uneven)
    finite = np.isfinite(found.a)
    found = dataclasses.replace(found, a=np.where(finite, found.a, np.nan))
    out_of_range = _is_out_of_range(np.nan_to_num(np.abs(found.a)), instruments)
    return MaskedRecord(found, _is_valid(finite, out_of_range), masked.notes)


def _is_out_of_range(size: np.ndarray, instruments: Instruments | None) -> np.ndarray:
    """Return which samples of this `size` (k, N) [m/s²] the instruments, if known, clip."""
    limits = np.inf if instruments is None else _RANGE_SHARE * instruments.ranges[:, None]
    return np.asarray(size >= limits)


def _is_valid(finite: np.ndarray, out_of_range: np.ndarray) -> np.ndarray:
    """Return which samples (k, N) are there, and far enough from any that is out of range."""
    spread = np.ones((1, 2 * ANTIALIAS_SPREAD + 1))
    return np.asarray(finite & ~binary_dilation(out_of_range, spread))


def clipped_signs(record: Record, instruments: Instruments) -> np.ndarray:
    """Return 1 and -1 where a sample (k, N) is at the upper and lower end of the range, else 0."""
    clipped = _is_out_of_range(np.abs(np.nan_to_num(record.a)), instruments)
    return clipped * np.sign(np.nan_to_num(record.a))


def clean_record(
    record: Record, channels: tuple[str, ...] | None = SENSORS
) -> tuple[Record, tuple[str, ...]]:
    """Return `record` on an even clock with missing samples interpolated linearly, and notes. It
    has the `channels` alone, in this order; all of its own if None. Raises RecordError as
    `mask_record` does, if a channel is missing, and if too many of its samples are.
    """
    if channels is not None and record.channels != channels:
        sensors = record.sensors or {}
        # a sensor on an axle is no substitute
        known = [name for name, sensor in sensors.items() if sensor.mounted == "body"]
        if not set(channels) <= set(known):
            raise RecordError(
                f"this estimator needs the accelerometers {', '.join(channels)} on the body; the "
                f"record has {', '.join(record.channels)}: map_smoother and wiener take any"
            )
        rows = [record.channels.index(name) for name in channels]
        layout = {name: sensors[name] for name in channels}
        record = dataclasses.replace(record, a=record.a[rows], sensors=layout)
    record, _, notes = mask_record(record)
    if np.isfinite(record.a).all():
        return record, notes
    named = zip(record.channels, record.a, strict=True)
    a = np.array([_fill_gaps(name, record.t, x) for name, x in named])
    return dataclasses.replace(record, a=a), notes


def spatial_accelerations(record: Record, margin: int = 0) -> np.ndarray:
    """Return processed accelerations (k, M + 2 margin) [m/s²] at the moments when the front axle
    passed the profile stations and `margin` stations beyond either end; zero outside the record.
    """
    stations = PROFILE_SPACING * np.arange(-margin, profile_stations(record.length).size + margin)
    a = record.interpolate(stations, preprocess_accelerations(record.a, record.fs, F_C))
    a[:, (stations < record.s[0]) | (stations > record.s[-1])] = 0.0
    return a


def sample_profile(truth: Profile, stations: np.ndarray) -> np.ndarray:
    """Return the true heights (2, M) [m] at `stations` (M,) [m]."""
    return np.array([np.interp(stations, truth.s, z) for z in truth.z])


def _check_shapes(record: Record, names: tuple[str, ...]) -> None:
    size = np.size(record.t)
    expected = {
        "t": (size,), "a": (len(names), size), "v": (size,), "s": (size,),
        "spring_stiff": (size, 4), "damper_high": (size, 4),
    }  # fmt: skip
    for name, shape in expected.items():
        actual = np.shape(getattr(record, name))
        if actual != shape:
            raise RecordError(f"{name} of the record must have the shape {shape}, got {actual}")
    if not np.isfinite(record.length) or profile_stations(max(record.length, 0.0)).size < 2:
        raise RecordError(
            f"the road must be longer than {2 * PROFILE_SPACING:.2f} m, got {record.length} m"
        )
    steps = np.diff(record.t)
    late = np.flatnonzero(~((steps > 0.0) & (steps < np.inf)))
    if late.size:
        raise RecordError(
            f"the times t must be finite and increase; they do not after sample {late[0]}"
        )
    duration = float(record.t[-1] - record.t[0]) if size else 0.0
    if not duration >= _DURATION_MIN:
        raise RecordError(
            f"the record lasts {duration:.2f} s; at least {_DURATION_MIN:g} s are needed"
        )
    if (fs := 1.0 / float(np.median(steps))) < _FS_MIN:
        raise RecordError(
            f"the record is sampled at {fs:.4g} Hz; "
            f"at least {_FS_MIN:g} Hz are needed for a bandwidth of {F_C:g} Hz"
        )
    for name in ("spring_stiff", "damper_high"):
        states = np.asarray(getattr(record, name))
        if states.dtype != bool and not np.isin(states, (0, 1)).all():
            raise RecordError(f"the strut states '{name}' must be true or false throughout")


def _fill_gaps(name: str, t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return `x` (N,) with non-finite samples interpolated. Raises RecordError if too many are."""
    good = np.isfinite(x)
    if (share := np.mean(~good)) > _MISSING_SHARE_MAX:
        raise RecordError(
            f"{name} is missing in {share:.0%} of its samples; "
            f"at most {_MISSING_SHARE_MAX:.0%} can be interpolated"
        )
    return np.interp(t, t[good], x[good])


def _fill_odometer(record: Record) -> tuple[Record, list[str]]:
    """Return the record with missing speeds and odometer readings interpolated, and notes."""
    notes, signals = [], {"v": record.v, "s": record.s}
    for name, x in signals.items():
        if lost := float(np.mean(~np.isfinite(x))):
            signals[name] = _fill_gaps(name, record.t, x)
            notes.append(f"{name}: {lost:.1%} of the samples are missing")
    filled = dataclasses.replace(record, v=signals["v"], s=signals["s"])
    return filled if notes else record, notes


def _check_drive(record: Record) -> tuple[Record, list[str]]:
    """The record with non-negative speed and non-decreasing odometer, and notes."""
    notes = []
    forward = np.maximum.accumulate(record.s)
    back, slowest = float((forward - record.s).max()), float(record.v.min())
    if back > BACKWARD_MAX:
        raise RecordError(f"the odometer decreases by {back:.2f} m; a drive must go forward")
    if slowest < -SPEED_MIN:
        raise RecordError(f"the speed falls to {slowest:.2g} m/s; a drive must go forward")
    if (moved := float(forward[-1] - forward[0])) < _TRAVEL_MIN:
        raise RecordError(
            f"the vehicle moved by {moved:.2f} m; at least {_TRAVEL_MIN:g} m are needed"
        )
    if (mean := float(record.v.mean())) < SPEED_MIN:
        raise RecordError(
            f"the vehicle stands: its mean speed is {mean:.2g} m/s; "
            f"at least {SPEED_MIN:g} m/s are needed"
        )
    steps = np.diff(forward)
    if (jump := float(steps.max())) > JUMP_MAX:
        raise RecordError(
            f"the odometer jumps by {jump:.2f} m from one sample to the next; at most "
            f"{JUMP_MAX:g} m are allowed: cut the record at the jump or correct s"
        )
    if back > 0.0 or slowest < 0.0:
        record = dataclasses.replace(record, s=forward, v=np.maximum(record.v, 0.0))
    still = float(np.sum(steps <= 0.0) / record.fs)
    if still > 0.1:
        notes.append(
            f"the vehicle stood still for {still:.1f} s; these samples carry no road information"
        )
    if (missed := forward[0]) > PROFILE_SPACING:
        notes.append(
            f"the first {missed:.2f} m {LATE_START}: at most the rear wheels drove over them"
        )
    if (missed := record.length - forward[-1]) > PROFILE_SPACING:
        notes.append(
            f"the last {missed:.2f} m lie ahead of the front axle at the end: no wheel drove over "
            "them"
        )
    return record, notes


def _clipping_notes(names: tuple[str, ...], size: np.ndarray, beyond: np.ndarray) -> list[str]:
    """Return a note for each sensor with samples `beyond` its range (k, N), or whose magnitude
    `size` (k, N) [m/s²] stays at its peak. The peak of a whole drive makes no sample invalid, since
    that would let a causal estimate depend on later samples.
    """
    notes = []
    for name, x, clipped in zip(names, size, beyond, strict=True):
        at_peak = x >= (1.0 - _CLIPPING_TOLERANCE) * x.max()
        in_a_row = np.lib.stride_tricks.sliding_window_view(at_peak, _CLIPPING_SAMPLES).all(axis=1)
        if x.any() and (clipped.any() or in_a_row.any()):
            notes.append(
                f"{name} is clipped at {x.max():.1f} m/s² in {(clipped | at_peak).mean():.1%} "
                "of the samples; the road is uncertain there"
            )
    return notes
