"""Notes of an estimator where its model does not reproduce the accelerations of a drive."""

import math


def misfit_note(noise_scale: float) -> str:
    """Return the note of a residual of `noise_scale` times the power of the sensors' noise."""
    return (
        "the model does not reproduce the accelerations (residual "
        f"{math.sqrt(noise_scale):.1f} times the sensors' noise): treat IRI and heights as rough; "
        "identify the vehicle (docs/howto/identify)"
    )
