"""Even clocks: samples of an uneven clock interpolated to an even one, lost ones as NaN."""

import dataclasses

import numpy as np
from scipy.interpolate import CubicSpline

from road_envs.records.record import Record

# Relative deviation of a time step from the median above which the clock is resampled: a sample
# is then taken at most a tenth of a millimetre off at 36 km/h and 1 kHz
_CLOCK_JITTER_MAX = 0.01
# Median deviations of the time steps by which a step may be longer without a lost sample: four
# standard deviations
_GAP_JITTERS = 6.0
# Sample rate [Hz] below which samples of an uneven clock are interpolated by a cubic spline: at
# 100 Hz a straight line takes a fifth of the power of waves of 25 Hz
_FS_SPLINE = 400.0


def _is_even_clock(steps: np.ndarray) -> bool:
    dt = float(np.median(steps))
    return bool(np.abs(steps - dt).max() <= _CLOCK_JITTER_MAX * dt)


def _on_clock(record: Record, t: np.ndarray, a: np.ndarray) -> Record:
    """Return the record at the times `t` (M,) with accelerations `a` (k, M)."""
    # strut states are switches: the last known value holds, it is not interpolated
    before = np.searchsorted(record.t, t + 0.5 * float(np.median(np.diff(t)))) - 1
    return dataclasses.replace(
        record,
        t=t,
        a=a,
        v=np.interp(t, record.t, record.v),
        s=np.interp(t, record.t, record.s),
        spring_stiff=record.spring_stiff[before],
        damper_high=record.damper_high[before],
    )


def with_lost_samples(record: Record) -> Record | None:
    """Return the record of an uneven clock with lost samples as NaN, None if its clock is even. A
    step counts as one interval unless it is longer than the jitter of the others makes likely.
    """
    steps = np.diff(record.t)
    if _is_even_clock(steps):
        return None
    dt = float(np.median(steps))
    jitter = float(np.median(np.abs(steps - dt))) / dt
    intervals = np.maximum(np.round(steps / dt), 1.0).astype(int)
    intervals[steps < dt * max(1.5, 1.0 + _GAP_JITTERS * jitter)] = 1
    cell = np.concatenate([[0], np.cumsum(intervals)])
    t = np.interp(np.arange(cell[-1] + 1), cell, record.t)
    a = np.full((len(record.a), t.size), np.nan)
    a[:, cell] = record.a
    return _on_clock(record, t, a)


def resample_evenly(record: Record) -> tuple[Record, list[str]]:
    """Return the record on an even clock at its median time step, with accelerations of NaN where
    samples were lost or dropped, and notes.
    """
    steps = np.diff(record.t)
    if _is_even_clock(steps):
        return record, []
    dt = float(np.median(steps))
    t = record.t[0] + dt * np.arange(int((record.t[-1] - record.t[0]) / dt + 1e-6) + 1)
    a = np.array([_resample(t, record.t, x, dt) for x in record.a])
    return _on_clock(record, t, a), [f"the clock is uneven (longest step {steps.max():.3f} s)"]


def _resample(t: np.ndarray, t_old: np.ndarray, x: np.ndarray, dt: float) -> np.ndarray:
    """Return `x` (N,) interpolated to the times `t`, NaN in gaps of more than a step `dt`."""
    good = np.isfinite(x)
    if not good.any():
        return np.full(t.size, np.nan)
    t_old = t_old[good]
    after = np.clip(np.searchsorted(t_old, t), 1, t_old.size - 1)
    before, beyond = np.abs(t - t_old[after - 1]), np.abs(t_old[after] - t)
    # jitter alone does not open a gap; the samples at the ends of one are measured
    missing = (before + beyond > 1.5 * dt) & (np.minimum(before, beyond) > 0.5 * dt)
    if _FS_SPLINE * dt < 1.0 or t_old.size < 2:
        return np.where(missing, np.nan, np.interp(t, t_old, x[good]))
    return np.where(missing, np.nan, CubicSpline(t_old, x[good])(t))
