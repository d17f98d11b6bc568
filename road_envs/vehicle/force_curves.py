"""Force curves: breakpoints from YAML, piecewise cubics through them, uniform tables for kernels.

The paper evaluates its measured strut curves with MATLAB's `ppval`, that is as piecewise cubics
(section 2.3). The cubics here are PCHIP (Fritsch & Carlson 1980), which does not overshoot between
breakpoints. For kernels each curve is tabulated on a uniform grid as the Hermite cubic of its
values and slopes: the table is exact where the breakpoints are grid points, and needs no search.
Beyond its last breakpoint a curve is extrapolated linearly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from road_envs.core.config import Finite, Settings
from road_envs.kernels._numba import kernel
from road_envs.kernels.simd import integer_part, maximum, minimum
from road_envs.kernels.simd_arrays import load_four


@dataclass(frozen=True, kw_only=True)
class Curve(Settings):
    """A force over velocity or displacement, given at breakpoints."""

    x: Annotated[tuple[Finite, ...], "m or m/s", "breakpoints, increasing"]
    F: Annotated[tuple[Finite, ...], "N", "force at each breakpoint"]

    def __post_init__(self):
        super().__post_init__()
        if len(self.x) != len(self.F) or len(self.x) < 2:
            sizes = f"got {len(self.x)} and {len(self.F)}"
            raise ValueError(f"x and F must have the same length, at least 2, {sizes}")
        if not (np.diff(self.x) > 0).all():
            raise ValueError(f"x must increase from each breakpoint to the next, got {self.x}")

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the force [N] and its derivative at `x` of any shape."""
        knots, (a, b, c, d) = np.array(self.x), _pchip_coefficients(self.x, self.F)
        inside = np.clip(x, knots[0], knots[-1])
        k = np.searchsorted(knots[1:-1], inside, "right")
        t = inside - knots[k]
        value = a[k] + b[k] * t + c[k] * (t * t) + d[k] * (t * t * t)
        slope = b[k] + 2.0 * c[k] * t + 3.0 * d[k] * (t * t)
        return value + slope * (x - inside), slope

    def scaled(self, factor: float) -> "Curve":
        """Return the curve with its forces multiplied by `factor`."""
        return self if factor == 1.0 else Curve(x=self.x, F=tuple(factor * F for F in self.F))


def _pchip_coefficients(x: Sequence[float], y: Sequence[float]) -> np.ndarray:
    """Return coefficients (4, N - 1) of the cubics between `x` (N,), in powers of x - x_i.

    The slope at a breakpoint is the weighted harmonic mean of the chords beside it, and 0 at an
    extremum; at the ends it is the parabola's, limited to keep the shape. These are the cubics of
    `scipy.interpolate.PchipInterpolator`, which takes a fifth of an environment's start to import.
    """
    z, h = np.asarray(y, dtype=float), np.diff(np.asarray(x, dtype=float))
    chord = np.diff(z) / h
    if h.size == 1:
        return np.array([z[:1], chord, [0.0], [0.0]])
    slope = np.zeros(z.size)
    rises = chord[:-1] * chord[1:] > 0.0
    before, after = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (before / chord[:-1] + after / chord[1:]) / (before + after)
        slope[1:-1] = np.where(rises, 1.0 / mean, 0.0)
    slope[0] = _end_slope(h[0], h[1], chord[0], chord[1])
    slope[-1] = _end_slope(h[-1], h[-2], chord[-1], chord[-2])
    bend = (slope[:-1] + slope[1:] - 2.0 * chord) / h
    return np.array([z[:-1], slope[:-1], (chord - slope[:-1]) / h - bend, bend / h])


def _end_slope(h: float, next_h: float, chord: float, next_chord: float) -> float:
    """Return the slope at an end, from widths and chords of the cell there and of the next one."""
    slope = ((2.0 * h + next_h) * chord - h * next_chord) / (h + next_h)
    if np.sign(slope) != np.sign(chord):
        return 0.0
    if np.sign(chord) != np.sign(next_chord) and abs(slope) > 3.0 * abs(chord):
        return 3.0 * chord
    return slope


