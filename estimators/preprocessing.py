"""What learning estimators read: sensor signals and truths over distance instead of time."""

import dataclasses

import numpy as np

from road_envs.data.record import GRID, SENSORS, Profile, Record, grid
from road_envs.sensing.filters import process

F_C = 25.0
"""Band limit of the processed accelerations [Hz]."""

FS_MIN = 2.4 * F_C
"""Slowest sampling [Hz] that still tells that band."""

SAMPLES_MIN = 32
MOVED_MIN = 1.0
"""Shortest way [m] and fewest samples of a record that can be used."""

MISSING_MAX = 0.2
"""Greatest share of a channel's samples that is bridged."""

JITTER = 0.01
"""A step of the clock that differs by more than this share from the others is a fault."""


AT_LIMIT, HELD = 1e-5, 5
"""A sensor that stays this near to its greatest value for so many samples is clipped: no motion
above 0.4 Hz, sampled a thousand times a second, has so flat a peak."""


class RecordError(ValueError):
    """A record that cannot be used, in one sentence."""


def mended(record: Record) -> tuple[Record, tuple[str, ...]]:
    """A record on an even clock without gaps, and what had to be done or borne to get it.

    Missing samples (NaN, or steps left out by the clock) are bridged by straight lines. A record
    that needs no mending is handed back itself. Raises RecordError where a channel has another
    shape than the clock, misses more than a fifth of its samples, or where clock, sampling rate,
    strut states or odometer cannot be those of a drive over the road.
    """
    _check_shapes(record)
    record, notes = _without_gaps(record)
    record, more = _on_an_even_clock(record)
    record, rest = _going_forward(record)
    return record, (*notes, *more, *rest, *_clipped(record))


def accelerations(record: Record, margin: int = 0) -> np.ndarray:
    """Processed accelerations (3, M + 2 margin) [m/s²] at the moments when the front axle passed
    the grid and `margin` points beyond either end of it; zero where the record does not reach.
    """
    stations = GRID * np.arange(-margin, grid(record.length).size + margin)
    a = record.at(stations, process(record.a, record.fs, F_C))
    a[:, (stations < record.s[0]) | (stations > record.s[-1])] = 0.0
    return a


def heights(truth: Profile, stations: np.ndarray) -> np.ndarray:
    """True heights (2, M) [m] at `stations` (M,) [m]."""
    return np.array([np.interp(stations, truth.s, z) for z in truth.z])


def _check_shapes(record: Record) -> None:
    size = np.size(record.t)
    wanted = {
        "t": (size,), "a": (len(SENSORS), size), "v": (size,), "s": (size,),
        "stiff": (size, 4), "high": (size, 4),
    }  # fmt: skip
    for name, shape in wanted.items():
        found = np.shape(getattr(record, name))
        if found != shape:
            raise RecordError(f"{name} of the record must have the shape {shape}, got {found}")
    if size < SAMPLES_MIN:
        raise RecordError(f"the record has {size} samples; at least {SAMPLES_MIN} are wanted")
    if not np.isfinite(record.length) or grid(max(record.length, 0.0)).size < 2:
        raise RecordError(f"the road must be longer than {2 * GRID:.2f} m, got {record.length} m")
    late = np.flatnonzero(~(np.diff(record.t) > 0.0))
    if late.size:
        raise RecordError(f"the clock must go on; it does not after sample {late[0]}")
    if not np.isfinite(record.t).all():
        raise RecordError("the clock must be finite")
    for name in ("stiff", "high"):
        states = np.asarray(getattr(record, name))
        if states.dtype != bool and not np.isin(states, (0, 1)).all():
            raise RecordError(f"the strut states '{name}' must be true or false throughout")


