"""Prior of the road ahead of the newest node, and online estimation of its roughness.

Each new coefficient of the mean and of the half difference of the wheel paths follows an
autoregressive model, by the Yule-Walker equations for the covariance of the prior's spectrum
(`estimators.common.road_prior`). The mean is not stationary, so its increments are predicted. The
half difference of an isotropic surface is level for waves longer than the track, so it is predicted
itself.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, rfftfreq
from scipy.linalg import solve_toeplitz, toeplitz

from estimators.common.road_prior import N_MIN, increment_amplitude
from estimators.kalman.state import (
    N_BIAS,
    N_SUMS,
    ROUGHNESS_SCALE,
    ROUGHNESS_SUM,
    ROUGHNESS_WEIGHT,
)
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


def prior_covariance(ar_model: ARModel, size: int) -> np.ndarray:
    """Return the prior covariance (2 `size`, 2 `size`) [m²] of so many nodes."""
    P = np.zeros((2 * size, 2 * size))
    for component in range(2):
        P[component::2, component::2] = toeplitz(ar_model.covariance[component, :size])
    return P


class NodeTransition(NamedTuple):
    """Linear step x' = F x + e of the state vector by which the nodes move back and `n_new` new
    ones come before them: `rows` (4 + 2 count, n) of F for the retired-node sums and the new nodes;
    `noise` (4 + 2 count, 4 + 2 count), the covariance of e in them, for a roughness scale of 1;
    `response` (2, count, count), of mean and half difference, of the nodes to a step at each.
    """

    n_new: int
    rows: np.ndarray
    noise: np.ndarray
    response: np.ndarray


@dataclass(frozen=True, eq=False)
class RoadProcess:
    """The road's model in a state vector of `n_vehicle` states and `n_nodes` nodes: `ar_model` of
    the next node, `decay` per node of the retired-node sums, the span [nodes] of the increments
    from which roughness is estimated, and the number of nodes over which it is averaged.
    """

    n_vehicle: int
    n_nodes: int
    ar_model: ARModel
    decay: float
    increment_span: int
    roughness_memory: float
    transitions: dict[tuple[int, bool], NodeTransition] = field(default_factory=dict)

    @cached_property
    def first_sum(self) -> int:
        """Index of the first retired-node sum."""
        return self.n_vehicle + N_BIAS

    @cached_property
    def first_node(self) -> int:
        """Index of the mean of the newest node."""
        return self.first_sum + N_SUMS

    @cached_property
    def n_states(self) -> int:
        """Size n of the state vector."""
        return self.first_node + 2 * self.n_nodes

    @cached_property
    def increment_variance(self) -> np.ndarray:
        """Variances (2,) [m²] of the increments from which roughness is estimated."""
        return self.ar_model.increment_variance(self.increment_span)

    def transition(self, count: int, free: bool) -> NodeTransition:
        """Return the step to `count` new nodes. Unless `free`, the road goes on level."""
        if (count, free) not in self.transitions:
            self.transitions[count, free] = self._transition(count, free)
        return self.transitions[count, free]

    def _transition(self, count: int, free: bool) -> NodeTransition:
        rows = np.zeros((N_SUMS + 2 * count, self.n_states))
        noise, response = np.zeros((rows.shape[0], rows.shape[0])), np.zeros((2, count, count))
        order = self.ar_model.weights.shape[1]
        turn = np.exp((1j - 1.0) * self.decay * np.arange(1, count + 1))
        for component in range(2):
            pair, first = 2 * component, self.first_sum + 2 * component
            a, b = turn[-1].real, turn[-1].imag
            rows[pair : pair + 2, first : first + 2] = [[a, -b], [b, a]]
            retired = self.n_states - 2 * np.arange(count, 0, -1) + component
            rows[pair, retired], rows[pair + 1, retired] = turn.real, turn.imag
            # nodes, the newest first, by the old ones and by the innovations
            old, e = np.zeros((count + order, order)), np.zeros((count + order, count))
            old[count:] = np.eye(order)
            for k in range(count - 1, -1, -1):
                weights = self.ar_model.weights[component] if free else np.eye(order)[0]
                old[k], e[k] = weights @ old[k + 1 : k + 1 + order], weights @ e[k + 1 :][:order]
                e[k, k] = float(free)
            new = slice(N_SUMS + component, None, 2)
            rows[new, self.first_node + component :: 2][:, :order] = old[:count]
            variance = self.ar_model.prediction_variance[component]
            response[component] = e[:count]
            noise[new, new] = variance * e[:count] @ e[:count].T
        return NodeTransition(count, rows, noise, response)

    def update_roughness(
        self, adaptive: np.ndarray, x: np.ndarray, P: np.ndarray, offsets: np.ndarray
    ) -> None:
        """Update the roughness scale by the increments up to the nodes `offsets` behind the newest.

        One step of expectation maximization: the expected square is the squared mean plus the
        variance.
        """
        variances = self.increment_variance
        for offset in offsets:
            for component in range(2):
                a = self.first_node + 2 * offset + component
                b = a + 2 * self.increment_span
                square = (x[a] - x[b]) ** 2 + P[a, a] + P[b, b] - 2.0 * P[a, b]
                kept = 1.0 - 0.5 / self.roughness_memory  # half a node: there are two components
                ratio = 0.5 * square / variances[component]
                adaptive[ROUGHNESS_SUM] = kept * adaptive[ROUGHNESS_SUM] + ratio
                adaptive[ROUGHNESS_WEIGHT] = kept * adaptive[ROUGHNESS_WEIGHT] + 0.5
            scale = adaptive[ROUGHNESS_SUM] / adaptive[ROUGHNESS_WEIGHT]
            adaptive[ROUGHNESS_SCALE] = min(max(scale, MIN_ROUGHNESS_SCALE), MAX_ROUGHNESS_SCALE)
