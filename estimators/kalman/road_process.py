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
from estimators.kalman.state import N_BIAS, N_SUMS, ROUGHNESS_SCALE, ROUGHNESS_SUM, ROUGHNESS_WEIGHT
from estimators.kalman.tuning import TUNING
from road_envs.analysis.information_bound import RoadPrior
from road_envs.kernels._numba import kernel

_DECAY = TUNING.decay


class ARModel(NamedTuple):
    """Autoregressive models of mean and half difference: `weights` (2, order) of the last nodes,
    newest first; `prediction_variance` (2,) [m²]; `covariance` (2, M) [m²] at lags of 0 to M - 1
    nodes.
    """

    weights: np.ndarray
    prediction_variance: np.ndarray
    covariance: np.ndarray

    @classmethod
    def fit(cls, prior: RoadPrior) -> "ARModel":
        """Fit autoregressive models to `prior`."""
        ds = TUNING.node_spacing
        size = 2 ** int(np.ceil(np.log2(TUNING.circulant_length / ds)))
        increment_psd = increment_amplitude(prior, size, ds) ** 2
        n = np.maximum(rfftfreq(size, ds), N_MIN)
        covariance = irfft(increment_psd / (2.0 * np.sin(np.pi * n * ds)) ** 2, size, axis=1)
        order = round(TUNING.ar_length / ds)
        phi, mean_variance = _yule_walker(irfft(increment_psd[0], size), order - 1)
        half, half_variance = _yule_walker(covariance[1], order)
        # the last increments, times phi, and the last value give the next value of the mean
        mean = np.append(phi, 0.0) - np.append(0.0, phi)
        mean[0] += 1.0
        variance = np.array([mean_variance, half_variance])
        return cls(np.array([mean, half]), variance, covariance[:, : size // 2])

    def increment_variance(self, span: int) -> np.ndarray:
        """Return the variances (2,) [m²] of the increment over `span` nodes."""
        return 2.0 * (self.covariance[:, 0] - self.covariance[:, span])

    def node_covariance(self, size: int) -> np.ndarray:
        """Return the prior covariance (2 `size`, 2 `size`) [m²] of so many nodes."""
        P = np.zeros((2 * size, 2 * size))
        for component in range(2):
            P[component::2, component::2] = toeplitz(self.covariance[component, :size])
        return P


def _yule_walker(covariance: np.ndarray, order: int) -> tuple[np.ndarray, float]:
    """Return the weights (order,) of the last values in the next, and the prediction variance."""
    weights = solve_toeplitz(covariance[:order], covariance[1 : order + 1])
    return weights, float(covariance[0] - weights @ covariance[1 : order + 1])


class RoadProcess(NamedTuple):
    """The road's model in a state vector of `n_vehicle` states and `n_nodes` nodes.

    Weights (2, order) of the last nodes in the next one, mean and half difference, and its
    `prediction_variance` (2,) [m²] for a roughness scale of 1; outside the node numbers
    `free_range` (2,) the road goes on level. The span [nodes] of the increments from which
    roughness is estimated, their variance (2,) [m²], and the number of nodes over which it is
    averaged, `roughness_memory`.
    """

    n_vehicle: int
    n_nodes: int
    weights: np.ndarray
    prediction_variance: np.ndarray
    free_range: np.ndarray
    increment_span: int
    increment_variance: np.ndarray
    roughness_memory: float

    @property
    def first_sum(self) -> int:
        """Index of the first retired-node sum."""
        return self.n_vehicle + N_BIAS

    @property
    def first_node(self) -> int:
        """Index of the first node's mean."""
        return self.first_sum + N_SUMS

    @property
    def n_states(self) -> int:
        """Size n of the state vector."""
        return self.first_node + 2 * self.n_nodes

    def node_entries(self, nodes: np.ndarray) -> np.ndarray:
        """Return the entries (2 M,) of mean and half difference of the `nodes` (M,)."""
        return ((self.first_node + 2 * (nodes % self.n_nodes))[:, None] + np.arange(2)).ravel()

    def update_roughness(
        self, x: np.ndarray, P: np.ndarray, adaptive: np.ndarray, square: np.ndarray, passed: range
    ) -> None:
        """Update the roughness scale by the increments up to each node of `passed`; one with an
        accepted step in `square` (N, 2) is none of the prior.

        One step of expectation maximization: the expected square is the squared mean plus the
        variance.
        """
        span = self.increment_span
        kept = 1.0 - 0.5 / self.roughness_memory  # half a node: there are two components
        for node in passed:
            if square[node - span - 1 : node + 2].any():
                continue
            for a, b in self.node_entries(np.array([node, node - span])).reshape(2, 2).T:
                increment = (x[a] - x[b]) ** 2 + P[a, a] + P[b, b] - 2.0 * P[a, b]
                ratio = 0.5 * increment / self.increment_variance[(a - self.first_node) % 2]
                adaptive[ROUGHNESS_SUM] = kept * adaptive[ROUGHNESS_SUM] + ratio
                adaptive[ROUGHNESS_WEIGHT] = kept * adaptive[ROUGHNESS_WEIGHT] + 0.5
        scale = adaptive[ROUGHNESS_SUM] / adaptive[ROUGHNESS_WEIGHT]
        scale = max(scale, TUNING.min_roughness_scale)
        adaptive[ROUGHNESS_SCALE] = min(scale, TUNING.max_roughness_scale)


@kernel
def _node_entry(road: RoadProcess, k):
    """Return the entry of the mean of node `k`."""
    return road.n_vehicle + N_BIAS + N_SUMS + 2 * (k % road.n_nodes)


@kernel
def _is_free(road: RoadProcess, newest):
    """Return 1.0 if the node behind the `newest` is free, 0.0 if it is level with it."""
    return 1.0 if road.free_range[0] < newest + 0.5 < road.free_range[1] else 0.0


@kernel(inline=False)
def _node_law(road: RoadProcess, newest):
    """Return the step x' = F x + e of the state vector by which the next node replaces the oldest.
    It changes the `entries` (6,), the retired-node sums and the node's mean and half difference:
    each is the sum of its `sources` (6, order), entries of x, times the `factors` (6, order).
    """
    order, first = road.weights.shape[1], road.n_vehicle + N_BIAS
    entries, sources = np.empty(6, dtype=np.int64), np.zeros((6, order), dtype=np.int64)
    factors, at = np.zeros((6, order)), _node_entry(road, newest + 1)
    a, b = np.exp(-_DECAY) * np.cos(_DECAY), np.exp(-_DECAY) * np.sin(_DECAY)
    free = _is_free(road, newest)
    for c in range(2):
        real, imaginary = first + c, first + 2 + c
        for part in range(2):
            entries[2 * part + c] = real + 2 * part
            for k, source in enumerate((real, imaginary, at + c)):
                sources[2 * part + c, k] = source
        for k in range(3):
            factors[c, k] = (a, -b, a)[k]
            factors[2 + c, k] = (b, a, b)[k]
        entries[4 + c] = at + c
        for k in range(order):
            sources[4 + c, k] = _node_entry(road, newest - k) + c
            factors[4 + c, k] = free * road.weights[c, k]
        factors[4 + c, 0] += 1.0 - free
    return entries, sources, factors


@kernel(inline=False)
def add_node(road: RoadProcess, x, P, newest, scale):
    """Replace the oldest node by the one behind the `newest`, for a roughness `scale`, in the mean
    `x` (n,) and in `P` (n, n + m). Steps of both wheel paths at it are the newest candidates.
    """
    entries, sources, factors = _node_law(road, newest)
    mean, rows, n = np.zeros(6), np.zeros((6, P.shape[1])), x.size
    # with the six rows of F that are not those of the identity: `rows` F P, and `corner` F P F' + Q
    # among the changed entries. All is read before any of it is written
    for e in range(6):
        for k in range(factors.shape[1]):
            if factors[e, k] != 0.0:
                mean[e] += factors[e, k] * x[sources[e, k]]
                rows[e] += factors[e, k] * P[sources[e, k]]
    corner = np.zeros((6, 6))
    for e in range(6):
        for k in range(factors.shape[1]):
            corner[:, e] += factors[e, k] * rows[:, sources[e, k]]
    free = _is_free(road, newest)
    for c in range(2):
        corner[4 + c, 4 + c] += scale * road.prediction_variance[c] * free
    for e in range(6):
        x[entries[e]], P[entries[e]], P[:, entries[e]] = mean[e], rows[e], rows[e, :n]
    for e in range(6):
        for i in range(6):
            P[entries[i], entries[e]] = corner[i, e]
    for side in range(2):  # a unit step of one path is half a one of mean and of half difference
        candidate = n + (2 * (newest + 1) + side) % (P.shape[1] - n)
        P[:, candidate] = 0.0
        P[entries[4], candidate] = 0.5 * free
        P[entries[5], candidate] = (0.5 - side) * free


@kernel(inline=False)
def transpose_nodes(road: RoadProcess, first, last, r):
    """Replace `r` (n, M) by F' r, F the steps that replace the nodes `first` to `last` - 1."""
    after = np.empty((6, r.shape[1]))
    for node in range(last - 1, first - 1, -1):
        entries, sources, factors = _node_law(road, node + road.n_nodes - 1)
        for e in range(6):
            after[e] = r[entries[e]]
            r[entries[e]] = 0.0
        for e in range(6):
            for k in range(factors.shape[1]):
                if factors[e, k] != 0.0:
                    r[sources[e, k]] += factors[e, k] * after[e]
