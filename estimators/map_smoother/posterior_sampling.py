"""Mean and standard deviation of the road, from samples of the linearized posterior.

With e_1, e_2 standard normal, the solution of (I + J' R^-1 J) x = J' R^-1/2 e_1 + e_2 is a sample
of the posterior's deviation from its mean (Papandreou & Yuille 2010, "Gaussian sampling by local
perturbations"). The road of such a sample within a band has the distribution of the estimate's
error there.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.fft import irfft, rfft
from scipy.signal import hilbert

from estimators.common.conjugate_gradients import Operator
from estimators.common.model_inputs import ModelInputs
from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.road_prior import RoadTransform
from estimators.map_smoother.vehicle_uncertainty import VehicleUncertainty
from estimators.map_smoother.wheel_liftoff import (
    LiftoffError,
    lower_road,
    road_below_light_wheels,
)

CG_ITERATIONS, CG_TOLERANCE = 40, 1e-2
"""Iterations of conjugate gradients for one sample, at most, and where they end."""

VEHICLE_DRAWS = 8
"""Samples where the vehicle is uncertain: about six of its errors are independent in the road, and
their mean square over the drive is then within a quarter."""

MIN_STATE_LENGTH = 10.0
"""Least length [m] of road in one strut state that has a standard deviation of its own."""

STD_INFLATION = 1.1
"""Factor for the curvature and for the unfinished minimization, from training drives."""

OBSTACLE_SHARE = 0.02
"""On roads that are rough in places: share of the mean variance that is added between these places.
From training drives over potholes and bumps."""


def posterior_mean_and_std(
    solution: MapSolution,
    band: tuple[float, float],
    draws: int,
    uncertainty: VehicleUncertainty | None = None,
) -> tuple[MapSolution, np.ndarray]:
    """Return the solution at the mean of the road below light wheels, and the standard deviation
    (2, K) [m] of the error inside `band` [cycles/m] at each node.

    `uncertainty` is that of an identified vehicle, of one pass.

    The course of the deviation along the road is that of the local roughness, by the stationary
    approximation; its level, from the samples, is the same for all nodes that were passed in the
    same strut state.
    """
    lin, rng = solution.linearization, np.random.default_rng(0)
    objective, road = lin.objective, lin.objective.road
    noise_variance = objective.noise_variance * solution.noise_scale
    solve = solution.inverse_hessian(CG_ITERATIONS, CG_TOLERANCE)
    inside = (road.n >= band[0]) & (road.n <= band[1])
    # at the ends of the road the band-pass leaks
    middle = interior(road.free, round(1.0 / (band[0] * road.ds)))
    square = np.zeros((2, road.size))
    if draws and uncertainty:
        draws = max(draws, VEHICLE_DRAWS)
    for dx in draw_deviations(lin, solve, rng, draws, uncertainty):
        part = band_pass(road.apply(objective.split(dx)[0]), inside)
        part -= part[:, middle].mean(axis=1, keepdims=True)
        square += part**2 / draws
    shape = solution.stationary.error_variance(road, noise_variance, inside)
    # a band-pass spreads errors along the road by the square of its impulse response
    spread = irfft(inside.astype(float), road.size) ** 2
    shape = irfft(rfft(shape, axis=1) * rfft(spread), road.size, axis=1) / spread.sum()
    drives = [one.objective.inputs for one in lin.passes]
    level = _average_by_strut_state(square, shape, middle, road, drives)
    variance = STD_INFLATION**2 * level * shape
    if road.is_uneven:
        variance = variance + OBSTACLE_SHARE * variance[:, middle].mean()
    lower, errors = road_below_light_wheels(lin)
    std = np.sqrt(add_liftoff_errors(variance, errors, inside))
    return replace(solution, linearization=lower_road(lin, lower)), std


def add_liftoff_errors(
    variance: np.ndarray, errors: Sequence[LiftoffError], lines: np.ndarray
) -> np.ndarray:
    """Return the `variance` (2, K) [m²] of the error in the band of the spectral `lines`, with that
    of the road below light wheels.

    Where an edge is, is not known to a fraction of a wave in the band, so each error counts by its
    envelope.
    """
    total = variance.copy()
    for path, height in errors:
        total[path] += np.abs(hilbert(band_pass(height[None], lines)[0])) ** 2
    return total


def draw_deviations(
    lin: Any,
    solve: Operator,
    rng: np.random.Generator,
    draws: int,
    uncertainty: VehicleUncertainty | None = None,
) -> list[np.ndarray]:
    """Return samples of the deviation of `x` from its posterior mean; `solve` as of
    `MapSolution.inverse_hessian`.

    `lin` is a linearization, of one pass or of several, or the expectation of some over roads
    (`attainable.ExpectedInformation`).
    """
    noise, of_vehicle = [], []
    for _ in range(draws):
        noise.append(lin.adjoint(lin.draw_noise(rng)) + rng.standard_normal(lin.objective.size))
        if uncertainty:
            of_vehicle.append(rng.standard_normal(len(uncertainty.covariance)))
    if uncertainty and draws:
        changes = uncertainty.draw_changes(lin, np.array(of_vehicle))
        for b, change in zip(noise, changes, strict=True):
            b += lin.adjoint(lin.apply_inverse_covariance(change))
    return [solve(b) for b in noise]


def band_pass(c: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Return heights `c` (2, K) [m] with the spectral `lines` (K // 2 + 1,) of their increments."""
    size = c.shape[1]
    increments = np.diff(c, axis=1, prepend=0.0)
    return np.cumsum(irfft(lines * rfft(increments, axis=1), size, axis=1), axis=1)


def interior(free: np.ndarray, margin: int) -> np.ndarray:
    """Return which nodes (K,) are free, less at most `margin` of them at either end."""
    nodes = np.flatnonzero(free)
    margin = min(margin, nodes.size // 4)
    inner = np.zeros(free.size, dtype=bool)
    inner[nodes[margin : nodes.size - margin]] = True
    return inner


def _average_by_strut_state(
    square: np.ndarray,
    shape: np.ndarray,
    free: np.ndarray,
    road: RoadTransform,
    drives: Sequence[ModelInputs],
) -> np.ndarray:
    """Return the mean of `square` (2, K) over that of `shape` (2, K), over `free` nodes (K,) passed
    in the same strut states of all drives.
    """
    station = road.origin + road.ds * np.arange(road.size)
    states = []
    for inputs in drives:
        passed = np.clip(np.searchsorted(inputs.s[::2], station), 0, inputs.n_steps - 1)
        states.append(inputs.commands[passed])
    state = np.unique(states, axis=1, return_inverse=True)[1].ravel()
    nodes = free if free.any() else np.ones(free.size, dtype=bool)
    ratio = np.full(road.size, square[:, nodes].mean() / shape[:, nodes].mean())
    for byte in np.unique(state):
        here = (state == byte) & free
        if here.sum() * road.ds >= MIN_STATE_LENGTH:
            ratio[state == byte] = square[:, here].mean() / shape[:, here].mean()
    return ratio