def _without_gaps(record: Record) -> tuple[Record, list[str]]:
    """The record with what is not a number in its channels bridged."""
    channels = {**dict(zip(SENSORS, record.a, strict=True)), "v": record.v, "s": record.s}
    whole, notes = {}, []
    for name, x in channels.items():
        bad = ~np.isfinite(x)
        share = bad.mean()
        if share > MISSING_MAX:
            raise RecordError(
                f"{name} holds no number in {share:.0%} of its samples; "
                f"at most {MISSING_MAX:.0%} can be bridged"
            )
        whole[name] = np.interp(record.t, record.t[~bad], x[~bad]) if bad.any() else x
        if bad.any():
            notes.append(f"{name}: {share:.1%} of the samples were missing and are bridged")
    if not notes:
        return record, notes
    a = np.array([whole[name] for name in SENSORS])
    return dataclasses.replace(record, a=a, v=whole["v"], s=whole["s"]), notes


def _on_an_even_clock(record: Record) -> tuple[Record, list[str]]:
    """The record sampled evenly, at the rate of most of its steps."""
    steps = np.diff(record.t)
    dt = float(np.median(steps))
    if 1.0 / dt < FS_MIN:
        raise RecordError(
            f"the record is sampled at {1.0 / dt:.4g} Hz; "
            f"at least {FS_MIN:g} Hz are wanted for a band of {F_C:g} Hz"
        )
    if np.abs(steps - dt).max() <= JITTER * dt:
        return record, []
    t = record.t[0] + dt * np.arange(int((record.t[-1] - record.t[0]) / dt + 1e-6) + 1)
    lost = 1.0 - record.t.size / t.size
    if lost > MISSING_MAX:
        raise RecordError(
            f"{lost:.0%} of the samples were dropped; at most {MISSING_MAX:.0%} can be bridged"
        )
    before = np.clip(np.searchsorted(record.t, t, side="right") - 1, 0, record.t.size - 1)
    mended = dataclasses.replace(
        record,
        t=t,
        a=np.array([np.interp(t, record.t, x) for x in record.a]),
        v=np.interp(t, record.t, record.v),
        s=np.interp(t, record.t, record.s),
        stiff=record.stiff[before],
        high=record.high[before],
    )
    longest = steps.max()
    what = f"{lost:.1%} of the samples were dropped" if lost > 0 else "the clock is uneven"
    return mended, [f"{what} (longest step {longest:.3f} s); the record is resampled evenly"]


def _going_forward(record: Record) -> tuple[Record, list[str]]:
    """The record with an odometer that never falls."""
    notes = []
    forward = np.maximum.accumulate(record.s)
    if (back := float((forward - record.s).max())) > 0.1:
        raise RecordError(f"the odometer runs {back:.2f} m backwards; a drive goes forward")
    if (moved := float(forward[-1] - forward[0])) < MOVED_MIN:
        raise RecordError(f"the car moved by {moved:.2f} m; at least {MOVED_MIN:g} m are wanted")
    if back > 0.0:
        record = dataclasses.replace(record, s=forward)
    still = float(np.sum(np.diff(forward) <= 0.0) / record.fs)
    if still > 0.1:
        notes.append(f"the car stood still for {still:.1f} s; nothing is learnt of the road there")
    for missed, where in (
        (forward[0], f"the first {forward[0]:.2f} m"),
        (record.length - forward[-1], f"the last {record.length - forward[-1]:.2f} m"),
    ):
        if missed > GRID:
            notes.append(f"the record does not reach {where} of the road")
    return record, notes


def _clipped(record: Record) -> list[str]:
    """A note for each sensor that stands at its limit, sample after sample."""
    notes = []
    for name, a in zip(SENSORS, record.a, strict=True):
        limit = np.abs(a).max()
        at_limit = np.abs(a) >= (1.0 - AT_LIMIT) * limit
        in_a_row = np.lib.stride_tricks.sliding_window_view(at_limit, HELD).all(axis=1)
        if limit > 0.0 and in_a_row.any():
            notes.append(
                f"{name} stands at its limit of {limit:.1f} m/s² in {at_limit.mean():.1%} "
                "of the samples; the road is understated there"
            )
    return notes
