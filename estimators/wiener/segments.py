"""A record cut into stretches of even distance, as the model-based estimators in the frequency
domain want it: low-passed, on even stations, with what cannot be trusted marked.

A sample is not trusted if it is not finite, or at the limit of the sensor's range, or so near to
such a one that the filter carries it over. Within a stretch speed and mode count as constant.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import signal

from road_envs.data.record import PROFILE_SPACING, Record
from road_envs.sensing.instruments import Instruments
from road_envs.vehicle.suspension import MODES

STATION_RATE = 100.0
"""Samples per second that are kept, at least; signals above 40 Hz are filtered off [Hz]."""

PASS_ORDER, F_PASS = 8, 40.0
FILTER_TIME = 0.08
"""Time [s] over which the filter carries a bad sample."""


@dataclass(frozen=True, eq=False)
class Segment:
    """Signals `a` (3, M) [m/s²] on stations `first + i` (i < M) in steps `spacing` [m] of `stride` grid
    spacings, with `valid` (3, M): which of them are measured. Driven at `v` [m/s] in `mode`, wheel
    by wheel; `core` (2,) [m] is the part of the road that it is to answer for.
    """

    a: np.ndarray
    valid: np.ndarray
    first: int
    stride: int
    v: float
    mode: dict[str, str]
    core: tuple[float, float]
    notes: tuple[str, ...] = ()

    @property
    def spacing(self) -> float:
        """Distance of the stations [m]."""
        return self.stride * PROFILE_SPACING


def split_segments(
    record: Record, instruments: Instruments, length: float, margin: float
) -> Iterator[Segment]:
    """Stretches of about `length` [m] of road, and up to `margin` [m] of record around them.

    Raises ValueError on a record from which nothing can be made out.
    """
    validate_record(record)
    good = valid_samples(record, instruments)
    fs = record.fs
    a = bridge_and_lowpass(record.a, good, fs)
    reach = np.ones(2 * round(FILTER_TIME * fs) + 1)
    bad = np.array([signal.fftconvolve(~g, reach, "same") > 0.5 for g in good])
    count = max(1, round(record.length / length))
    edges = np.linspace(0.0, record.length, count + 1)
    for low, high in pairwise(edges):
        yield _segment(record, a, bad, (float(low), float(high)), margin)


def validate_record(record: Record) -> None:
    """ValueError in one sentence if a model of motion can make nothing of `record`."""
    if record.t.size < 16 or not (np.diff(record.t) > 0).all():
        raise ValueError("a record needs 16 samples or more, at increasing times")
    if not np.isfinite(record.s).all() or not np.isfinite(record.v).all():
        raise ValueError("odometer and speed of a record must be finite throughout")
    if record.fs < 60.0:
        raise ValueError(
            f"sampled at {record.fs:g} Hz; below 60 Hz the band up to 25 Hz is not to be had"
        )
    if not (record.s[-1] - record.s[0] > 1.0 and record.length > 0):
        raise ValueError("the car has moved less than a metre: no road to be reconstructed")
    if not np.isfinite(record.a).any():
        raise ValueError("not one acceleration of the record is finite")


def valid_samples(record: Record, instruments: Instruments) -> np.ndarray:
    """Which samples (3, N) of the record are finite and off the limits of the range."""
    return np.isfinite(record.a) & (np.abs(np.nan_to_num(record.a)) < 0.995 * instruments.range)


def bridge_and_lowpass(a: np.ndarray, good: np.ndarray, fs: float) -> np.ndarray:
    """Signals (3, N) without their mean, bridged where they are not `good`, low-passed at 40 Hz."""
    t = np.arange(a.shape[1])
    whole = np.zeros(a.shape)
    for out, x, g in zip(whole, a, good, strict=True):
        if g.any():
            out[:] = np.interp(t, t[g], x[g] - x[g].mean())
    sos = signal.butter(PASS_ORDER, min(F_PASS, 0.4 * fs), fs=fs, output="sos")
    return signal.sosfiltfilt(sos, whole, axis=1, padlen=min(50, a.shape[1] - 1))


def _segment(record: Record, a: np.ndarray, bad: np.ndarray, core, margin: float) -> Segment:
    low = max(core[0] - margin, record.s[0])
    high = min(core[1] + margin, record.s[-1])
    inside = (record.s >= core[0] - margin) & (record.s <= core[1] + margin)
    if inside.sum() < 2:  # the record ends before this part of the road
        inside[:] = True
    part = np.flatnonzero(inside)
    t, s = record.t[part], record.s[part]
    moving = record.v[part] > 0.1 * max(record.v[part].max(), 1e-9)
    v = float(np.median(record.v[part][moving])) if moving.any() else 0.0
    if not v > 0.1:
        v = max((s[-1] - s[0]) / (t[-1] - t[0]), 0.1)
    stride = max(1, int(v / STATION_RATE / PROFILE_SPACING))
    spacing = stride * PROFILE_SPACING
    first = int(np.ceil((min(core[0], low) - 1e-9) / spacing))
    size = max(int(np.floor((max(core[1], high) + 1e-9) / spacing)) - first + 1, 16)
    at = spacing * (first + np.arange(size))
    outside = (at < low) | (at > high)
    values, hidden = record.interpolate(at, a), record.interpolate(at, bad.astype(float)) > 0.0
    valid = ~hidden & ~outside
    return Segment(
        np.where(valid, values, 0.0),
        valid,
        first,
        stride,
        v,
        dominant_modes(record, part),
        core,
        _notes(record, part, v, core, hidden[:, ~outside]),
    )


def dominant_modes(record: Record, part: np.ndarray) -> dict[str, str]:
    """The state in which each strut is for most of the samples `part`."""
    names = {state: name for name, state in MODES.items()}
    stiff = record.spring_stiff[part].mean(axis=0) > 0.5
    high = record.damper_high[part].mean(axis=0) > 0.5
    states = [names[bool(k), bool(c)] for k, c in zip(stiff, high, strict=True)]
    return dict(zip(("FL", "FR", "RL", "RR"), states, strict=True))


def _notes(record: Record, part, v: float, core, hidden: np.ndarray) -> tuple[str, ...]:
    where = f"{core[0]:.0f} to {core[1]:.0f} m"
    notes = []
    slow, fast = np.percentile(record.v[part], [5, 95])
    if fast - slow > 0.1 * v:
        notes.append(f"{where}: taken as driven at {v:.1f} m/s, {slow:.1f} to {fast:.1f} in truth")
    flags = np.hstack([record.spring_stiff[part], record.damper_high[part]])
    if (flags != flags[0]).any():
        notes.append(f"{where}: taken as driven in the mode that lasted longest")
    if hidden.size and (share := hidden.mean()) > 0.01:
        notes.append(f"{where}: {100 * share:.0f} % of the samples are missing or at the limit")
    return tuple(notes)
