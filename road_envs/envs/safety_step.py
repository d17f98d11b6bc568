"""Instruments, comfort and safety of a block of vehicles over one control interval.

The motion comes from `simulation.fleet.integrate_lanes`, signals (n, 29, LANES) of n steps. All
sums are integrals over time or squares, so that intervals add up: the control rate has no effect.
Shapes below omit the last axis of LANES.
"""

from typing import NamedTuple

import numpy as np

from road_envs.envs.failures import find_failures
from road_envs.kernels._numba import kernel
from road_envs.kernels.filters import filter_sample
from road_envs.kernels.normal_numbers import fill_normal
from road_envs.kernels.simd import LANES, maximum, minimum
from road_envs.kernels.simd_arrays import add, get, put
from road_envs.simulation.rosenbrock import ACCELERATION, EXTENSION, LOAD
from road_envs.vehicle.equations import PHI, THETA, Z_B
from road_envs.vehicle.parameters import GRAVITY

COMFORT, TYRE_LOAD, COST, STOP, LIFT_OFF, LOAD_TRANSFER, ROLL, A_X, A_Y, N_SAFETY = range(10)
"""Rows of the sums over an interval: integrals of the squared seat acceleration [m²/s³] and of the
squared dynamic load coefficient [s]; times in violation, at a stop, and with a side off [s];
largest load-transfer ratio and roll [rad]; integrals of the specific forces [m/s]."""

GRACE = 0.02
"""Time [s] for which both wheels of a side may be off the ground before it counts."""


class SafetyState(NamedTuple):
    """State between intervals: filters as in `filters.filter_sample`, and times off the ground.

    `antialias` (n, k, 2) of k accelerometers, `weighting` (4, 2, 2) of the seats, `high_pass`
    (1, 4, 2) of the tyre loads, generators `noise` (4,), `off` (2,) [s] of the sides.
    """

    antialias: np.ndarray
    weighting: np.ndarray
    high_pass: np.ndarray
    noise: np.ndarray
    off: np.ndarray


class SafetyParameters(NamedTuple):
    """Constants of all vehicles.

    Filters of the accelerometers, of W_k and of the tyre loads; noise and range (k,) [m/s²];
    coordinates (k, 3) measured; `seat` (2,): x and |y| [m]; `stops` (4, 2) [m]: extensions at which
    the bump stops begin; `per_static_load` (4,) [1/N]; step [s] and steps per sample.
    """

    antialias_sos: np.ndarray
    wk_sos: np.ndarray
    high_pass_sos: np.ndarray
    noise_std: np.ndarray
    range: np.ndarray
    sensor_columns: np.ndarray
    seat: np.ndarray
    stops: np.ndarray
    per_static_load: np.ndarray
    h: float
    decimation: int


@kernel
def _measure(p, mounting, state, row, i, noise, samples):
    """Write the filtered accelerations of step `i` to `samples` (k, m), if it is one of a sample.

    `mounting` (k, 5): factors of the three coordinates, gain and offset of each accelerometer.
    """
    for j in range(p.range.size):
        columns, limit = p.sensor_columns[j], p.range[j]
        x = get(mounting, j, 0) * get(row, ACCELERATION + columns[0])
        x = x + get(mounting, j, 1) * get(row, ACCELERATION + columns[1])
        x = x + get(mounting, j, 2) * get(row, ACCELERATION + columns[2])
        x = x * get(mounting, j, 3) + get(mounting, j, 4) + p.noise_std[j] * get(noise, j, i)
        x = minimum(maximum(x, -limit), limit)
        x = filter_sample(p.antialias_sos, state.antialias, j, x)
        if i % p.decimation == 0:
            put(samples[j], i // p.decimation, minimum(maximum(x, -limit), limit))


@kernel
def _add_squares(p, state, row, sums):
    """Add the squared seat acceleration and the squared dynamic tyre loads of a step."""
    # the mean over both front seats, (a + b)² and (a - b)², is a² + b²: no side is preferred
    centre = get(row, ACCELERATION + Z_B) - p.seat[0] * get(row, ACCELERATION + THETA)
    side = p.seat[1] * get(row, ACCELERATION + PHI)
    a = filter_sample(p.wk_sos, state.weighting, 0, centre)
    b = filter_sample(p.wk_sos, state.weighting, 1, side)
    add(sums, COMFORT, p.h * (a * a + b * b))
    for w in range(4):
        load = get(row, LOAD + w) * p.per_static_load[w] - 1.0
        load = filter_sample(p.high_pass_sos, state.high_pass, w, load)
        add(sums, TYRE_LOAD, 0.25 * p.h * load * load)


@kernel(inline=False)
def _add_violations(p, off, row, sums):
    """Add the times of a step in which a side is off or a strut at its stop; note extremes."""
    for k in range(LANES):
        left, right = row[LOAD, k] + row[LOAD + 2, k], row[LOAD + 1, k] + row[LOAD + 3, k]
        # loads are not negative, so that a side's sum is zero when both of its wheels are off
        off[0, k] = off[0, k] + p.h if left <= 0.0 else 0.0
        off[1, k] = off[1, k] + p.h if right <= 0.0 else 0.0
        stopped = False
        for w in range(4):
            e = row[EXTENSION + w, k]
            stopped = stopped or e < p.stops[w, 0] or e > p.stops[w, 1]
        longest = max(off[0, k], off[1, k])
        if longest > 0.0:
            sums[LIFT_OFF, k] += p.h
        if stopped:
            sums[STOP, k] += p.h
        # half a step: the sum of GRACE / h steps is not exactly GRACE
        if stopped or longest > GRACE + 0.5 * p.h:
            sums[COST, k] += p.h
        if left + right > 0.0:
            ratio = abs(left - right) / (left + right)
            sums[LOAD_TRANSFER, k] = max(sums[LOAD_TRANSFER, k], ratio)
        sums[ROLL, k] = max(sums[ROLL, k], abs(row[PHI, k]))


@kernel(inline=False, count_references=False)
def measure_block(signals, a_xy, mounting, p, state, noise, samples, sums, events):
    """Pass the `signals` (n, 29) of an interval through instruments and sums of one block.

    `a_xy` (4 n + 2,) as in `DriveInputs`. `samples` (k, m), `sums` (N_SAFETY,) and the columns
    ROLLOVER and NONFINITE_STEP of `events` (LANES, 3) are overwritten; `noise` (k, n) is scratch.
    """
    fill_normal(state.noise, LANES, noise)
    for j in range(N_SAFETY):
        put(sums, j, 0.0)
    for k in range(LANES):
        events[k, 1] = events[k, 2] = -1
    for i in range(signals.shape[0]):
        row = signals[i]
        find_failures(row, i, events)
        _measure(p, mounting, state, row, i, noise, samples)
        _add_squares(p, state, row, sums)
        _add_violations(p, state.off, row, sums)
        add(sums, A_X, p.h * (get(a_xy, 4 * i) - GRAVITY * get(row, THETA)))
        add(sums, A_Y, p.h * (get(a_xy, 4 * i + 1) + GRAVITY * get(row, PHI)))
