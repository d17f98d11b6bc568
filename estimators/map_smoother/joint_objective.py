"""Cost function of one road and several passes over it: their misfits add.

    cost(x) = sum over passes p 1/2 |y_p - a_p(road)|²_(R_p^-1) + 1/2 |x|²

x holds the noise u of the road (2 K), which all passes share; for each pass the deviation of its
initial vehicle state and its sensor biases; and for each pass but the first the shift of its
stations against the road at some knots, linear between them: odometers differ, and profiles that
are centimetres apart would count as noise. To first order a shift d(s) changes the road under this
pass alone, by d(s) dz/ds.

Gradients and Hessians of the passes add, and so do the information of their stationary
approximations. Each class has the interface of that of one pass (`objective.py`,
`preconditioner.py`); what one pass has as a number or an array is a list here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import spline_filter1d

from estimators.common.model_inputs import ModelInputs
from estimators.map_smoother.objective import Linearization, Objective
from estimators.map_smoother.preconditioner import StationaryHessian, stationary_hessian
from estimators.map_smoother.road_prior import RoadTransform
from road_envs.vehicle.equations import Plant

SHIFT_STD = 0.05
"""Prior standard deviation [m] of a shift, after the alignment of the single estimates."""


def shift_inputs(inputs: ModelInputs, knots: np.ndarray, shift: np.ndarray) -> ModelInputs:
    """Return inputs whose stations are moved by `shift` (M,) [m] at the stations `knots` (M,) [m],
    by the nearest one beyond the ends.
    """
    slope = np.concatenate([[0.0], np.diff(shift) / np.diff(knots), [0.0]])
    stretch = 1.0 + slope[np.searchsorted(knots, inputs.s)]
    moved = inputs.s + np.interp(inputs.s, knots, shift)
    return replace(inputs, s=moved, v=inputs.v * stretch)


@dataclass(frozen=True, eq=False)
class JointObjective:
    """Sum of the objectives of several `passes`, which have the same road.

    `knots` (M,) are the stations [m] at which the shifts are unknown; none: they are not.
    `shift_information` (P - 1, M) is that of measurements of unit variance on shifts of unit prior,
    about, for the preconditioner.
    """

    passes: tuple[Objective, ...]
    knots: np.ndarray
    shift_information: np.ndarray | None = None

    @property
    def road(self) -> RoadTransform:
        """The road that all passes share."""
        return self.passes[0].road

    @property
    def n_shifts(self) -> int:
        """Number of unknown shifts of all passes."""
        return (len(self.passes) - 1) * self.knots.size

    @property
    def size(self) -> int:
        """Number of unknowns."""
        road = 2 * self.road.size
        return road + sum(one.size - road for one in self.passes) + self.n_shifts

    @property
    def plant(self) -> list[Plant]:
        """The vehicle of each pass."""
        return [one.plant for one in self.passes]

    @property
    def noise_variance(self) -> np.ndarray:
        """Variance (P,) [(m/s²)²] of a sample's noise in each pass."""
        return np.array([one.noise_variance for one in self.passes])

    @property
    def information(self) -> list[np.ndarray]:
        """Inverse variance (S, J) of each block mean of each pass."""
        return [one.information for one in self.passes]

    def with_passes(self, passes: Sequence[Objective]) -> "JointObjective":
        """Return the objective with other objectives of the passes."""
        return replace(self, passes=tuple(passes))

    def with_road(self, road: RoadTransform) -> "JointObjective":
        """Return the objective with another prior of the road."""
        return self.with_passes([one.with_road(road) for one in self.passes])

    def offset_scale(
        self, noise_variance: np.ndarray, start_information: Sequence[np.ndarray]
    ) -> np.ndarray:
        """Return about the root of the Hessian's diagonal behind the unknowns of the road."""
        rows = zip(self.passes, noise_variance, start_information, strict=True)
        parts = [one.offset_scale(*rest) for one, *rest in rows]
        shifts = np.ones((len(self.passes) - 1, self.knots.size))
        if self.shift_information is not None:
            shifts = np.sqrt(1.0 + self.shift_information / noise_variance[1:, None])
        return np.concatenate([*parts, shifts.ravel()])

    def of_passes(self, x: np.ndarray) -> list[np.ndarray]:
        """Return the unknowns of the objective of each pass among all unknowns `x`."""
        road = 2 * self.road.size
        own = x[road : x.size - self.n_shifts]
        ends = np.cumsum([one.size - road for one in self.passes])
        return [np.concatenate([x[:road], part]) for part in np.split(own, ends[:-1])]

    def shifts(self, x: np.ndarray) -> np.ndarray:
        """Return the shifts (P, M) [m] of the passes at the knots; those of the first are 0."""
        shifts = np.zeros((len(self.passes), self.knots.size))
        if self.n_shifts:
            shifts[1:] = SHIFT_STD * x[x.size - self.n_shifts :].reshape(shifts[1:].shape)
        return shifts

    def split(self, x: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        """Return `u` (2, K) and, of each pass in SI units, initial deviation and biases."""
        pairs = zip(self.passes, self.of_passes(x), strict=True)
        u, start, bias = zip(*(one.split(part) for one, part in pairs), strict=True)
        return u[0], list(start), list(bias)

    def linearize(
        self,
        x: np.ndarray,
        plant: Sequence[Plant] | None = None,
        inverse_variance: Sequence[np.ndarray] | None = None,
        frequency_weights: Sequence[np.ndarray] | None = None,
    ) -> "JointLinearization":
        """Return the linearization at `x`, as of `Objective.linearize`."""
        nothing: list[Any] = [None] * len(self.passes)
        moved = [
            replace(one, inputs=shift_inputs(one.inputs, self.knots, shift)) if shift.any() else one
            for one, shift in zip(self.passes, self.shifts(x), strict=True)
        ]
        rows = zip(
            moved, self.of_passes(x), plant or nothing, inverse_variance or nothing,
            frequency_weights or nothing, strict=True,
        )  # fmt: skip
        return JointLinearization(self, x, tuple(Objective.linearize(*row) for row in rows))


@dataclass(frozen=True, eq=False)
class JointLinearization:
    """The joint objective `at` linearized at `x`: the linearizations of its `passes`."""

    at: JointObjective
    x: np.ndarray
    passes: tuple[Linearization, ...]

    @cached_property
    def objective(self) -> JointObjective:
        """The objective, with the information on its shifts."""
        if not self.at.n_shifts:
            return self.at
        information = []
        for one in self.passes[1:]:
            measurements = one.objective.measurements
            uniform = one.read_road(np.zeros(one.tape.end.size), self._slope)
            power = np.sum(measurements.sample_count * uniform**2, axis=0)
            s = one.objective.inputs.s[:: one.objective.inputs.s.size // power.size][: power.size]
            hats = [np.interp(s, self.at.knots, unit) for unit in np.eye(self.at.knots.size)]
            information.append(SHIFT_STD**2 * np.square(hats) @ power)
        return replace(self.at, shift_information=np.array(information))

    @cached_property
    def _slope(self) -> np.ndarray:
        """Coefficients (2, K) [-] of the spline through the road's slopes at the nodes."""
        road = self.at.road
        c = road.coefficients(self.at.split(self.x)[0])
        # at the nodes the slope of the spline is the central difference of its coefficients
        return spline_filter1d(np.gradient(c, road.ds, axis=1), order=3, axis=1, mode="nearest")

    @cached_property
    def _hats(self) -> np.ndarray:
        """Weights (M, K) of the shifts at the nodes."""
        road, knots = self.at.road, self.at.knots
        station = road.origin + road.ds * np.arange(road.size)
        return np.array([np.interp(station, knots, unit) for unit in np.eye(knots.size)])

    def per_pass(self, function: Callable[..., Any], *values: Any) -> list[Any]:
        """Return `function` of each pass and of its values, one list of P for each."""
        return [function(one, *rest) for one, *rest in zip(self.passes, *values, strict=True)]

    @property
    def inverse_variance(self) -> list[np.ndarray]:
        """Inverse variance (S, J) of the noise of each pass."""
        return [one.inverse_variance for one in self.passes]

    @property
    def cost(self) -> float:
        """The cost at `x`."""
        return sum(one.misfit for one in self.passes) + 0.5 * float(self.x @ self.x)

    def gradient(self) -> np.ndarray:
        """Return the gradient of the cost with respect to `x`."""
        weighted = [one.apply_inverse_covariance(one.residual) for one in self.passes]
        return self.x - self.adjoint(weighted)

    def hessian_product(self, dx: np.ndarray) -> np.ndarray:
        """Return the Gauss-Newton Hessian times `dx`."""
        means = self.per_pass(Linearization.apply_inverse_covariance, self.tangent(dx))
        return dx + self.adjoint(means)

    def tangent(self, dx: np.ndarray) -> list[np.ndarray]:
        """Return the change (S, J) of the predicted block means of each pass by a small `dx`."""
        u, start, bias = self.at.split(dx)
        dc = self.at.road.apply(u)
        shifts = self.at.shifts(dx)
        roads = [dc + (shift @ self._hats) * self._slope if shift.any() else dc for shift in shifts]
        rows = zip(self.passes, start, roads, bias, strict=True)
        return [
            one.objective.in_band(one.read_road(first, c) + offset[:, None])
            for one, first, c, offset in rows
        ]

    def adjoint(self, means: Sequence[np.ndarray]) -> np.ndarray:
        """Apply the transpose of `tangent`: from block means (S, J) of each pass to `x`."""
        own, shifts, total = [], [], np.zeros((2, self.at.road.size))
        for k, (one, values) in enumerate(zip(self.passes, means, strict=True)):
            o = one.objective
            values = o.in_band(values)
            start, c = one.read_road_transpose(values)
            own += [o.initial_std * start, o.model.bias_std * values.sum(axis=1)]
            total += c
            if k and self.at.n_shifts:
                shifts.append(SHIFT_STD * self._hats @ np.sum(self._slope * c, axis=0))
        u = self.at.road.apply_transpose(total)
        return np.concatenate([u.ravel(), *own, *shifts])

    def draw_noise(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Return R^-1/2 times white noise (S, J) for each pass."""
        return [one.draw_noise(rng) for one in self.passes]

    def with_frequency_weights(self, weights: Sequence[np.ndarray]) -> "JointLinearization":
        """Return the same point under noise of other frequency weights (J // 2 + 1,)."""
        return self._with(self.per_pass(Linearization.with_frequency_weights, weights))

    def with_inverse_variance(self, variance: Sequence[np.ndarray]) -> "JointLinearization":
        """Return the same point under other inverse variances (S, J) of the noise."""
        return self._with(self.per_pass(Linearization.with_inverse_variance, variance))

    def with_road(self, road: RoadTransform, u: np.ndarray) -> "JointLinearization":
        """Return the same motions under another prior, by which `u` (2, K) gives the same road."""
        x = np.concatenate([u.ravel(), self.x[u.size :]])
        passes = tuple(one.with_road(road, u) for one in self.passes)
        return JointLinearization(self.at.with_road(road), x, passes)

    def relinearize(
        self, x: np.ndarray, plant: Sequence[Plant] | None = None
    ) -> "JointLinearization":
        """Return the same objective and noise at another `x`. Raises ArithmeticError."""
        weights = [one.frequency_weights for one in self.passes]
        return self.at.linearize(x, plant, self.inverse_variance, weights)  # type: ignore[arg-type]

    def _with(self, passes: Sequence[Linearization]) -> "JointLinearization":
        return replace(self, passes=tuple(passes))


@dataclass(frozen=True, eq=False)
class JointStationaryHessian(StationaryHessian):
    """Sum of the stationary Hessians of several `passes`, each over a share of the road.

    `covered` (P,) are these shares of the nodes; `information` (F, 2, 2) is the sum for
    measurements of unit variance.
    """

    passes: tuple[StationaryHessian, ...]
    covered: np.ndarray

    def weighted(self, noise_variance: Any) -> np.ndarray:
        """Return the information (F, 2, 2) under the noise variances (P,) [(m/s²)²]."""
        pairs = zip(self.passes, noise_variance, strict=True)
        return np.sum([one.weighted(variance) for one, variance in pairs], axis=0)

    def reweighted(self, objective: Any, frequency_weights: Any) -> "JointStationaryHessian":
        """Return the Hessian for measurements with weights (J // 2 + 1,) on their frequencies."""
        rows = zip(self.passes, objective.passes, frequency_weights, strict=True)
        return replace(self, passes=tuple(one.reweighted(*rest) for one, *rest in rows))

    def effective_dof(self, road: RoadTransform, noise_variance: Any) -> Any:
        """Return how many (P,) of the road's unknowns each pass determines; they add to all.

        That is the trace of posterior covariance times the information of the pass.
        """
        T = road.transfer_function().T
        product = T.conj()[:, :, None] * T[:, None, :]
        covariance = np.linalg.inv(self.precision(road, noise_variance))
        traces = [
            np.einsum("fij,fji->f", covariance, one.weighted(variance) * product).real.mean()
            for one, variance in zip(self.passes, noise_variance, strict=True)
        ]
        return np.asarray(road.free.sum() * self.covered * np.array(traces))


def joint_stationary_hessian(objective: JointObjective) -> JointStationaryHessian:
    """Return the stationary Hessian of all passes."""
    passes = tuple(stationary_hessian(one) for one in objective.passes)
    free, road = objective.road.free > 0, objective.road
    station = (road.origin + road.ds * np.arange(road.size))[free]
    covered = [
        np.mean((station >= one.inputs.s[0] - one.model.wheelbase) & (station <= one.inputs.s[-1]))
        for one in objective.passes
    ]
    total = np.sum([one.information for one in passes], axis=0)
    starts = [one.start_information for one in passes]
    return JointStationaryHessian(total, starts, passes, np.array(covered))
