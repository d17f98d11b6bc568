"""Failures of the motion in a block of vehicles: angles beyond the model, divergence."""

import numpy as np

from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import LANES, any_positive, is_zero_or_one, maximum
from road_envs.kernels.simd_arrays import get
from road_envs.simulation.rosenbrock import ACCELERATION, N_SIGNALS
from road_envs.vehicle.equations import DOF, N_DOF

ANGLES = tuple(DOF.index(name) for name in ("phi", "theta", "phi_af", "phi_ar"))
MAX_ANGLE = float(np.radians(45.0))  # of each of ANGLES: beyond it the small-angle model is invalid

END_OF_ROAD, ROLLOVER, NONFINITE_STEP = range(3)
"""Columns of `control_step.StepOutput.events`: whether the vehicle has left its road; 4 i + column
of ANGLES if an angle first exceeds MAX_ANGLE in step i, else -1; first step with a non-finite
motion, else -1."""


@kernel(inline=False)
def _mark_nonfinite(signals, i, events):
    """Note step `i` as the first non-finite one of diverged lanes; zero their `signals`."""
    for k in range(LANES):
        total = 0.0
        for j in range(N_SIGNALS):
            total += signals[j, k]
        if not np.isfinite(total):
            if k < events.shape[0] and events[k, NONFINITE_STEP] < 0:
                events[k, NONFINITE_STEP] = i
            for j in range(N_SIGNALS):
                signals[j, k] = 0.0  # keeps the output and the filter states finite


@kernel(inline=False)
def _mark_rollover(signals, i, events):
    """Note the first angle beyond MAX_ANGLE in step `i` of lanes that have not rolled over yet."""
    for k in range(events.shape[0]):
        for column in range(len(ANGLES)):
            if events[k, ROLLOVER] < 0 and abs(signals[ANGLES[column], k]) > MAX_ANGLE:
                events[k, ROLLOVER] = len(ANGLES) * i + column


@kernel
def find_failures(signals, i, events):
    """Note lanes of which the motion of step `i` is not finite, or an angle is beyond MAX_ANGLE."""
    # what is not finite reaches an acceleration in the same step
    total, angle = get(signals, ACCELERATION), 0.0 * get(signals, ACCELERATION)
    for j in range(1, N_DOF):
        total = total + get(signals, ACCELERATION + j)
    if not is_zero_or_one(0.0 * total):
        _mark_nonfinite(signals, i, events)
    for j in ANGLES:
        angle = maximum(angle, maximum(get(signals, j), -get(signals, j)))
    if any_positive(angle - MAX_ANGLE):
        _mark_rollover(signals, i, events)
