"""Odometers that are not right: calibration of the speed signal against the position fixes of the
same record, and the distance scale that an estimator has found.

A speed signal that reads 1 + e times the speed displaces the odometer, which integrates it, until
position fixes hold it. With d the distance from the beginning of the record, where the odometer is
right, and L the distance over which the fixes remove 63 % of an error,

    integral of v = (1 + e) d,      s - s_0 = d + e L (1 - exp(-d / L)).

The two signals agree if there are no fixes, and differ in proportion if the fixes act at once; only
between the two is the odometer displaced, by up to e L. Both e and L are fitted to their difference
along the drive, and the displacement is removed. While a drive is recorded they are fitted to what
is known so far: with x = (1 + e) d the integral of v, and w the difference of the two signals,

    w = e' / L' x² / 2 - 1 / L' (integral of w dx)      e' = e / (1 + e),  L' = (1 + e) L

is linear in e' / L' and 1 / L', whose least squares follow from running sums. Where the fixes
wander by themselves, as those of a receiver do, the stations are those of the speed, shifted and
scaled to the fixes (`position_noise.py`), or, while a drive is recorded, shifted alone. (The scale
factor of an odometer is a state of every navigation filter: Groves, "Principles of GNSS, Inertial,
and Multisensor Integrated Navigation Systems", 2013, section 16.3.)
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from estimators.common.position_noise import SPEED_STD, fit_wander, wanders
from estimators.preprocessing import BACKWARD_MAX, JUMP_MAX
from road_envs.records.record import DistanceScale, Estimate, Record, profile_stations

_LENGTHS = (0.5, 100.0)  # least and greatest L [m] looked for; it must be passed within the record
_MAX_SPEED_ERROR = 0.1  # greatest relative error of a speed signal that is believed
_MIN_DISPLACEMENT = 0.005  # displacement [m] below which nothing is corrected
# Least ratio of the displacement to what the fit leaves, root mean square, or to its standard
# deviation
_CLEARNESS = 10.0
# Distance [m] before which fixes are not said to wander, online, and least rms [m] from there on
_MIN_WANDER_LENGTH, _ONLINE_WANDER = 10.0, 0.02
WANDER_NOTE = (
    "stations are uncertain by ±{:.1f} m: the positions of the receiver wander against the speed "
    "signal; heights can be compared after alignment"
)
_FIT_SPACING = 0.1  # distance [m] of the points to which the signals are fitted online
_CORRELATION_LENGTH = 1.0  # length [m] over which the errors of position fixes are correlated


class Odometer(NamedTuple):
    """A `record` with calibrated stations and speed, and a note if they were changed; where fixes
    wander, standard deviations of the stations [m] and of the relative error of the speed.
    """

    record: Record
    notes: tuple[str, ...] = ()
    s_std: float | None = None
    speed_std: float = 0.0

    def describe(self, estimate: Estimate) -> Estimate:
        """Return an estimate from the record with what the calibration says of its stations."""
        if self.s_std is None:
            return replace(estimate, notes=(*estimate.notes, *self.notes))
        return replace(estimate, notes=(*self.notes, *estimate.notes), s_std=self.s_std)


def calibrate_odometer(record: Record, causal: bool = False) -> Odometer:
    """Calibrate stations and speed by the whole record, of a `causal` estimate each sample by those
    before it alone.

    A record is returned itself if it is empty, its signals are not finite, their difference shows
    no clear displacement, or, if causal, it goes backwards.
    """
    if record.t.size == 0:
        return Odometer(record)
    whole = _calibrate(record)
    if not causal:
        return whole
    found = _calibrate_online(record)
    if whole.s_std is None:
        return found
    # the constant error of the speed signal is not removed
    std = float(np.hypot(whole.s_std, SPEED_STD * np.ptp(record.s) / np.sqrt(3.0)))
    return Odometer(found.record, (WANDER_NOTE.format(std),), std, SPEED_STD)


def _calibrate(record: Record) -> Odometer:
    unchanged = Odometer(record)
    travelled = cumulative_trapezoid(record.v, record.t, initial=0.0)
    slip = travelled - (record.s - record.s[0])
    if not (np.isfinite(slip).all() and np.ptp(slip) > _MIN_DISPLACEMENT):
        return unchanged
    most = min(_LENGTHS[1], 0.5 * float(travelled[-1]))
    if not most > _LENGTHS[0]:
        return unchanged

    def fit(log_length: float) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the speed error for a length L, the displacement (N,) and what is left (N,)."""
        length, error = np.exp(log_length), 0.0
        for _ in range(3):  # the distance depends on the error itself, a little
            distance = travelled / (1.0 + error)
            held = -length * np.expm1(-distance / length)
            shape = distance - held
            error = float(np.clip(shape @ slip / (shape @ shape), -0.5, 0.5))
        return error, error * held, slip - error * shape

    bounds = np.log(_LENGTHS[0]), np.log(most)
    found = minimize_scalar(lambda x: np.sum(fit(x)[2] ** 2), bounds=bounds, method="bounded")
    error, displacement, left = fit(found.x)
    greatest = float(np.abs(displacement).max())
    forward = np.maximum.accumulate(record.s)
    back, jump = (forward - record.s).max(), np.diff(forward).max()
    # records whose stations go back or jump are refused
    if back <= BACKWARD_MAX and jump <= JUMP_MAX and wanders(record.t, left):
        offset, excess, excess_std, std = fit_wander(record.t, travelled, record.s - record.s[0])
        if abs(excess) > _MAX_SPEED_ERROR:
            return unchanged
        s = record.s[0] + offset + (1.0 + excess) * travelled
        followed = replace(record, s=s, v=(1.0 + excess) * record.v)
        return Odometer(followed, (WANDER_NOTE.format(std),), std, excess_std)
    least = max(_MIN_DISPLACEMENT, _CLEARNESS * float(np.sqrt(np.mean(left**2))))
    if abs(error) > _MAX_SPEED_ERROR or greatest < least:
        return unchanged
    corrected = replace(record, s=record.s - displacement, v=record.v / (1.0 + error))
    return Odometer(corrected, (_describe(error, displacement),))


