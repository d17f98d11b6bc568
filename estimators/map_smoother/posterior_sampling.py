"""Mean and standard deviation of the road, from samples of the linearized posterior.

With e_1, e_2 standard normal, the solution of (I + J' R^-1 J) x = J' R^-1/2 e_1 + e_2 is a sample
of the posterior's deviation from its mean (Papandreou & Yuille 2010, "Gaussian sampling by local
perturbations"). The road of such a sample within a band has the distribution of the estimate's
error there.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import irfft, rfft
from scipy.signal import hilbert

from estimators.common.conjugate_gradients import Operator
from estimators.common.model_inputs import ModelInputs
from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.road_prior import RoadTransform
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.vehicle_uncertainty import VehicleUncertainty
from estimators.map_smoother.wheel_liftoff import LiftoffError, lower_road, road_below_light_wheels


class RoadPosterior(NamedTuple):
    """The `solution` at the mean of the road below light wheels, the standard deviation `std` (2,
    K) [m] of the error in the band at each node, the `vehicle_share` of its variance, the
    `evidence` of `_VehicleErrors`, and samples `deviations` (D, 2, K) [m] from the mean in all
    waves.
    """

    solution: MapSolution
    std: np.ndarray
    vehicle_share: float
    evidence: float
    deviations: np.ndarray


def posterior_mean_and_std(
    solution: MapSolution,
    band: tuple[float, float],
    draws: int,
    uncertainty: VehicleUncertainty | None = None,
) -> RoadPosterior:
    """Return the posterior of the road, with its error inside `band` [cycles/m]. `uncertainty` is
    that of the vehicle, of one pass; of a vehicle as described the part of the tolerances counts
    which the misfit of this drive leaves possible. The course of the deviation along the road is
    that of the local roughness, by the stationary approximation; its level, from the samples, is
    the same for all nodes that were passed in the same strut state. Of nodes that no sensor has
    read the prior is all that is known.
    """
    lin, rng = solution.linearization, np.random.default_rng(0)
    objective, road = lin.objective, lin.objective.road
    solve = solution.inverse_hessian(*TUNING.draw_cg)
    inside = (road.n >= band[0]) & (road.n <= band[1])
    unread = solution.stationary.read <= 0.5
    # at the ends of the road the band-pass leaks
    middle = interior(road.free, round(1.0 / (band[0] * road.ds))) & ~unread

    def mean_square(roads: Sequence[np.ndarray]) -> np.ndarray:
        """The mean square (2, K) [m²] of roads in the band."""
        total = np.zeros((2, road.size))
        for c in roads:
            part = band_pass(c, inside)
            part -= part[:, middle].mean(axis=1, keepdims=True)
            total += part**2 / len(roads)
        return total

    def roads_of(changes: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [road.apply(objective.split(dx)[0]) for dx in changes]

    drawn = draw_deviations(lin, solve, rng, draws)
    errors_of_vehicle = _VehicleErrors()
    if draws and uncertainty:
        if uncertainty.is_prior:
            few = TUNING.quick_draws, TUNING.quick_draw_cg
            errors_of_vehicle = _draw_vehicle_errors(solution, rng, uncertainty, *few)
        if not uncertainty.is_prior or errors_of_vehicle.evidence > TUNING.quick_evidence:
            errors_of_vehicle = _draw_vehicle_errors(solution, rng, uncertainty)
    of_vehicle = errors_of_vehicle.weight * mean_square(roads_of(errors_of_vehicle.moved))
    square = mean_square(roads_of(drawn)) + of_vehicle
    vehicle_share = float(of_vehicle.mean() / max(square.mean(), 1e-300))
    shape = solution.stationary.error_variance(road, solution.noise_variance, inside)
    # a band-pass spreads errors along the road by the square of its impulse response
    spread = irfft(inside.astype(float), road.size) ** 2
    shape = irfft(rfft(shape, axis=1) * rfft(spread), road.size, axis=1) / spread.sum()
    states = _strut_states(road, [one.source.inputs for one in lin.passes])
    level = _average_by_strut_state(square, shape, middle, states, road.ds)
    variance = TUNING.std_inflation**2 * level * shape
    if unread.any():
        white = rng.standard_normal((TUNING.road_draws, 2, road.size))
        prior = mean_square([road.apply(u) for u in white])
        variance[:, unread] = prior[:, unread].mean(axis=1, keepdims=True)
    deviations = np.zeros((0, 2, road.size))
    if draws:  # they have the level of the exact samples in each strut state, too
        deviations = _draw_roads(solution, drawn, errors_of_vehicle)
        ours = mean_square(list(deviations))
        ratio = _average_by_strut_state(variance, ours, middle, states, road.ds)
        steps = np.sqrt(np.where(unread, 1.0, ratio)) * np.diff(deviations, axis=2, prepend=0.0)
        deviations = np.cumsum(steps, axis=2)
        # heights that are wrong by their vehicle have the power of these errors once already
        heights = road.apply(objective.split(lin.x)[0])
        power = [mean_square(roads).mean() for roads in ([heights], list(deviations))]
        twice = min(vehicle_share * float(power[1] / power[0]), TUNING.most_twice)
        deviations -= (1.0 - np.sqrt(1.0 - twice)) * heights
    if road.is_uneven:
        variance = variance + TUNING.obstacle_share * variance[:, middle].mean()
    lower, errors = road_below_light_wheels(lin)
    std = np.sqrt(_add_liftoff_errors(variance, errors, inside))
    for path, height in errors:
        deviations[:, path] += rng.standard_normal((len(deviations), 1)) * height
    lowered = replace(solution, linearization=lower_road(lin, lower))
    return RoadPosterior(lowered, std, vehicle_share, errors_of_vehicle.evidence, deviations)


def _draw_roads(
    solution: MapSolution, exact: Sequence[np.ndarray], vehicle: "_VehicleErrors"
) -> np.ndarray:
    """Samples (D, 2, K) [m] of the road's deviation from the posterior mean.

    The preconditioner is the inverse root of the stationary Hessian, so that it makes white noise a
    sample of the stationary posterior. Each octave of it gets the power of the `exact` samples, as
    far as they tell it. A sum of samples of the vehicle's errors with random weights of unit
    variance is another such sample.
    """
    lin, road = solution.linearization, solution.linearization.objective.road
    # another noise in each window of a drive
    rng = np.random.default_rng([1, round(max(road.origin, 0.0) / road.ds)])
    shape = solution.stationary.preconditioner(lin, solution.noise_variance)
    noise = rng.standard_normal((TUNING.road_draws, lin.objective.size))
    u = np.array([shape(row)[: 2 * road.size].reshape(2, -1) for row in noise])
    told = np.array([lin.objective.split(dx)[0] for dx in exact])
    octave = np.round(np.log2(np.maximum(road.n, road.n[1])))
    _, group = np.unique(octave, return_inverse=True)
    ours, theirs = (
        np.bincount(group, np.mean(np.abs(rfft(road.free * x, axis=2)) ** 2, axis=(0, 1)))
        for x in (u, told)
    )
    lines = 2.0 * len(exact) * np.bincount(group)
    ratio = (lines * theirs / ours + TUNING.prior_lines) / (lines + TUNING.prior_lines)
    u = irfft(np.sqrt(ratio)[group] * rfft(u, axis=2), road.size, axis=2)
    unread = solution.stationary.read <= 0.5
    if unread.any():
        u[:, :, unread] = rng.standard_normal((*u.shape[:2], int(unread.sum())))
    if vehicle.moved:
        moved = np.array([lin.objective.split(dx)[0] for dx in vehicle.moved])
        weights = rng.standard_normal((TUNING.road_draws, len(moved)))
        scale = np.sqrt(vehicle.weight / len(moved))
        u += scale * np.tensordot(weights, moved, axes=1)
    return np.array([road.apply(row) for row in u])


def _add_liftoff_errors(
    variance: np.ndarray, errors: Sequence[LiftoffError], lines: np.ndarray
) -> np.ndarray:
    """Return the `variance` (2, K) [m²] of the error in the band of the spectral `lines` with the
    `errors` below light wheels. Where an edge is, is not known to a fraction of a wave in the band,
    so each counts by its envelope.
    """
    total = variance.copy()
    for path, height in errors:
        total[path] += np.abs(hilbert(band_pass(height[None], lines)[0])) ** 2
    return total


def draw_deviations(
    lin: Any, solve: Operator, rng: np.random.Generator, draws: int
) -> list[np.ndarray]:
    """Return samples of the deviation of `x` from its posterior mean at `lin`, a linearization or
    an `attainable._ExpectedInformation`; `solve` as of `MapSolution.inverse_hessian`.
    """
    size, times = lin.objective.size, range(draws)
    return [solve(lin.adjoint(lin.draw_noise(rng)) + rng.standard_normal(size)) for _ in times]


class _VehicleErrors(NamedTuple):
    """Samples `moved` of the deviation of `x` by errors of the vehicle, the `weight` of their
    squares, and the power `evidence` that such errors explain of the residual, in units of the
    noise: about one for each sample if the vehicle has none. That of a road longer than
    `TUNING.evidence_length` is for so much of it, as the power grows with the length.
    """

    moved: Sequence[np.ndarray] = ()
    weight: float = 0.0
    evidence: float = 0.0


def _draw_vehicle_errors(
    solution: MapSolution,
    rng: np.random.Generator,
    uncertainty: VehicleUncertainty,
    draws: int = TUNING.vehicle_draws,
    cg: tuple[int, float] = TUNING.vehicle_cg,
) -> _VehicleErrors:
    """Return samples of the road's error by that of the vehicle; `cg` as of `inverse_hessian`. A
    road cannot follow all that an error of the vehicle changes, and what is left shows in the
    residual. Where the residual of a vehicle as described holds less of it than vehicles within the
    tolerances would leave, the vehicle is nearer to its description, and its errors count less.
    """
    lin, white = solution.linearization, (draws, len(uncertainty.covariance))
    try:
        (one,) = lin.passes
        changes = uncertainty.draw_changes(one, rng.standard_normal(white))
    except ArithmeticError:  # on this road some vehicle within the tolerances does not stay finite
        return _VehicleErrors()
    solve = solution.inverse_hessian(*cg)
    moved = [solve(lin.adjoint(lin.apply_inverse_covariance([change]))) for change in changes]
    if not uncertainty.is_prior:
        return _VehicleErrors(moved, uncertainty.inflation**2)
    root = np.sqrt(one.source.information)
    pairs = zip(changes, moved, strict=True)
    left = [(root * (change - lin.tangent(dx)[0])).ravel() for change, dx in pairs]
    gram, along = np.inner(left, left), np.inner(left, (root * one.residual).ravel())
    evidence = float(along @ np.linalg.lstsq(gram, along)[0])
    typical = TUNING.shown_share * float(np.trace(gram)) / draws
    shown = max(evidence - draws, 0.0) / max(typical, 1e-12)
    length = float(lin.objective.road.ds * lin.objective.road.free.sum())
    evidence /= max(1.0, length / TUNING.evidence_length)
    return _VehicleErrors(moved, TUNING.tolerance_inflation**2 * min(1.0, shown), evidence)


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


def _strut_states(road: RoadTransform, drives: Sequence[ModelInputs]) -> np.ndarray:
    """Number (K,) of the combination of strut states in which the drives passed each node."""
    states = []
    for inputs in drives:
        passed = np.clip(np.searchsorted(inputs.s[::2], road.stations), 0, inputs.n_steps - 1)
        states.append(inputs.commands[passed])
    return np.unique(states, axis=1, return_inverse=True)[1].ravel()


def _average_by_strut_state(
    square: np.ndarray, shape: np.ndarray, free: np.ndarray, state: np.ndarray, ds: float
) -> np.ndarray:
    """Return the mean of `square` (2, K) over that of `shape` (2, K), over the `free` nodes (K,)
    that are passed in the same `state` (K,).
    """
    nodes = free if free.any() else np.ones(free.size, dtype=bool)
    ratio = np.full(free.size, square[:, nodes].mean() / shape[:, nodes].mean())
    for number in np.unique(state):
        here = (state == number) & free
        if here.sum() * ds >= TUNING.min_state_length:
            ratio[state == number] = square[:, here].mean() / shape[:, here].mean()
    return ratio