Law = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""A force over velocity or displacement with its derivative, such as a Curve."""


def tabulate(curves: Sequence[Law], x_0: float, dx: float, cells: int) -> np.ndarray:
    """Tabulate the sum of `curves`: coefficients (cells + 2, 4) in powers of the cell fraction. The
    grid starts at `x_0` and has the spacing `dx`; a cell at each end continues it linearly.
    """
    x = x_0 + dx * np.arange(cells + 1)
    values, slopes = np.sum([curve(x) for curve in curves], axis=0)
    return _hermite(values, slopes * dx)


def _hermite(values: np.ndarray, rises: np.ndarray) -> np.ndarray:
    """Return coefficients as of `tabulate` from values and rises per cell (..., cells + 1)."""
    first, last = rises[..., :1], rises[..., -1:]
    values = np.concatenate([values[..., :1] - first, values, values[..., -1:] + last], axis=-1)
    rises = np.concatenate([first, rises, last], axis=-1)
    a, b, end, rise = values[..., :-1], rises[..., :-1], rises[..., 1:], np.diff(values)
    coefficients = np.stack([a, b, 3.0 * rise - 2.0 * b - end, b + end - 2.0 * rise], axis=-1)
    coefficients[..., [0, -1], 2:] = 0.0  # exactly linear
    return coefficients


def gaussian_smoothed(tables: np.ndarray, x_0: float, dx: float, width: float) -> np.ndarray:
    """Smooth `tables` (K, cells + 2, 4) with a Gaussian kernel of standard deviation `width`."""
    x = x_0 + dx * np.arange(tables.shape[1] - 1)
    u = np.linspace(-4.0, 4.0, 161)
    weight = np.exp(-0.5 * u**2) / np.exp(-0.5 * u**2).sum()
    values = np.empty((tables.shape[0], x.size, u.size, 2))
    interpolate_tables(tables, x_0, dx, x[:, None] + width * u, values)
    mean = np.einsum("kxui,u->ikx", values, weight)
    return _hermite(mean[0], dx * mean[1])


@kernel
def _locate(tables, k, x_0, dx, x):
    """Return the cubic's coefficients (4 numbers) of table `k` in the cell of `x`, and where in it.
    The fraction of the cell is below 0 or above 1 beyond the ends, where the cubic is a line.
    """
    cells = float(tables.shape[1])
    u = (x - (x_0 - dx)) / dx
    i = integer_part(minimum(maximum(u, 0.0), cells - 1.0))
    return load_four(tables, 4.0 * cells * k, 4, i), u - i


@kernel
def interpolate_table(tables, k, x_0, dx, x):
    """Return value and derivative of table `k` of `tables` (K, cells + 2, 4) at `x`."""
    (a, b, c, d), t = _locate(tables, k, x_0, dx, x)
    slope = b + t * (2.0 * c + t * 3.0 * d)
    return a + t * (b + t * (c + t * d)), slope / dx


@kernel
def interpolate_tables(tables, x_0, dx, x, out):
    """Write values and derivatives (K, M, N, 2) of all tables at `x` (M, N) to `out`."""
    for k in range(tables.shape[0]):
        for i in range(x.shape[0]):
            for j in range(x.shape[1]):
                out[k, i, j, 0], out[k, i, j, 1] = interpolate_table(
                    tables, float(k), x_0, dx, x[i, j]
                )


@kernel
def second_derivative(tables, k, x_0, dx, x):
    """Return the second derivative of table `k` at `x`: right-sided, and 0 beyond the ends."""
    (_, _, c, d), t = _locate(tables, k, x_0, dx, x)
    return (2.0 * c + 6.0 * d * t) / (dx * dx)
