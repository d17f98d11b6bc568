"""Road surface: heights of both wheel paths on one uniform grid.

Between grid points the height is the Catmull-Rom cubic, which passes through the samples and has
a continuous slope; before the first and after the last sample the road is level.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np

from road_envs.core.config import ConfigError, Positive
from road_envs.kernels._numba import kernel

PAD = 3  # repeated samples at each end of `Surface.padded`; spares the kernel a special case

RoadLength = Annotated[Positive, "m", "length of the road"]
DEFAULT_LENGTH: RoadLength = 100.0  # default of `RoadLength`, the length of the paper's roads

SampleSpacing = Annotated[Positive, "m", "spacing of the samples"]

MAX_SAMPLES = 50_000_000  # largest number of samples per wheel path: 400 MB
MAX_HEIGHT = 1e4  # largest height [m], up or down: beyond any on Earth, heights are in another unit
RISE_LENGTH = 0.05  # length [m] over which a rise is taken
MAX_RISE = 0.2
"""Greatest rise [m] within RISE_LENGTH that a wheel climbs: half the radius of about 0.4 m of a
7.50 R16 tyre. There its contact with a step is 60 degrees from the vertical."""


class SurfaceBuffers(NamedTuple):
    """A `Surface` as kernels read it: `padded` heights (2, N + 2 PAD), `start` and `ds` [m]."""

    padded: np.ndarray
    start: float
    ds: float


@kernel
def catmull_rom(a, b, c, d, x, per_ds):
    """Return value and slope at the fraction `x` from `b` to `c`; `per_ds`: 1 / spacing [1/m]."""
    p = 0.5 * (c - a)
    q = a - 2.5 * b + 2.0 * c - 0.5 * d
    r = 0.5 * (d - a) + 1.5 * (b - c)
    return b + x * (p + x * (q + x * r)), (p + x * (2.0 * q + x * 3.0 * r)) * per_ds


@kernel
def height_and_slope(surface, side, s):
    """Return height [m] and slope [-] of wheel path `side` of SurfaceBuffers at station `s` [m]."""
    padded, ds = surface.padded, surface.ds
    u = (s - surface.start) / ds + PAD
    u = min(max(u, 1.0), padded.shape[1] - 3.0)
    i = int(max(1.0, u))  # index 1 for NaN: the result is NaN
    a, b, c, d = padded[side, i - 1], padded[side, i], padded[side, i + 1], padded[side, i + 2]
    return catmull_rom(a, b, c, d, u - i, 1.0 / ds)


@kernel
def _sample_surface(padded, start, ds, s, z, slope):
    """Write heights `z` and slopes `slope`, both (2, M), at the stations `s` (M,)."""
    surface = SurfaceBuffers(padded, start, ds)
    for side in range(2):
        for k in range(s.size):
            z[side, k], slope[side, k] = height_and_slope(surface, side, s[k])


@dataclass(frozen=True, eq=False)
class Surface:
    """Heights `z` (2, N) [m] of the left and right wheel path with the spacing `ds` [m].

    The first sample is at station `start` [m]. `notes` record how the surface was made ("10 m tile
    mirrored 10 times"). Raises ValueError on heights that are not finite or beyond MAX_HEIGHT,
    fewer than 4 samples or a spacing that is not positive.
    """

    z: np.ndarray
    ds: float
    start: float = 0.0
    name: str = "surface"
    notes: tuple[str, ...] = ()

    def __post_init__(self):
        z = np.array(self.z, dtype=float)
        if z.ndim != 2 or z.shape[0] != 2 or z.shape[1] < 4:
            raise ValueError(f"{self.name}: heights must be (2, N) with N >= 4, got {z.shape}")
        if not np.isfinite(z).all():
            raise ValueError(f"{self.name}: heights must be finite, got NaN or infinity")
        if (highest := float(np.abs(z).max())) > MAX_HEIGHT:
            raise ValueError(
                f"{self.name}: heights up to {highest:.4g} m; the limit is {MAX_HEIGHT:g} m"
            )
        if not 0.0 < self.ds < np.inf:
            raise ValueError(
                f"{self.name}: the spacing ds must be positive and finite, got {self.ds}"
            )
        if not np.isfinite(self.start):
            raise ValueError(f"{self.name}: the first station must be finite, got {self.start}")
        z.flags.writeable = False
        object.__setattr__(self, "z", z)

    @property
    def s(self) -> np.ndarray:
        """Stations (N,) [m] of the samples."""
        return self.start + self.ds * np.arange(self.z.shape[1])

    @property
    def end(self) -> float:
        """Station [m] of the last sample."""
        return self.start + self.ds * (self.z.shape[1] - 1)

    @property
    def length(self) -> float:
        """Length [m] from the first to the last sample."""
        return self.end - self.start

    @cached_property
    def padded(self) -> np.ndarray:
        """Heights (2, N + 2 PAD) with PAD repeated samples at both ends, as kernels read them."""
        # left writeable like its copies and pickles: numba compiles again for read-only arrays
        return np.pad(self.z, ((0, 0), (PAD, PAD)), mode="edge")

    @cached_property
    def buffers(self) -> SurfaceBuffers:
        """The surface as kernels take it."""
        return SurfaceBuffers(self.padded, float(self.start), float(self.ds))

    def height(self, s: np.ndarray) -> np.ndarray:
        """Return the heights (2, ...) [m] at stations `s` [m] of any shape."""
        if np.all(np.less_equal(s, self.start)):  # level there: no use of compiled code
            return np.broadcast_to(self.z[:, :1], (2, np.size(s))).reshape(2, *np.shape(s)).copy()
        return self._sample(s)[0]

    def slope(self, s: np.ndarray) -> np.ndarray:
        """Return the slopes dz/ds (2, ...) [-] at stations `s` [m] of any shape."""
        return self._sample(s)[1]

    def check_climbable(self) -> None:
        """Raise ConfigError on a step that no wheel can climb: MAX_RISE within RISE_LENGTH."""
        cells = max(1, int(RISE_LENGTH / self.ds))
        rise = self.z[:, cells:] - self.z[:, :-cells]
        if rise.size and (most := rise.max()) > MAX_RISE:
            side, at = np.unravel_index(rise.argmax(), rise.shape)
            raise ConfigError(
                f"{self.name}: at {self.start + self.ds * at:.2f} m the {('left', 'right')[side]} "
                f"wheel path rises by {1e3 * most:.0f} mm within {1e3 * cells * self.ds:.0f} mm; "
                f"no wheel climbs more than half its radius, {1e3 * MAX_RISE:.0f} mm: scale the "
                "heights down, or check their unit"
            )

    def _sample(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = np.asarray(s, dtype=float)
        z, slope = np.empty((2, s.size)), np.empty((2, s.size))
        _sample_surface(*self.buffers, s.ravel(), z, slope)
        return z.reshape(2, *s.shape), slope.reshape(2, *s.shape)


def enveloped(surface: Surface, contact_length: float) -> Surface:
    """Return the surface enveloped by a tyre: moving average over the contact length L [m].

    This is the rigid fixed footprint of Captain, Boghani & Wormley (1979, "Analytical tire models
    for dynamic vehicle simulation", Vehicle System Dynamics 8): a sine of n [cycles/m] is scaled by
    sin(pi n L) / (pi n L). The grid is that of `surface`, extended by half a contact length at both
    ends. Raises ValueError on a length that is not positive.
    """
    if not 0 < contact_length < np.inf:
        raise ValueError(f"the contact length must be positive and finite, got {contact_length} m")
    ds, half = surface.ds, 0.5 * contact_length
    beyond = int(np.ceil(half / ds)) + 1  # + 1: the cubic is curved up to one cell before the end
    ends = surface.start + ds * np.arange(-2 * beyond, surface.z.shape[1] + 2 * beyond + 1)
    level = surface.z[:, :1]  # subtracted, so that cumulative areas stay small at any altitude

    def mean_between(begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        # two-point Gauss-Legendre quadrature, exact for cubics
        nodes = 0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0)
        points = [begin + x * (end - begin) for x in nodes]
        return 0.5 * sum(surface.height(s) for s in points) - level

    areas = np.cumsum(ds * mean_between(ends[:-1], ends[1:]), axis=1)
    areas = np.pad(areas, ((0, 0), (1, 0)))

    def area_before(s: np.ndarray) -> np.ndarray:
        i = np.floor((s - ends[0]) / ds).astype(int)
        return areas[:, i] + (s - ends[i]) * mean_between(ends[i], s)

    s = surface.start + ds * np.arange(-beyond, surface.z.shape[1] + beyond)
    z = level + (area_before(s + half) - area_before(s - half)) / contact_length
    note = f"enveloped over a contact length of {1000.0 * contact_length:.0f} mm"
    return replace(surface, z=z, start=float(s[0]), notes=(*surface.notes, note))


def check_size(length: float, ds: float, what: str = "length") -> None:
    """Raise ConfigError if `length` [m], called `what`, has over MAX_SAMPLES steps of `ds` [m]."""
    if not length / ds < MAX_SAMPLES:
        raise ConfigError(
            f"a {what} of {length:g} m in steps of {ds:g} m has more than {MAX_SAMPLES:,} samples; "
            "choose a shorter road or a larger step"
        )
