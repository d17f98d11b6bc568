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
from estimators.map_smoother.tuning import TUNING
from road_envs.records.record import DistanceScale


def estimate_speed_error(solution: MapSolution) -> tuple[float, float]:
    """The relative error of the speed of a single pass, an unknown, and its variance."""
    (one,) = solution.linearization.passes
    size = solution.linearization.x.size
    unit = (np.arange(size) == size - 1).astype(float)
    column = solution.inverse_hessian(*TUNING.speed_cg)(unit)
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
    std = float(np.hypot(TUNING.speed_std_inflation / np.sqrt(information), TUNING.least_speed_std))
    if not std < TUNING.max_speed_std * model.speed_std:
        return None, ()
    if abs(error) > TUNING.max_speed_error * model.speed_std:
        note = (
            f"the time from axle to axle fits a speed that differs by {100.0 * error:+.1f} %, or a "
            f"wheelbase of {model.wheelbase / (1.0 + error):.2f} m instead of "
            f"{model.wheelbase:.2f} m: check both; distances are those of the given speed"
        )
        return None, (note,)
    return DistanceScale(1.0 + error, std), ()
