"""What is kept of a drive to teach an estimator, and what bounds the estimates of such a one."""

from typing import NamedTuple

import numpy as np

from estimators.common.spatial_signals import N_HIGH_PASS, Course, course, wanted
from estimators.linear.fir_bank import KNOTS
from estimators.preprocessing import mended
from road_envs.data.record import Profile, Record

BEHIND = 80
"""Stations of the linear window before the estimated one, and after it offline: 12 m."""

MARGIN = 256
"""Stations read beyond either end of the road."""

SLOW = f"waves longer than {1.0 / N_HIGH_PASS:.0f} m are not estimated"


class Material(NamedTuple):
    """The course of a drive, and m and q (2, M) [m] of its road."""

    course: Course
    target: np.ndarray


def material(record: Record, truth: Profile, causal: bool) -> Material:
    """What is kept of a drive, in single precision. Raises RecordError."""
    record, _ = mended(record)
    seen = course(record, MARGIN, causal)
    single = np.float32
    motions, v, states = (x.astype(single) for x in (seen.motions, seen.v, seen.states))
    target = wanted(truth, record.length).astype(single)
    return Material(Course(motions, v, states, MARGIN), target)


def limits(seen: Course) -> list[str]:
    """What the reader of an estimate has to know about speed and struts."""
    notes = []
    inside = slice(seen.margin, seen.margin + seen.size)
    v, states = seen.v[inside], seen.states[inside]
    if v.min() < KNOTS[0] or v.max() > KNOTS[-1]:
        notes.append(
            f"driven at {3.6 * v.min():.0f} to {3.6 * v.max():.0f} km/h, "
            f"taught at {3.6 * KNOTS[0]:.0f} to {3.6 * KNOTS[-1]:.0f} km/h"
        )
    if np.any((states > 0.0) & (states < 1.0)):
        notes.append("left and right struts in different states, or a switch: both are blended")
    return notes
