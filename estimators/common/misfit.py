"""Notes of an estimator where its model does not reproduce the accelerations of a drive."""

import math

NOISE_SCALE_WARNING = 2.0
"""Power of the residual over that of the sensors' noise from which on the vehicle counts as
different from the model, and a note says so. With the paper's instruments it is 0.85 to 1.3 for the
vehicle and mode described, 1.7 to 2.4 in ride if handling was driven, and above 40 for a vehicle of
grade S2; a drive in ride that is described as handling stays below.
"""


def misfit_note(noise_scale: float) -> str:
    """Return the note of a residual of `noise_scale` times the power of the sensors' noise."""
    return (
        "the model does not reproduce the accelerations (residual "
        f"{math.sqrt(noise_scale):.1f} times the sensors' noise): treat IRI and heights as rough; "
        "identify the vehicle (docs/howto/identify)"
    )