def _describe(error: float, displacement: np.ndarray) -> str:
    greatest = float(np.abs(displacement).max())
    return (
        f"the speed signal reads {100.0 * error:+.1f} % beside the position fixes; stations are "
        f"corrected by up to {100.0 * greatest:.0f} cm"
    )


def _calibrate_online(record: Record) -> Odometer:
    """Calibrate each sample by those before it alone, without a word on fixes that wander."""
    unchanged = Odometer(record)
    x = cumulative_trapezoid(record.v, record.t, initial=0.0)
    slip = x - (record.s - record.s[0])
    if not (np.isfinite(slip).all() and (np.diff(x) >= 0.0).all() and x[-1] > 2.0 * _FIT_SPACING):
        return unchanged
    distance = np.arange(0.0, x[-1], _FIT_SPACING)
    w = np.interp(distance, x, slip)
    regressors = np.stack([0.5 * distance**2, -cumulative_trapezoid(w, distance, initial=0.0)])
    (aa, ab), (_, bb) = np.cumsum(regressors[:, None] * regressors, axis=2)
    aw, bw = np.cumsum(regressors * w, axis=1)
    left = np.cumsum(w * w)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        determinant = aa * bb - ab**2
        a, b = (bb * aw - ab * bw) / determinant, (aa * bw - ab * aw) / determinant
        error, length = a / b, 1.0 / b
        freedom = np.maximum(np.arange(w.size) - 1, 0)
        rms = np.sqrt(np.maximum(left - a * aw - b * bw, 0.0) / freedom)
        gradient = (bb + 2.0 * error * ab + error**2 * aa) * _CORRELATION_LENGTH / _FIT_SPACING
        std = length**2 * rms * np.sqrt(gradient / determinant)  # of the error times the length
        displacement = -length * error * np.expm1(-distance / length)
        believed = (np.abs(error) < _MAX_SPEED_ERROR) & (length > _LENGTHS[0])
        believed &= length < _LENGTHS[1]
        doubt = np.maximum(_MIN_DISPLACEMENT, _CLEARNESS * np.maximum(rms, std))
        clearness = np.abs(displacement) / doubt
        # an offset is no wander, and errors that change from point to point are none
        sums = np.cumsum([w, *regressors], axis=1)
        mean = (sums[0] - a * sums[1] - b * sums[2]) / (freedom + 1)
        steps = np.cumsum(np.diff(w, prepend=w[0]) ** 2) / freedom
        wandering = rms**2 - mean**2 > _ONLINE_WANDER**2 + steps
        wandering &= distance > _MIN_WANDER_LENGTH
        wandering &= np.abs(w) < _MAX_SPEED_ERROR * distance
    share = np.where(believed & (clearness > 1.0), np.minimum(clearness - 1.0, 1.0), 0.0)
    first = int(np.argmax(wandering)) if wandering.any() else distance.size
    share[first:] = 0.0
    if not share.any() and first == distance.size:
        return unchanged
    # the last point that is complete
    known = np.minimum(x // _FIT_SPACING, distance.size - 1).astype(int)
    share, error, length = (np.where(share > 0.0, y, 0.0)[known] for y in (share, error, length))
    displacement = -error * length * np.expm1(-x / np.maximum(length, _LENGTHS[0]))
    corrected = replace(record, s=record.s - share * displacement, v=record.v * (1 - share * error))
    if first < distance.size:
        at = max(int(np.searchsorted(known, first)), 1)  # from there on the speed alone counts
        corrected.s[at:] = corrected.s[at - 1] + x[at:] - x[at - 1]
        return Odometer(corrected)
    notes = (_describe(float(error[-1] / (1.0 - error[-1])), displacement),)
    return Odometer(corrected, notes)


def to_true_distance(record: Record, estimate: Estimate) -> tuple[Record, Estimate]:
    """Return `record` and `estimate` with the stations and speed of the distance scale that the
    estimate has found, and a note; as they are if it has found none.

    The front axle is at the first sample where it was.
    """
    if estimate.distance is None:
        return record, estimate
    (factor, std), first = estimate.distance, float(record.s[0])
    length = first + factor * (record.length - first)
    s = profile_stations(length)
    old = np.clip(first + (s - first) / factor, estimate.s[0], estimate.s[-1])
    z_std = estimate.z_std
    if z_std is not None:
        z_std = np.array([np.interp(old, estimate.s, path) for path in z_std])
    draws = estimate.draws
    if draws is not None:  # one by one: a spline takes forty times the memory of its heights
        moved_draws = np.empty((*draws.shape[:2], s.size), draws.dtype)
        for k, z in enumerate(draws):
            moved_draws[k] = CubicSpline(estimate.s, z, axis=1)(old)
        draws = moved_draws
    unsure = estimate.unsure
    if unsure is not None:
        unsure = np.interp(old, estimate.s, unsure) > 0.0
    late = 100.0 * (1.0 / factor - 1.0)
    note = (
        f"the rear axle follows the front axle {abs(late):.2f} ± {196.0 * std:.2f} % "
        f"{'later' if late > 0.0 else 'earlier'} than speed and wheelbase say; distances are "
        "corrected by that"
    )
    corrected = replace(
        estimate,
        s=s,
        z=CubicSpline(estimate.s, estimate.z, axis=1)(old),
        z_std=z_std,
        draws=draws,
        unsure=unsure,
        notes=(*estimate.notes, note),
        distance=DistanceScale(1.0, std),
    )
    moved = first + factor * (record.s - first)
    return replace(record, s=moved, v=factor * record.v, length=length), corrected
