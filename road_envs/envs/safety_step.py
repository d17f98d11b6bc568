"""Comfort and safety of a block of vehicles over one control interval, as `Safe4S4Env` has them.

All sums are integrals over time or squares, so that intervals add up: the control rate has no
effect. Shapes below omit the last axis of LANES.
"""

from typing import NamedTuple

import numpy as np
import scipy

from road_envs.kernels._numba import kernel
from road_envs.kernels.filters import filter_sample
from road_envs.kernels.simd import LANES
from road_envs.kernels.simd_arrays import add, get
from road_envs.simulation.rosenbrock import ACCELERATION, EXTENSION, LOAD
from road_envs.vehicle.equations import PHI, THETA, Z_B
from road_envs.vehicle.parameters import VehicleParameters

SAFETY_COLUMNS = (
    "t", "station", "speed_kmh", "comfort", "tyre_load", "cost", "stop", "lift_off",
    "load_transfer", "roll", "reward",
)  # fmt: skip
"""Columns of `StepOutput.values` with safety. `comfort` [m²/s³] is the time integral of the squared
weighted seat acceleration (W_k), `tyre_load` [s] that of the squared dynamic load coefficient;
`cost`, `stop` and `lift_off` are times [s] in violation, at a stop, and with a side off;
`load_transfer` [-] and `roll` [rad] the extremes."""

COMFORT_COLUMN = SAFETY_COLUMNS.index("comfort")
COMFORT, TYRE_LOAD, COST, STOP, LIFT_OFF, LOAD_TRANSFER, ROLL, N_SAFETY = range(8)
"""Rows of the sums over an interval, in the order of the columns from COMFORT_COLUMN on."""

SEAT = (0.30, 0.38)  # front seats: ahead of the centre of mass, beside the middle [m, assumed]
HIGH_PASS_CORNER = 0.4  # [Hz] below it a tyre load is quasi-static: lower limit of W_k, ISO 2631-1
GRACE = 0.02  # time [s] for which both wheels of a side may be off the ground before it counts


class _SafetyParameters(NamedTuple):
    """Constants of all vehicles."""

    high_pass_sos: np.ndarray  # of the tyre loads
    seat: np.ndarray  # (2,): x and |y| [m]
    stops: np.ndarray  # (4, 2) [m]: extensions at which the bump stops begin


def safety_parameters(car: VehicleParameters, step: float) -> _SafetyParameters:
    """Return the constants of the described `car` for steps of `step` [s]."""
    high_pass = scipy.signal.butter(2, HIGH_PASS_CORNER, "highpass", fs=1.0 / step, output="sos")
    return _SafetyParameters(high_pass, np.array(SEAT), car.free_travel)


@kernel
def add_safety(common, p, wk_state, high_pass_state, off, row, sums):
    """Add one step with the signals `row` to the `sums` (N_SAFETY,) of a block. `common` are the
    FleetParameters; the states are those of `FleetState`.
    """
    # the mean over both front seats, (a + b)² and (a - b)², is a² + b²: no side is preferred
    centre = get(row, ACCELERATION + Z_B) - p.seat[0] * get(row, ACCELERATION + THETA)
    side = p.seat[1] * get(row, ACCELERATION + PHI)
    a = filter_sample(common.wk_sos, wk_state, 0, centre)
    b = filter_sample(common.wk_sos, wk_state, 1, side)
    add(sums, COMFORT, common.h * (a * a + b * b))
    for w in range(4):
        load = get(row, LOAD + w) * common.per_static_load[w] - 1.0
        load = filter_sample(p.high_pass_sos, high_pass_state, w, load)
        add(sums, TYRE_LOAD, 0.25 * common.h * load * load)
    _add_violations(common.h, p.stops, off, row, sums)


@kernel(inline=False)
def _add_violations(h, stops, off, row, sums):
    """Add the times of a step in which a side is off or a strut at its stop; note extremes."""
    for k in range(LANES):
        left, right = row[LOAD, k] + row[LOAD + 2, k], row[LOAD + 1, k] + row[LOAD + 3, k]
        # loads are not negative, so that a side's sum is zero when both of its wheels are off
        off[0, k] = off[0, k] + h if left <= 0.0 else 0.0
        off[1, k] = off[1, k] + h if right <= 0.0 else 0.0
        stopped = False
        for w in range(4):
            e = row[EXTENSION + w, k]
            stopped = stopped or e < stops[w, 0] or e > stops[w, 1]
        longest = max(off[0, k], off[1, k])
        if longest > 0.0:
            sums[LIFT_OFF, k] += h
        if stopped:
            sums[STOP, k] += h
        # half a step: the sum of GRACE / h steps is not exactly GRACE
        if stopped or longest > GRACE + 0.5 * h:
            sums[COST, k] += h
        if left + right > 0.0:
            ratio = abs(left - right) / (left + right)
            sums[LOAD_TRANSFER, k] = max(sums[LOAD_TRANSFER, k], ratio)
        sums[ROLL, k] = max(sums[ROLL, k], abs(row[PHI, k]))


@kernel(inline=False)
def write_safety(sums, values):
    """Write the sums of an interval and the reward to `values` (lanes in use, 11)."""
    for k in range(values.shape[0]):
        for j in range(N_SAFETY):
            values[k, COMFORT_COLUMN + j] = sums[j, k]
        values[k, COMFORT_COLUMN + N_SAFETY] = -sums[COMFORT, k]
