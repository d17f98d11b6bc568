"""The road ahead of the last node, as the prior foretells it, and what it may do besides.

The next coefficient of the mean and of the half difference of the wheel paths, each from its last
ones, by the equations of Yule and Walker for the covariance that the prior's spectrum makes
(`estimators.common.road_prior`). The mean wanders, and its rises are foretold; the half difference
of an isotropic surface is level for waves longer than the track, and is foretold itself.
"""

from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, rfftfreq
from scipy.linalg import solve_toeplitz, toeplitz

from estimators.common.road_prior import N_MIN, increment_amplitude
from estimators.kalman.state import (
    NODES,
    RETIRED,
    ROUGHNESS_SCALE,
    ROUGHNESS_SUM,
    ROUGHNESS_WEIGHT,
    FilterModel,
    FilterState,
    node_index,
)
from road_envs._numba import kernel
from road_envs.analysis.information_bound import RoadPrior

AR_LENGTH = 2.0
"""Length [m] of road behind from which the next node is foretold."""

CIRCULANT_LENGTH = 400.0
"""Least length [m] of the circle on which covariances are computed."""

MIN_ROUGHNESS_SCALE, MAX_ROUGHNESS_SCALE = 1e-4, 1e3
"""Bounds of the level that is learnt, over that of the prior: far beyond classes A to H."""


class ARModel(NamedTuple):
    """`weights` (2, order) of the last nodes, newest first, and `prediction_variance` (2,) [m²],
    the variance of what they do not tell, of mean and half difference; `covariance` (2, M) [m²] of
    a coefficient with those up to M nodes behind.
    """

    weights: np.ndarray
    prediction_variance: np.ndarray
    covariance: np.ndarray

    def increment_variance(self, reach: int) -> np.ndarray:
        """Variances (2,) [m²] of the rise over `reach` nodes."""
        return 2.0 * (self.covariance[:, 0] - self.covariance[:, reach])


def fit_ar_model(prior: RoadPrior, ds: float) -> ARModel:
    """How a road like `prior` goes on from node to node, `ds` [m] apart."""
    size = 2 ** int(np.ceil(np.log2(CIRCULANT_LENGTH / ds)))
    rises = increment_amplitude(prior, size, ds) ** 2
    n = np.maximum(rfftfreq(size, ds), N_MIN)
    levels = irfft(rises / (2.0 * np.sin(np.pi * n * ds)) ** 2, size, axis=1)
    order = round(AR_LENGTH / ds)
    phi, mean = yule_walker(irfft(rises[0], size), order - 1)
    half, difference = yule_walker(levels[1], order)
    wander = np.append(phi, 0.0) - np.append(0.0, phi)
    wander[0] += 1.0
    return ARModel(np.array([wander, half]), np.array([mean, difference]), levels[:, : size // 2])


def yule_walker(covariance: np.ndarray, order: int) -> tuple[np.ndarray, float]:
    """Weights (order,) of the last values in the next, and the variance that they leave."""
    weights = solve_toeplitz(covariance[:order], covariance[1 : order + 1])
    return weights, float(covariance[0] - weights @ covariance[1 : order + 1])


def prior_covariance(ar_model: ARModel, n: int, oldest: int) -> np.ndarray:
    """Covariance (n - NODES, n - NODES) [m²] of the nodes from `oldest` on, as they stand in a
    vector of `n`, on a road of which nothing is known but the prior.
    """
    size = (n - NODES) // 2
    place = (oldest + np.arange(size)) % size
    P = np.zeros((2 * size, 2 * size))
    for component in range(2):
        P[np.ix_(2 * place + component, 2 * place + component)] = toeplitz(
            ar_model.covariance[component, :size]
        )
    return P


@kernel(inline=False)
def add_node(model: FilterModel, state: FilterState, free):
    """Put a new node ahead of the newest; the oldest goes into the fading sums.

    Where the road is not `free` to rise it goes on level.
    """
    x, P, n = state.x, state.P, state.x.size
    newest_node = state.newest_node[0]
    new = node_index(newest_node + 1, n)
    row = np.empty(n)
    for component in range(2):
        retire_node(x, P, RETIRED + 2 * component, new + component, model.decay)
        row[:] = 0.0
        z = 0.0
        order = model.ar_weights.shape[1] if free else 1
        for k in range(order):
            old = node_index(newest_node - k, n) + component
            weight = model.ar_weights[component, k] if free else 1.0
            z += weight * x[old]
            row += weight * P[old]
        variance = (
            model.prediction_variance[component] * state.adaptive[ROUGHNESS_SCALE] if free else 0.0
        )
        for k in range(order):
            weight = model.ar_weights[component, k] if free else 1.0
            variance += weight * row[node_index(newest_node - k, n) + component]
        x[new + component] = z
        P[new + component, :] = row
        P[:, new + component] = row
        P[new + component, new + component] = variance
    state.newest_node[0] = newest_node + 1


@kernel(inline=False)
def retire_node(x, P, M, old, decay):
    """Take the node in the entry `old` into the fading sum at `M`, a node further behind."""
    c, s = np.exp(-decay) * np.cos(decay), np.exp(-decay) * np.sin(decay)
    real, imaginary = x[M] + x[old], x[M + 1]
    x[M], x[M + 1] = c * real - s * imaginary, s * real + c * imaginary
    for i in range(x.size):
        real, imaginary = P[M, i] + P[old, i], P[M + 1, i]
        P[M, i], P[M + 1, i] = c * real - s * imaginary, s * real + c * imaginary
    for i in range(x.size):
        real, imaginary = P[i, M] + P[i, old], P[i, M + 1]
        P[i, M], P[i, M + 1] = c * real - s * imaginary, s * real + c * imaginary


@kernel(inline=False)
def update_roughness(model: FilterModel, state: FilterState, rear, free):
    """Learn the roughness from the last rise that the rear axle, at node `rear`, has passed.

    With what is still uncertain of it: a step of expectation and maximisation.
    """
    x, P, n, adaptive = state.x, state.P, state.x.size, state.adaptive
    low = rear - model.increment_span
    if low <= free[0] or rear >= free[1]:
        return
    for component in range(2):
        a, b = node_index(low, n) + component, node_index(rear, n) + component
        rise, variance = x[b] - x[a], P[a, a] + P[b, b] - 2.0 * P[a, b]
        forgotten = 1.0 - 0.5 / model.roughness_memory
        adaptive[ROUGHNESS_SUM] = (
            forgotten * adaptive[ROUGHNESS_SUM]
            + 0.5 * (rise * rise + variance) / model.increment_variance[component]
        )
        adaptive[ROUGHNESS_WEIGHT] = forgotten * adaptive[ROUGHNESS_WEIGHT] + 0.5
    adaptive[ROUGHNESS_SCALE] = min(
        max(adaptive[ROUGHNESS_SUM] / adaptive[ROUGHNESS_WEIGHT], MIN_ROUGHNESS_SCALE),
        MAX_ROUGHNESS_SCALE,
    )
