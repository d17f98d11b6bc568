"""Stretches of a drive in which the vehicle turned, changed its speed hard or stood still.

The models of the estimators drive straight ahead without pitching moments, so what a manoeuvre does
to the struts is taken for road. Two signals show it: the measured speed, and the roll acceleration
between two sensors of the body, left and right at one distance from the axles. Roads excite little
roll between 0.2 and 0.9 Hz compared with that above, and, since their long waves are alike in both
wheel paths, compared with heave; a turn that begins or ends rolls the body. Its steady part has no
vertical acceleration: a beginning and an end close together are taken for one turn, and a turn that
begins before the record is not seen.
"""

from itertools import combinations

import numpy as np
from scipy.ndimage import binary_closing, binary_dilation, gaussian_filter1d, label
from scipy.signal import butter, sosfiltfilt

from estimators.common.explained import mark_unsure
from road_envs.records.record import PROFILE_SPACING, Estimate, Record
from road_envs.sensing.instruments import load_instruments

_STANDING = 0.5  # speed [m/s] below which the vehicle stands
_HARD_CHANGE = 1.5  # acceleration [m/s²], of either sign, from which on the body pitches markedly
_SPEED_WINDOW = 0.5  # deviation [s] of the window that smooths the speed before its derivative
_ROLL_BAND, _ROAD_BAND = (0.2, 0.9), (1.5, 6.0)  # [Hz] of roll by manoeuvres, and by roads
# Slow roll acceleration [rad/s²] below which nothing is taken for a turn, and above which it is the
# road's. The start of a record with biased sensors gives up to 0.2, turns of 0.2 g in ride 0.5 and
# more, a road that twists 6 to 13.
_LEAST_ROLL, _MOST_ROLL = 0.25, 3.0
# Slow roll over the RMS of the roll in _ROAD_BAND, and over that of the slow heave [m/s²], from
# which on the vehicle turned. Turns of 0.2 g in ride reach both, but on class D at 80 km/h and on
# Belgian paving at 36; no straight drive of 270 does, where the greatest is 2.5 times the heave.
# Far beyond that it counts alone: changes of lane in stiff states have 6 to 9 times the heave, and
# 0.9 times the road's.
_ROAD_RATIO, _HEAVE_RATIO, _FAR_RATIO = 1.4, 1.9, 3.5
# Slow roll at the other end of a turn over that from which on one is found: friction and stiffer
# springs make the release slower than the build-up
_RELEASE = 0.5
# Lateral distance [m] of the two sensors, and duration [s] of a record, below which no roll is
# looked at
_LEAST_DISTANCE, _LEAST_DURATION = 0.8, 8.0
_LONGEST_TURN = 10.0  # longest time [s] between the slow rolls of one turn


def mark_manoeuvres(estimate: Estimate, record: Record, wheelbase: float) -> Estimate:
    """Return `estimate` with its `unsure` stations, a note on each stretch before the others, and
    `z_std` raised there by the RMS of the waves below some metres, unless nothing is found.

    `wheelbase` [m]: stations between both axles belong to a sample.
    """
    unsure, notes = np.zeros(estimate.s.size, dtype=bool), list[str]()
    kinds = {"turned": _turns, "braked or accelerated hard, or stood": _speed_changes}
    for what, find in kinds.items():
        marked = np.zeros(estimate.s.size, dtype=bool)
        runs, count = label(find(record))
        for k in range(1, count + 1):
            s = record.s[runs == k]
            marked |= (estimate.s >= s.min() - wheelbase) & (estimate.s <= s.max())
        unsure |= marked
        edges = np.flatnonzero(np.diff(np.pad(marked, 1).astype(int)))
        notes += [
            f"between {PROFILE_SPACING * begin:.0f} and {PROFILE_SPACING * end:.0f} m the vehicle "
            f"{what}: heights there are not known"
            for begin, end in edges.reshape(-1, 2)
        ]
    return mark_unsure(estimate, unsure, *notes) if unsure.any() else estimate


def _turns(record: Record) -> np.ndarray:
    """Return at which samples (N,) the vehicle turned; False if its sensors tell no roll."""
    motion = _roll_and_heave(record)
    if motion is None:
        return np.zeros(record.t.size, dtype=bool)
    (slow, heave), (road, _) = (
        sosfiltfilt(butter(2, band, "bandpass", fs=record.fs, output="sos"), motion)
        for band in (_ROLL_BAND, _ROAD_BAND)
    )
    road, heave = (
        np.maximum(np.sqrt(gaussian_filter1d(x**2, window * record.fs)), x.std())
        for x, window in ((road, 1.0), (heave, 2.0))
    )
    both = np.maximum(_ROAD_RATIO * road, _HEAVE_RATIO * heave)
    limit = np.maximum(_LEAST_ROLL, np.minimum(both, _FAR_RATIO * heave))
    if np.abs(slow).max() > _MOST_ROLL:
        return np.zeros(record.t.size, dtype=bool)
    weak = binary_dilation(np.abs(slow) > _RELEASE * limit, iterations=int(record.fs))
    gap = int(0.5 * _LONGEST_TURN * record.fs)
    runs, _ = label(binary_closing(np.pad(weak, gap), iterations=gap)[gap:-gap])
    return (runs > 0) & np.isin(runs, runs[np.abs(slow) > limit])


def _speed_changes(record: Record) -> np.ndarray:
    """Return at which samples (N,) the vehicle braked or accelerated hard, or stood."""
    known = np.isfinite(record.v)
    if not known.any():
        return known
    v = np.interp(record.t, record.t[known], record.v[known])
    smooth = gaussian_filter1d(v, _SPEED_WINDOW * record.fs, mode="nearest")
    return (v < _STANDING) | (np.abs(np.gradient(smooth, record.t)) > _HARD_CHANGE)


def _roll_and_heave(record: Record) -> np.ndarray | None:
    """Return the accelerations (2, N) [rad/s², m/s²] of the body's roll and of its middle between
    two sensors; None if no two sensors tell the roll.
    """
    layout = load_instruments("paper").layout if record.sensors is None else record.sensors
    if len(layout) != len(record.a) or record.t[-1] - record.t[0] < _LEAST_DURATION:
        return None
    pairs = [
        (abs(a.y - b.y), i, j)
        for (i, a), (j, b) in combinations(enumerate(layout.values()), 2)
        if a.mounted == b.mounted == "body" and (a.axle, a.ahead) == (b.axle, b.ahead)
    ]
    distance, left, right = max(pairs, default=(0.0, 0, 0))
    if distance < _LEAST_DISTANCE or record.fs < 4.0 * _ROAD_BAND[1]:
        return None
    one, other = record.a[left], record.a[right]
    motion = np.array([(one - other) / distance, 0.5 * (one + other)])
    if not np.isfinite(motion).any():
        return None
    return np.nan_to_num(motion - np.nanmedian(motion, axis=1, keepdims=True))
