"""What is kept of a drive to teach an estimator, and what bounds the estimates of such a one."""

from typing import NamedTuple

import numpy as np

from estimators.common.spatial_signals import (
    N_HIGH_PASS,
    SpatialSignals,
    target_profile,
    to_spatial,
)
from estimators.linear.fir_bank import KNOTS
from estimators.preprocessing import clean_record
from road_envs.data.record import Profile, Record

STATIONS_BEHIND = 80
"""Stations of the linear window before the estimated one, and after it offline: 12 m."""

STATION_MARGIN = 256
"""Stations read beyond either end of the road."""

LONG_WAVE_NOTE = f"waves longer than {1.0 / N_HIGH_PASS:.0f} m are not estimated"


class TrainingExample(NamedTuple):
    """The course of a drive, and m and q (2, M) [m] of its road."""

    signals: SpatialSignals
    target: np.ndarray


def training_example(record: Record, truth: Profile, causal: bool) -> TrainingExample:
    """What is kept of a drive, in single precision. Raises RecordError."""
    record, _ = clean_record(record)
    signals = to_spatial(record, STATION_MARGIN, causal)
    single = np.float32
    motions, v, states = (x.astype(single) for x in (signals.motions, signals.v, signals.states))
    target = target_profile(truth, record.length).astype(single)
    return TrainingExample(SpatialSignals(motions, v, states, STATION_MARGIN), target)


def validity_notes(signals: SpatialSignals) -> list[str]:
    """What the reader of an estimate has to know about speed and struts."""
    notes = []
    inside = slice(signals.margin, signals.margin + signals.size)
    v, states = signals.v[inside], signals.states[inside]
    if v.min() < KNOTS[0] or v.max() > KNOTS[-1]:
        notes.append(
            f"driven at {3.6 * v.min():.0f} to {3.6 * v.max():.0f} km/h, "
            f"taught at {3.6 * KNOTS[0]:.0f} to {3.6 * KNOTS[-1]:.0f} km/h"
        )
    if np.any((states > 0.0) & (states < 1.0)):
        notes.append("left and right struts in different states, or a switch: both are blended")
    return notes
