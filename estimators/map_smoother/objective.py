"""Cost function of a road: misfit of the measurements of its passes, and improbability of the road.

    cost(x) = sum over passes p 1/2 |y_p - a_p(road)|²_(R_p^-1) + 1/2 |x|²

x holds the white noise u of the road (2 K), which all passes share; the own unknowns of each pass
(`one_pass.py`); and for each pass but the first the shift of its stations against the road at some
knots, linear between them: odometers differ, and profiles that are centimetres apart would count as
noise. To first order a shift d(s) changes the road under this pass alone, by d(s) dz/ds. The
gradient is that of the computed steps (`road_envs.simulation.tape`), the Hessian that of Gauss and
Newton, I + J' R^-1 J. A single drive is one pass without shifts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import spline_filter1d

from estimators.common.model_inputs import ModelInputs
from estimators.map_smoother.one_pass import LinearizedPass, Pass
from estimators.map_smoother.road_prior import RoadTransform
from estimators.map_smoother.tuning import TUNING
from road_envs.vehicle.equations import Plant

Means = Sequence[np.ndarray]
"""Block means (S, J) of each pass."""


def shift_inputs(inputs: ModelInputs, knots: np.ndarray, shift: np.ndarray) -> ModelInputs:
    """Inputs with stations moved by `shift` (M,) [m] at `knots` (M,), constant beyond the ends."""
    if not shift.any():
        return inputs
    slope = np.concatenate([[0.0], np.diff(shift) / np.diff(knots), [0.0]])
    stretch = 1.0 + slope[np.searchsorted(knots, inputs.s)]
    moved = inputs.s + np.interp(inputs.s, knots, shift)
    return replace(inputs, s=moved, v=inputs.v * stretch)


@dataclass(frozen=True, eq=False)
class Objective:
    """Cost function of one window of P `passes` over one `road`; `knots` (M,) are the stations [m]
    at which the shifts of all but the first are unknown.
    """

    road: RoadTransform
    passes: tuple[Pass, ...]
    knots: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def size(self) -> int:
        return 2 * self.road.size + sum(one.size for one in self.passes) + self.n_shifts

    @property
    def n_shifts(self) -> int:
        return (len(self.passes) - 1) * self.knots.size

    @property
    def is_underdetermined(self) -> bool:
        """True if a road explains all measurements, as of no more sensors than wheel paths."""
        return sum(len(one.model.sensor_rows) for one in self.passes) <= 2

    @property
    def noise_variance(self) -> np.ndarray:
        """Variance (P,) [(m/s²)²] of a sample's noise in each pass."""
        return np.array([one.model.noise_variance for one in self.passes])

    def split(self, x: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
        """Split the unknowns into `u` (2, K), those of each pass, and the shifts (P, M) [m] of the
        passes at the knots, of which those of the first are 0.
        """
        sizes = [2 * self.road.size, *(one.size for one in self.passes)]
        u, *own, free = np.split(x, np.cumsum(sizes))
        shifts = np.zeros((len(self.passes), self.knots.size))
        shifts[1:] = TUNING.shift_std * free.reshape(shifts[1:].shape)
        return u.reshape(2, -1), own, shifts

    def coefficients(self, x: np.ndarray) -> np.ndarray:
        """Coefficients (2, K) [m] of the road."""
        return self.road.coefficients(self.split(x)[0])

    def from_noise(self, u: np.ndarray) -> np.ndarray:
        """Unknowns with the noise `u` (2, K) of the road; all others are 0."""
        return np.pad(u.ravel(), (0, self.size - u.size))

    def linearize(self, x: np.ndarray, plants: Sequence[Plant] | None = None) -> "Linearization":
        """Linearize at `x`, for the vehicles of the passes or other `plants`, and for the
        instruments' noise. Raises ArithmeticError.
        """
        u, own, shifts = self.split(x)
        c, none = self.road.coefficients(u), [None] * len(self.passes)
        linearized = []
        for one, shift, values, plant in zip(self.passes, shifts, own, plants or none, strict=True):
            moved = replace(one, inputs=shift_inputs(one.inputs, self.knots, shift))
            linearized.append(moved.linearize(c, values, plant))
        return Linearization(self, x, tuple(linearized))


@dataclass(frozen=True, eq=False)
class Linearization:
    """An objective linearized at `x`: the linearizations of its `passes`."""

    objective: Objective
    x: np.ndarray
    passes: tuple[LinearizedPass, ...]

    @property
    def cost(self) -> float:
        pairs = zip(self.residual, self.apply_inverse_covariance(self.residual), strict=True)
        misfit = sum(0.5 * float(np.sum(residual * weighted)) for residual, weighted in pairs)
        return misfit + 0.5 * float(self.x @ self.x)

    def cost_under(self, noise_scale: np.ndarray) -> float:
        """The cost at `x` under `noise_scale` (P,) times the noise of the instruments."""
        pairs = zip(self.passes, noise_scale, strict=True)
        return self.with_noise([one.source.information / k for one, k in pairs]).cost

    def gradient(self) -> np.ndarray:
        return self.x - self.adjoint(self.apply_inverse_covariance(self.residual))

    def hessian_product(self, dx: np.ndarray) -> np.ndarray:
        """The Gauss-Newton Hessian times `dx`."""
        return dx + self.adjoint(self.apply_inverse_covariance(self.tangent(dx)))

    @property
    def residual(self) -> list[np.ndarray]:
        """Residual (S, J) [m/s²] of the measurements of each pass."""
        return [one.residual for one in self.passes]

    @property
    def inverse_variance(self) -> list[np.ndarray]:
        """Inverse variance (S, J) of the noise of each pass."""
        return [one.inverse_variance for one in self.passes]

    def apply_inverse_covariance(self, means: Means) -> list[np.ndarray]:
        pairs = zip(self.passes, means, strict=True)
        return [one.apply_inverse_covariance(part) for one, part in pairs]

    def tangent(self, dx: np.ndarray) -> list[np.ndarray]:
        """Change of the predicted block means by a small `dx`."""
        u, own, shifts = self.objective.split(dx)
        dc = self.objective.road.apply(u)
        # a shifted pass sees the road's slope times its shift beside the change of the road
        roads = [dc + (shift @ self._hats) * self._slope if shift.any() else dc for shift in shifts]
        rows = zip(self.passes, roads, own, strict=True)
        return [one.tangent(change, values) for one, change, values in rows]

    def adjoint(self, means: Means) -> np.ndarray:
        """Apply the transpose of `tangent`: from block means to `x`."""
        pairs = [one.adjoint(part) for one, part in zip(self.passes, means, strict=True)]
        u = self.objective.road.apply_transpose(np.sum([c for c, _ in pairs], axis=0))
        moved = [np.sum(self._slope * c, axis=0) for c, _ in pairs[1:] if self.objective.n_shifts]
        shifts = (TUNING.shift_std * self._hats @ one for one in moved)
        return np.concatenate([u.ravel(), *(own for _, own in pairs), *shifts])

    @cached_property
    def _slope(self) -> np.ndarray:
        """Coefficients (2, K) [-] of the spline through the road's slopes at the nodes."""
        c, ds = self.objective.coefficients(self.x), self.objective.road.ds
        # at the nodes the slope of the spline is the central difference of its coefficients
        return spline_filter1d(np.gradient(c, ds, axis=1), order=3, axis=1, mode="nearest")

    @cached_property
    def _hats(self) -> np.ndarray:
        """Weights (M, K) of the shifts at the nodes."""
        stations, knots = self.objective.road.stations, self.objective.knots
        return np.array([np.interp(stations, knots, unit) for unit in np.eye(knots.size)])

    @cached_property
    def _shift_information(self) -> np.ndarray:
        """Information (P - 1, M) of measurements of unit variance on shifts of unit prior, about:
        that of a uniform shift, shared out among the knots by where the power is.
        """
        knots = self.objective.knots
        information = np.zeros((len(self.passes) - 1, knots.size))
        for k, one in enumerate(self.passes[1:] if knots.size else []):
            uniform = one.read_road(np.zeros(one.tape.end.size), self._slope)
            power = np.sum(one.source.measurements.sample_count * uniform**2, axis=0)
            s = one.source.inputs.s[:: one.source.inputs.s.size // power.size][: power.size]
            hats = [np.interp(s, knots, unit) for unit in np.eye(knots.size)]
            information[k] = TUNING.shift_std**2 * np.square(hats) @ power
        return information

    def offset_scale(self, noise_variance: np.ndarray, start_information: Means) -> np.ndarray:
        """Root of the Hessian's diagonal behind the unknowns of the road, about, under noise
        variances (P,), with the information (14,) on the initial state of each pass.
        """
        rows = zip(self.passes, noise_variance, start_information, strict=True)
        own = [one.source.offset_scale(*rest) for one, *rest in rows]
        shifts = np.sqrt(1.0 + self._shift_information / noise_variance[1:, None])
        return np.concatenate([*own, shifts.ravel()])

    def draw_noise(self, rng: np.random.Generator) -> list[np.ndarray]:
        """R^-1/2 times white noise for each pass."""
        return [one.shape_noise(rng.standard_normal(one.residual.shape)) for one in self.passes]

    def of_pass(self, k: int) -> "Linearization":
        """The linearization of the objective of the pass `k` alone, on the same road."""
        one, own = self.passes[k], self.passes[k].own
        u = self.x[: 2 * self.objective.road.size]
        alone = Objective(self.objective.road, (one.source,))
        return Linearization(alone, np.concatenate([u, own]), (one,))

    def with_noise(
        self, inverse_variance: Means, weights: Sequence[np.ndarray | None] | None = None
    ) -> "Linearization":
        """The same point under other inverse variances (S, J) of the noise of each pass and, if
        given, `weights` (J // 2 + 1,) of its frequencies.
        """
        weights = weights or [one.frequency_weights for one in self.passes]
        rows = zip(self.passes, inverse_variance, weights, strict=True)
        passes = (replace(one, inverse_variance=r, frequency_weights=w) for one, r, w in rows)
        return replace(self, passes=tuple(passes))

    def with_road(self, road: RoadTransform, u: np.ndarray) -> "Linearization":
        """The same motions under another prior, by which `u` (2, K) gives the same road."""
        x = np.concatenate([u.ravel(), self.x[u.size :]])
        return replace(self, objective=replace(self.objective, road=road), x=x)

    def relinearize(self, x: np.ndarray, plants: Sequence[Plant] | None = None) -> "Linearization":
        """The same objective and noise at another `x`. Raises ArithmeticError."""
        weights = [one.frequency_weights for one in self.passes]
        return self.objective.linearize(x, plants).with_noise(self.inverse_variance, weights)
