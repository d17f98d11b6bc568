"""Error of the speed signal, from the time that passes from axle to axle.

Both axles roll over the same road, so the delay between what front and rear measure is wheelbase
over speed. The relative error of the speed is an unknown of the objective (`objective.py`), found
together with the road. Its posterior standard deviation is about 0.01 % after 100 m: the bound of
the linear vehicle, whose parameters are uncertain too.
"""

from collections.abc import Sequence

import numpy as np

from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.one_pass import MeasurementModel
from road_envs.records.record import DistanceScale

CG_ITERATIONS, CG_TOLERANCE = 100, 0.05
"""Iterations of conjugate gradients for the variance, at most, and where they end."""

STD_INFLATION, LEAST_STD = 3.0, 0.001
"""Factor on the posterior standard deviation, and what is added to it: a vehicle that is not quite
the one described moves the phase between its axles, and a wheelbase is known to some millimetres.
By drives of grade S2 (`tests/long/report_trial.py` with seeds 1 to 6).
"""

MAX_STD, MAX_ERROR = 0.5, 4.0
"""Largest standard deviation, and largest error, in units of the prior standard deviation, with
which distances are corrected.
"""


def estimate_speed_error(solution: MapSolution) -> tuple[float, float]:
    """The relative error of the speed of a single pass, an unknown, and its variance."""
    (one,) = solution.linearization.passes
    size = solution.linearization.x.size
    unit = (np.arange(size) == size - 1).astype(float)
    column = solution.inverse_hessian(CG_ITERATIONS, CG_TOLERANCE)(unit)
    variance = one.source.model.speed_std**2 * float(column[-1])
    return one.source.speed_error(one.own), variance


def distance_scale(
    errors: Sequence[tuple[float, float]], model: MeasurementModel
) -> tuple[DistanceScale | None, tuple[str, ...]]:
    """Return the scale of the odometer by the `errors` of the speed in the windows of a drive, with
    their variances: None if they tell hardly more than the speed itself, or doubt it; then with a
    note.
    """
    if not errors:
        return None, ()
    values, variances = np.array(errors).T
    information = np.sum(1.0 / variances)
    error = float(np.sum(values / variances) / information)
    std = float(np.hypot(STD_INFLATION / np.sqrt(information), LEAST_STD))
    if not std < MAX_STD * model.speed_std:
        return None, ()
    if abs(error) > MAX_ERROR * model.speed_std:
        note = (
            f"the time from axle to axle fits a speed that differs by {100.0 * error:+.1f} %, or a "
            f"wheelbase of {model.wheelbase / (1.0 + error):.2f} m instead of "
            f"{model.wheelbase:.2f} m: check both; distances are those of the given speed"
        )
        return None, (note,)
    return DistanceScale(1.0 + error, std), ()
