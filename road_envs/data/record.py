"""The benchmark's nouns as plain frozen data: record (what the instruments saw), profile (heights
of both wheel paths; the truth when it comes from the road) and estimate.

Wheel paths stand in the order left, right; wheels in the order FL, FR, RL, RR; sensors in the
order RF, LR, RR. SI units.
"""

from dataclasses import dataclass

import numpy as np

SENSORS = ("RF", "LR", "RR")
PROFILE_SPACING = 100.0 / 3964
"""The paper's spacing of profile samples [m]: 3964 points over 100 m (section 5)."""

SCORED_N_MIN, SCORED_N_MAX = 0.2, 1.8
"""Band [cycles/m] in which heights are judged, as far as the speed lets them through."""
SCORED_F_MAX = 0.9 * 25.0
"""Nine tenths of the accelerometers' low-pass [Hz]."""


def scored_band(v: float) -> tuple[float, float]:
    """Band [cycles/m] in which a drive at `v` [m/s] is judged: 0.2 to min(1.8, 0.9 x 25 Hz / v).

    Raises ValueError if nothing is left of it.
    """
    n_hi = min(SCORED_N_MAX, SCORED_F_MAX / v)
    if not n_hi > SCORED_N_MIN:
        raise ValueError(
            f"at {v:g} m/s nothing above {SCORED_N_MIN} cycles/m passes the 25 Hz low-pass"
        )
    return SCORED_N_MIN, n_hi


def profile_stations(length: float, ds: float = PROFILE_SPACING) -> np.ndarray:
    """Stations (M,) [m] from 0, `ds` apart, on which a road of `length` [m] is judged."""
    return ds * np.arange(int(np.floor(length / ds + 1e-9)))


@dataclass(frozen=True)
class Profile:
    """Heights `z` (2, M) [m] of the left and right wheel path at even stations `s` (M,) [m]."""

    s: np.ndarray
    z: np.ndarray

    @property
    def ds(self) -> float:
        """Spacing of the stations [m]."""
        return float(self.s[1] - self.s[0])


@dataclass(frozen=True)
class Estimate(Profile):
    """An estimated profile, and where a method has it `z_std` (2, M) [m]: the standard deviation of
    its error in the judged band, for the datum and the drift are nobody's claim.
    """

    z_std: np.ndarray | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Record:
    """What the instruments of one drive saw, sampled evenly in time.

    `t` (N,) time [s]; `a` (3, N) vertical body accelerations at RF, LR, RR [m/s²], raw, and NaN
    where a sample was lost;
    `v` (N,) measured speed [m/s]; `s` (N,) odometer [m]: station of the front axle, 0 at the
    start of the road of `length` [m] whose profile is wanted; `spring_stiff`, `damper_high` (N, 4)
    bool: the commanded spring and damper state of each strut (ride = neither, handling = both).
    """

    t: np.ndarray
    a: np.ndarray
    v: np.ndarray
    s: np.ndarray
    spring_stiff: np.ndarray
    damper_high: np.ndarray
    length: float

    @property
    def fs(self) -> float:
        """Sampling rate [Hz]."""
        return float((self.t.size - 1) / (self.t[-1] - self.t[0]))

    def interpolate(self, stations: np.ndarray, signals: np.ndarray) -> np.ndarray:
        """`signals` (k, N) of this record, at the times when the front axle passed `stations`."""
        return np.array([np.interp(stations, self.s, x) for x in signals])
