"""Data classes of the benchmark: record, profile and estimate. SI units.

A record holds the measured signals of a drive, a profile the heights of both wheel paths. The
order of wheel paths is left, right; that of wheels FL, FR, RL, RR; that of the paper's sensors RF,
LR, RR.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from road_envs.records.accelerometers import Accelerometer

SENSORS = ("RF", "LR", "RR")  # the paper's, on the body at right front, left rear, right rear
PROFILE_SPACING = 100.0 / 3964  # of a profile's stations [m], as in the paper (section 5)
SCORED_N_MIN, SCORED_N_MAX = 0.2, 1.8  # band [cycles/m] in which heights are scored
F_C = 25.0  # cut-off of the low-pass of the processed accelerations [Hz]
SCORED_F_MAX = 0.9 * F_C  # highest scored frequency [Hz]
LEAST_GAIN = 0.1  # of a low-pass that is undone: noise of what is behind it rises tenfold


def scored_band(v: float) -> tuple[float, float]:
    """Return the band [cycles/m] in which a drive at `v` [m/s] is scored: 0.2 to min(1.8, 22.5 / v)

    Raises ValueError if it is empty.
    """
    n_hi = min(SCORED_N_MAX, SCORED_F_MAX / v)
    if not n_hi > SCORED_N_MIN:
        raise ValueError(
            f"at {3.6 * v:g} km/h nothing above {SCORED_N_MIN} cycles/m passes the 25 Hz low-pass; "
            f"drive slower than {3.6 * SCORED_F_MAX / SCORED_N_MIN:g} km/h"
        )
    return SCORED_N_MIN, n_hi


class LowPass(NamedTuple):
    """Low-pass without phase that processed accelerations have passed.

    It is that of a Butterworth filter of the `order` and the cut-off `f_c` [Hz], run forwards and
    backwards, as the paper's. Without an order its gain is 1 up to `f_c`, and unknown above.
    """

    f_c: float
    order: int | None = 4

    @property
    def bandwidth(self) -> float:
        """Frequency [Hz] up to which the gain is LEAST_GAIN or more."""
        if self.order is None:
            return self.f_c
        return self.f_c * (1.0 / LEAST_GAIN - 1.0) ** (0.5 / self.order)

    def gain(self, f: np.ndarray, fs: float) -> np.ndarray:
        """Return the gain [-] at `f` [Hz] of the digital filter at the sampling rate `fs` [Hz]."""
        if self.order is None:
            return np.where(f <= self.f_c, 1.0, 0.0)
        with np.errstate(over="ignore"):  # towards fs / 2 the gain is 0
            ratio = np.tan(np.pi * np.minimum(f / fs, 0.5)) / np.tan(np.pi * self.f_c / fs)
            return np.asarray(1.0 / (1.0 + ratio ** (2 * self.order)))


def profile_stations(length: float) -> np.ndarray:
    """Return the stations (M,) [m] at which a road of `length` [m] is scored."""
    return PROFILE_SPACING * np.arange(int(np.floor(length / PROFILE_SPACING + 1e-9)))


@dataclass(frozen=True)
class Profile:
    """Heights `z` (2, M) [m] of left and right wheel path at equidistant stations `s` (M,) [m]."""

    s: np.ndarray
    z: np.ndarray

    @property
    def ds(self) -> float:
        """Spacing of the stations [m]."""
        return float(self.s[1] - self.s[0])


class DistanceScale(NamedTuple):
    """True distance over that of an odometer: its `factor`, and the standard deviation `std`."""

    factor: float
    std: float


@dataclass(frozen=True)
class Estimate(Profile):
    """Estimated profile, with notes of the estimator.

    What a method or drive lacks is None. `z_std` (2, M) [m] is the standard deviation of the error
    in the scored band; datum and drift are excluded. `draws` (D, 2, M) [m] are roads drawn from the
    posterior, in all waves, with the errors of the vehicle. `distance` is the scale of the record's
    odometer, on which the stations are. `s_std` [m] is the standard deviation of the stations, by
    about which all are shifted together, where the position fixes of the record wander; heights are
    then those of a road that begins elsewhere by that, and `z_std` is that of heights compared
    after alignment. `unsure` (M,) bool marks stations at which the vehicle turned, changed its
    speed hard or stood, or whose heights no wheel load supports. `residual` is the RMS of what the
    method's model leaves of the accelerations, over that of the sensors' noise. `speed` [m/s] is
    that of the drive.
    """

    z_std: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    speed: float | None = None
    distance: DistanceScale | None = None
    unsure: np.ndarray | None = None
    draws: np.ndarray | None = None
    residual: float | None = None
    s_std: float | None = None


@dataclass(frozen=True)
class Record:
    """Measured signals of one drive, sampled at a constant rate.

    `t` (N,) time [s]; `a` (k, N) unprocessed vertical accelerations [m/s²], NaN where a sample was
    lost; `v` (N,) measured speed [m/s]; `s` (N,) odometer [m]: station of the front axle, 0 at the
    start of the road of `length` [m] whose profile is to be estimated; `spring_stiff`,
    `damper_high` (N, 4) bool: commanded spring and damper state of each strut (ride = neither,
    handling = both).

    `sensors` are the k accelerometers by name, in the order of the rows of `a`; None stands for
    those of the instruments that an estimator assumes: by default the paper's RF, LR and RR on the
    body. `low_pass` is the filter that `a` has passed after it was sampled.
    """

    t: np.ndarray
    a: np.ndarray
    v: np.ndarray
    s: np.ndarray
    spring_stiff: np.ndarray
    damper_high: np.ndarray
    length: float
    sensors: Mapping[str, Accelerometer] | None = None
    low_pass: LowPass | None = None

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the rows of `a`."""
        return SENSORS if self.sensors is None else tuple(self.sensors)

    @property
    def commands(self) -> np.ndarray:
        """Commanded states as bytes (N,): bits 0 to 3 are stiff springs, 4 to 7 high damping."""
        flags = np.concatenate([self.spring_stiff, self.damper_high], axis=1)
        return np.packbits(flags, axis=1, bitorder="little")[:, 0]

    @property
    def is_switched(self) -> bool:
        """Whether a strut changes its state during the drive."""
        return bool((self.commands != self.commands[0]).any())

    @property
    def bandwidth(self) -> float:
        """Frequency [Hz] up to which the accelerations contain the motion."""
        return np.inf if self.low_pass is None else self.low_pass.bandwidth

    @property
    def fs(self) -> float:
        """Sampling rate [Hz]."""
        return float((self.t.size - 1) / (self.t[-1] - self.t[0]))

    def select(self, samples: slice | np.ndarray) -> "Record":
        """Return the record of some samples, a slice or a mask (N,)."""
        over_time = ("t", "v", "s", "spring_stiff", "damper_high")
        parts = {name: getattr(self, name)[samples] for name in over_time}
        return replace(self, a=self.a[:, samples], **parts)

    def interpolate(self, stations: np.ndarray, signals: np.ndarray) -> np.ndarray:
        """Return `signals` (k, N) of this record interpolated to `stations` of the front axle."""
        return np.array([np.interp(stations, self.s, x) for x in signals])
