"""Map from white noise u to both wheel paths, such that they have the prior's spectrum.

    e = irfft(A(n) rfft(u))          increments of the mean path and of half the difference
    c = c_0 + cumsum(scale e)        spline coefficients of left = mean + half, right = mean - half

u (2, K) is standard normal, so |u|² / 2 is the road's share of the cost; A(n) is that of
`estimators.common.road_prior`. `scale` is the local roughness of each wheel path relative to its
spectrum: a pothole in a level road is no part of a stationary process. Where it is 0 the road is
level.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq
from scipy.ndimage import spline_filter1d

from estimators.map_smoother.tuning import TUNING
from road_envs.records.record import Profile

TO_WHEEL_PATHS = np.array([[1.0, 1.0], [1.0, -1.0]])
"""From mean and half difference to left and right; half of it leads back."""


class RoadNodes(NamedTuple):
    """Nodes of the road: `size` of them, `ds` [m] apart from the station `origin` [m] on."""

    origin: float
    ds: float
    size: int


@dataclass(frozen=True, eq=False)
class RoadTransform:
    """Linear map from `u` to the coefficients of both wheel paths, of nodes as in `RoadNodes`.
    `background` (2, K) [m] are those for u = 0; `free` (K,) is 1 where the road may rise or fall,
    else 0; `prior_amplitude` (2, K // 2 + 1) [m] and `density` (K // 2 + 1,), by which a drive
    scaled its square, make A(n); `local` (2, K) is the local roughness, relative to it, 1 on an
    even road.
    """

    origin: float
    ds: float
    background: np.ndarray
    free: np.ndarray
    prior_amplitude: np.ndarray
    density: np.ndarray
    local: np.ndarray
    may_be_uneven: bool = True

    @cached_property
    def amplitude(self) -> np.ndarray:
        """A(n) (2, K // 2 + 1) [m]."""
        return self.prior_amplitude * np.sqrt(self.density)

    @property
    def size(self) -> int:
        return self.free.size

    @property
    def stations(self) -> np.ndarray:
        """Stations (K,) [m] of the nodes."""
        return self.origin + self.ds * np.arange(self.size)

    @property
    def n(self) -> np.ndarray:
        """Spatial frequencies (K // 2 + 1,) [cycles/m] of the spectrum of `u`."""
        return rfftfreq(self.size, self.ds)

    @property
    def is_uneven(self) -> bool:
        """True if the road is rougher in some places than in others, as by obstacles."""
        return bool(np.ptp(self.local) > 0.0)

    @property
    def is_level_between_obstacles(self) -> bool:
        """True if nearly all of the roughness is in a small part of the road."""
        square = self.local[:, self.free > 0] ** 2
        return bool(np.log(square.mean()) - np.log(square).mean() > TUNING.level_contrast)

    def apply(self, u: np.ndarray) -> np.ndarray:
        """Return the change (2, K) [m] of the coefficients by `u` (2, K)."""
        e = irfft(self.amplitude * rfft(u, axis=1), self.size, axis=1)
        return np.cumsum(self.free * self.local * (TO_WHEEL_PATHS @ e), axis=1)

    def apply_transpose(self, c: np.ndarray) -> np.ndarray:
        """Apply the transpose of `apply`: from coefficients (2, K) to `u` (2, K)."""
        rest = np.cumsum(c[:, ::-1], axis=1)[:, ::-1]  # an increment lifts all nodes behind it
        e = TO_WHEEL_PATHS @ (self.free * self.local * rest)
        return irfft(self.amplitude * rfft(e, axis=1), self.size, axis=1)

    def coefficients(self, u: np.ndarray) -> np.ndarray:
        """Return the coefficients (2, K) [m] of both wheel paths."""
        return self.background + self.apply(u)

    def whiten(self, increments: np.ndarray) -> np.ndarray:
        """Return the noise (2, K) of the `increments` (2, K) [m] of both wheel paths where free."""
        e = 0.5 * TO_WHEEL_PATHS @ (self.free * increments / self.local)
        return irfft(rfft(e, axis=1) / self.amplitude, self.size, axis=1)

    def convert_noise(self, u: np.ndarray, other: "RoadTransform") -> np.ndarray:
        """Return the noise (2, K) by which this map gives the road that `other` gives by `u`."""
        return self.whiten(np.diff(other.apply(u), axis=1, prepend=0.0))

    def noise_of(self, profile: Profile) -> np.ndarray:
        """Return the noise (2, K) of the road of a `profile`, which begins at height 0."""
        c = self.spline_of(Profile(profile.s, profile.z - profile.z[:, :1]))
        return self.whiten(np.diff(c, axis=1, prepend=0.0))

    def spline_of(self, profile: Profile) -> np.ndarray:
        """Return the coefficients (2, K) [m] of the spline through a `profile` at the nodes."""
        z = np.array([np.interp(self.stations, profile.s, path) for path in profile.z])
        return spline_filter1d(z, order=3, axis=1, mode="nearest")

    def transfer_function(self) -> np.ndarray:
        """Return the response (2, K // 2 + 1) [m] of mean and half difference to `u`."""
        delay = np.exp(-2j * np.pi * self.n[1:] * self.ds)
        integral = np.concatenate([[0.0], 1.0 / (1.0 - delay)])  # the datum is not estimated
        return self.amplitude * integral * np.sinc(self.n * self.ds) ** 4
