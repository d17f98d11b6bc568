"""Training data of the pretrained estimators, and notes on the range in which they are valid."""

from typing import NamedTuple

import numpy as np

from estimators.common.spatial_signals import (
    N_HIGH_PASS,
    SpatialSignals,
    target_profile,
)
from estimators.preprocessing import clean_record
from road_envs.records.record import Profile, Record

SPEED_RANGE = 1.35, 20.5  # lowest and highest speed [m/s] of the training drives
# Stations of the FIR window before the estimated one, offline also after it: 12 m
STATIONS_BEHIND = 80
STATION_MARGIN = 256  # stations read beyond either end of the road
LONG_WAVE_NOTE = f"waves longer than {1.0 / N_HIGH_PASS:.0f} m are not estimated"


class TrainingExample(NamedTuple):
    """A drive over distance, m and q (2, M) [m] of its road, and whether the body is `rigid`."""

    signals: SpatialSignals
    target: np.ndarray
    rigid: bool = True

    @classmethod
    def of(
        cls, record: Record, truth: Profile, causal: bool, rigid: bool = True
    ) -> "TrainingExample":
        """Return the training example of a drive in single precision. Raises RecordError."""
        record, _ = clean_record(record)
        signals = SpatialSignals.of(record, STATION_MARGIN, causal)
        arrays = {k: x.astype(np.float32) for k, x in signals._asdict().items() if k != "margin"}
        target = target_profile(truth, record.length).astype(np.float32)
        return cls(signals._replace(**arrays), target, rigid)


def validity_notes(signals: SpatialSignals) -> list[str]:
    """Return notes on speeds and strut states outside the training data."""
    notes = []
    v, states = signals.v[signals.inside], signals.states[signals.inside]
    slowest, fastest = SPEED_RANGE
    if v.min() < slowest or v.max() > fastest:
        notes.append(
            f"driven at {3.6 * v.min():.0f} to {3.6 * v.max():.0f} km/h, "
            f"trained at {3.6 * slowest:.0f} to {3.6 * fastest:.0f} km/h"
        )
    if np.any((states > 0.0) & (states < 1.0)):
        notes.append(
            "left and right struts in different states, or a mode change: both states are blended"
        )
    return notes
