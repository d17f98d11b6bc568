"""A note on drives whose accelerations dry friction passes on, so that the struts hardly move.

A strut slides once the force on it exceeds the peak of its friction. Four struts that hold pass on
accelerations of the body up to the sum of these peaks over its mass; below it the body follows the
road on its tyres, and what a strut would have taken out of a wave does not show in any sensor.
"""

import numpy as np

from road_envs.records.record import Record
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.suspension import friction_peaks

_HELD = 1.25
"""RMS of the accelerations over what friction passes on, below which the struts hold mostly.

Below it are classes A up to 54 km/h, and B at 14.5 in ride and mixed states and at 36 in ride. Of
described and field cars (seeds 9700 and 9701) `map_smoother` errs there by 0.15 to 0.66 times the
road and `kalman_lag` by 0.33 to 4.7 times, with 47 to 95 % of the errors inside 90 %.
"""


def friction_note(record: Record, car: VehicleParameters) -> tuple[str, ...]:
    """Return a note where the accelerations are below _HELD times what friction passes on."""
    low, high = friction_peaks(car)
    peaks = np.where(record.damper_high.mean(axis=0) > 0.5, high, low)
    passed = float(peaks.sum() / car.m_b)
    driven = float(np.sqrt(np.nanmean(np.nanvar(record.a, axis=1))))
    if driven >= _HELD * passed:
        return ()
    return (
        "friction holds the struts of the vehicle for much of the drive (it passes on "
        f"{passed:.2f} m/s², {driven:.2f} were measured): heights are uncertain; drive faster, or "
        "on a rougher road as well",
    )
