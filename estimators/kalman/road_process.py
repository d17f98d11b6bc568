"""Prior of the road ahead of the newest node, and online estimation of its roughness.

Each new coefficient of the mean and of the half difference of the wheel paths follows an
autoregressive model, by the Yule-Walker equations for the covariance of the prior's spectrum
(`estimators.common.road_prior`). The mean is not stationary, so its increments are predicted. The
half difference of an isotropic surface is level for waves longer than the track, so it is predicted
itself.
"""

from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, rfftfreq
from scipy.linalg import solve_toeplitz, toeplitz

from estimators.common.road_prior import N_MIN, increment_amplitude
from estimators.kalman.jumps import add_candidates
from estimators.kalman.state import (
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
"""Length [m] of road from which the next node is predicted."""

CIRCULANT_LENGTH = 400.0
"""Least length [m] of the circle on which covariances are computed by FFT."""

MIN_ROUGHNESS_SCALE, MAX_ROUGHNESS_SCALE = 1e-4, 1e3
"""Bounds of the roughness scale relative to the prior: far beyond classes A to H."""


class ARModel(NamedTuple):
    """Autoregressive models of mean and half difference: `weights` (2, order) of the last nodes,
    newest first; `prediction_variance` (2,) [m²]; `covariance` (2, M) [m²] at lags of 0 to M - 1
    nodes.
    """

    weights: np.ndarray
    prediction_variance: np.ndarray
    covariance: np.ndarray

    def increment_variance(self, span: int) -> np.ndarray:
        """Return the variances (2,) [m²] of the increment over `span` nodes."""
        return 2.0 * (self.covariance[:, 0] - self.covariance[:, span])


def fit_ar_model(prior: RoadPrior, ds: float) -> ARModel:
    """Fit autoregressive models to `prior`, for nodes `ds` [m] apart."""
    size = 2 ** int(np.ceil(np.log2(CIRCULANT_LENGTH / ds)))
    increment_psd = increment_amplitude(prior, size, ds) ** 2
    n = np.maximum(rfftfreq(size, ds), N_MIN)
    covariance = irfft(increment_psd / (2.0 * np.sin(np.pi * n * ds)) ** 2, size, axis=1)
    order = round(AR_LENGTH / ds)
    phi, mean_variance = yule_walker(irfft(increment_psd[0], size), order - 1)
    half, half_variance = yule_walker(covariance[1], order)
    # the last increments, times phi, and the last value give the next value of the mean
    mean = np.append(phi, 0.0) - np.append(0.0, phi)
    mean[0] += 1.0
    variance = np.array([mean_variance, half_variance])
    return ARModel(np.array([mean, half]), variance, covariance[:, : size // 2])


def yule_walker(covariance: np.ndarray, order: int) -> tuple[np.ndarray, float]:
    """Return the weights (order,) of the last values in the next, and the prediction variance."""
    weights = solve_toeplitz(covariance[:order], covariance[1 : order + 1])
    return weights, float(covariance[0] - weights @ covariance[1 : order + 1])


def prior_covariance(ar_model: ARModel, size: int, oldest: int) -> np.ndarray:
    """Return the prior covariance (2 `size`, 2 `size`) [m²] of the nodes from `oldest` on, in the
    order of the ring buffer.
    """
    slot = (oldest + np.arange(size)) % size
    P = np.zeros((2 * size, 2 * size))
    for component in range(2):
        i = 2 * slot + component
        P[np.ix_(i, i)] = toeplitz(ar_model.covariance[component, :size])
    return P


@kernel(inline=False)
def add_node(model: FilterModel, state: FilterState, free):
    """Add a node ahead of the newest one and retire the oldest. Unless `free`, the road goes on
    level.
    """
    x, P, K, newest_node = state.x, state.P, model.n_nodes, state.newest_node[0]
    others = state.pending[: state.n_pending[0]], state.jumps.direction
    new = node_index(newest_node + 1, K)
    row = np.empty(x.size)
    for component in range(2):
        retire_node(state, RETIRED + 2 * component, new + component, model.decay)
        row[:] = 0.0
        for rows in others:
            rows[:, new + component] = 0.0
        z = 0.0
        order = model.ar_weights.shape[1] if free else 1
        for k in range(order):
            old = node_index(newest_node - k, K) + component
            weight = model.ar_weights[component, k] if free else 1.0
            z += weight * x[old]
            for i in range(x.size):
                row[i] += weight * P[old, i]
            for rows in others:
                for r in range(rows.shape[0]):
                    rows[r, new + component] += weight * rows[r, old]
        scale = state.adaptive[ROUGHNESS_SCALE]
        variance = model.prediction_variance[component] * scale if free else 0.0
        for k in range(order):
            weight = model.ar_weights[component, k] if free else 1.0
            variance += weight * row[node_index(newest_node - k, K) + component]
        x[new + component] = z
        P[new + component, :] = row
        P[:, new + component] = row
        P[new + component, new + component] = variance
    state.newest_node[0] = newest_node + 1
    add_candidates(state.jumps, newest_node + 1, new, free)


@kernel(inline=False)
def retire_node(state: FilterState, M, old, decay):
    """Add the node with the index `old` to the decaying sum at `M`, which moves one node further
    back.
    """
    x, P = state.x, state.P
    c, s = np.exp(-decay) * np.cos(decay), np.exp(-decay) * np.sin(decay)
    for rows in (state.pending[: state.n_pending[0]], state.jumps.direction):
        for r in range(rows.shape[0]):
            row = rows[r]
            real, imaginary = row[M] + row[old], row[M + 1]
            row[M], row[M + 1] = c * real - s * imaginary, s * real + c * imaginary
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
    """Update the roughness scale by the last increment that the rear axle, at node `rear`, has
    passed.

    One step of expectation maximization: the expected square is the squared mean plus the variance.
    An increment with an accepted step is none of the stationary prior and is left out.
    """
    x, P, K, adaptive = state.x, state.P, model.n_nodes, state.adaptive
    low = rear - model.increment_span
    if low <= free[0] or rear >= free[1] or state.jumps.square[low - 1 : rear + 2].any():
        return
    for component in range(2):
        a, b = node_index(low, K) + component, node_index(rear, K) + component
        increment, variance = x[b] - x[a], P[a, a] + P[b, b] - 2.0 * P[a, b]
        for r in range(state.n_pending[0]):
            variance -= (state.pending[r, b] - state.pending[r, a]) ** 2
        kept = 1.0 - 0.5 / model.roughness_memory  # half a node: there are two components
        ratio = 0.5 * (increment * increment + variance) / model.increment_variance[component]
        adaptive[ROUGHNESS_SUM] = kept * adaptive[ROUGHNESS_SUM] + ratio
        adaptive[ROUGHNESS_WEIGHT] = kept * adaptive[ROUGHNESS_WEIGHT] + 0.5
    adaptive[ROUGHNESS_SCALE] = min(
        max(adaptive[ROUGHNESS_SUM] / adaptive[ROUGHNESS_WEIGHT], MIN_ROUGHNESS_SCALE),
        MAX_ROUGHNESS_SCALE,
    )
