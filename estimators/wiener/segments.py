"""Division of a record into segments of evenly spaced stations for frequency-domain estimators.

Signals are low-passed and interpolated to even stations. A station is invalid within the low-pass's
reach of an invalid sample. Speed and strut modes count as constant within a segment.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import signal

from estimators.low_pass import bridge
from estimators.preprocessing import SPEED_MIN, MaskedRecord
from estimators.wiener.tuning import TUNING
from road_envs.records.record import PROFILE_SPACING, Record
from road_envs.vehicle.struts import MODES, Modes


@dataclass(frozen=True, eq=False)
class Segment:
    """Signals `a` (k, M) [m/s²] at the stations `spacing * (first + i)` [m], i < M.

    `stride` is the spacing in profile stations; `valid` (k, M) marks measured samples. `v` [m/s] is
    the speed, `mode` the strut mode by wheel, `core` (2,) [m] the part of the road to be estimated.
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
        """Distance [m] between stations."""
        return self.stride * PROFILE_SPACING


def split_segments(masked: MaskedRecord, length: float, margin: float) -> Iterator[Segment]:
    """Yield segments of about `length` [m], with up to `margin` [m] of record on either side."""
    record, good, _ = masked
    fs = record.fs
    mean = [x[g].mean() if g.any() else 0.0 for x, g in zip(record.a, good, strict=True)]
    filled = bridge(np.where(good, record.a - np.array(mean)[:, None], np.nan))
    # interpolated where not good, and low-passed at 40 Hz without phase
    sos = signal.butter(TUNING.pass_order, min(TUNING.f_pass, 0.4 * fs), fs=fs, output="sos")
    a = signal.sosfiltfilt(sos, filled, axis=1, padlen=min(50, filled.shape[1] - 1))
    reach = np.ones(2 * round(TUNING.filter_time * fs) + 1)
    bad = np.array([signal.fftconvolve(~g, reach, "same") > 0.5 for g in good])
    count = max(1, round(record.length / length))
    edges = np.linspace(0.0, record.length, count + 1)
    for low, high in pairwise(edges):
        yield _segment(record, a, bad, (float(low), float(high)), margin)


def _segment(record: Record, a: np.ndarray, bad: np.ndarray, core, margin: float) -> Segment:
    """Return the segment whose `core` [m] is to be estimated."""
    low = max(core[0] - margin, record.s[0])
    high = min(core[1] + margin, record.s[-1])
    inside = (record.s >= core[0] - margin) & (record.s <= core[1] + margin)
    if inside.sum() < 2:  # the record ends before this part of the road
        inside[:] = True
    part = np.flatnonzero(inside)
    t, s = record.t[part], record.s[part]
    moving = record.v[part] > 0.1 * max(record.v[part].max(), 1e-9)
    # a stop must not lower the speed that links frequency and wavelength
    v = float(np.median(record.v[part][moving])) if moving.any() else 0.0
    if not v > SPEED_MIN:
        v = max((s[-1] - s[0]) / (t[-1] - t[0]), SPEED_MIN)
    stride = max(1, int(v / TUNING.station_rate / PROFILE_SPACING))
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


def dominant_modes(record: Record, part: np.ndarray, modes: Modes = MODES) -> dict[str, str]:
    """Return, by wheel, the mode of each strut in most of the samples `part`, named by `modes`."""
    names = {state: name for name, state in modes.items()}
    stiff = record.spring_stiff[part].mean(axis=0) > 0.5
    high = record.damper_high[part].mean(axis=0) > 0.5
    states = [names[bool(k), bool(c)] for k, c in zip(stiff, high, strict=True)]
    return dict(zip(("FL", "FR", "RL", "RR"), states, strict=True))


def _notes(record: Record, part, v: float, core, hidden: np.ndarray) -> tuple[str, ...]:
    """Return notes on varying speed, mode changes and invalid stations."""
    where = f"{core[0]:.0f} to {core[1]:.0f} m"
    notes = []
    slow, fast = np.percentile(record.v[part], [5, 95])
    if fast - slow > 0.1 * v:
        notes.append(
            f"{where}: treated as driven at {v:.1f} m/s, actually {slow:.1f} to {fast:.1f} m/s"
        )
    commands = record.commands[part]
    if (commands != commands[0]).any():
        notes.append(f"{where}: treated as driven in the dominant mode")
    if hidden.size and (share := hidden.mean()) > 0.01:
        notes.append(f"{where}: {share:.0%} of the signals are left out, near invalid samples")
    return tuple(notes)
