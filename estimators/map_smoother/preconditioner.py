"""Stationary approximation of the Gauss-Newton Hessian, as preconditioner and for noise and prior.

At constant speed, strut states and damping, the Hessian is a matrix P(n) (2, 2) for mean and half
difference at each spatial frequency n,

    P(n) = I + (H T)* (H T) fs ds / (v R)

with H the response of the linear vehicle, T that of the heights to the noise u, fs / R the
measurements' information per second and ds / v the time from node to node. Friction makes the true
information vary along the drive, from strut to strut and from moment to moment, by more than a
factor of ten either way. The preconditioner is therefore P^-1/2: on class-D roads it needs a
quarter of the iterations of P^-1 or of no preconditioner.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq

from estimators.map_smoother.objective import Objective
from estimators.map_smoother.road_prior import TO_WHEEL_PATHS, RoadTransform
from road_envs.vehicle.linear_model import frequency_response, gaussian_damping, linearise
from road_envs.vehicle.suspension import MODES, WHEELS, decode_commands

DAMPING_RATE = 0.3
"""Typical strut rate [m/s] at which the dampers are linearized."""

RESOLVED_THRESHOLD = 10.0
"""A frequency counts as resolved if the posterior precision is this many times the prior's."""


MIN_DENSITY_RATIO = 1e-4
"""Least density, relative to the prior's, that one update takes: a road may be level."""


@dataclass(frozen=True, eq=False)
class StationaryHessian:
    """Stationary Hessian: `information` (F, 2, 2) of measurements of unit variance on the heights
    of mean and half difference, at each spatial frequency of the road.
    """

    information: np.ndarray

    def reweighted(
        self, objective: Objective, frequency_weights: np.ndarray
    ) -> "StationaryHessian":
        """Return the Hessian for measurements with weights (J // 2 + 1,) on their frequencies."""
        inputs = objective.inputs
        block = inputs.h * inputs.decimation * objective.measurements.sample_weight.shape[2]
        f = rfftfreq(objective.measurements.y.shape[1], block)
        response = np.interp(objective.road.n * inputs.v.mean(), f, frequency_weights)
        return StationaryHessian(self.information * response[:, None, None])

    def precision(self, road: RoadTransform, noise_variance: float) -> np.ndarray:
        """Return P(n) (F, 2, 2) under a `noise_variance` [(m/s²)²] of each sample."""
        T = road.transfer_function().T
        return np.eye(2) + self.information / noise_variance * T.conj()[:, :, None] * T[:, None, :]

    def preconditioner(
        self, objective: Objective, noise_variance: float
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function that maps a gradient to a step."""
        road = objective.road
        root = _inverse(_root(self.precision(road, noise_variance)))
        count = objective.measurements.sample_count.sum(axis=1)
        bias = np.sqrt(1.0 + objective.model.bias_std**2 * count / noise_variance)
        scale = np.concatenate([np.ones(objective.initial_std.size), bias])

        def apply(g: np.ndarray) -> np.ndarray:
            u, rest = np.split(g, [2 * road.size])
            u = u.reshape(2, -1)
            U = np.einsum("fij,jf->if", root, rfft(road.free * u, axis=1))
            step = road.free * irfft(U, road.size, axis=1) + (1.0 - road.free) * u
            return np.concatenate([step.ravel(), rest / scale])

        return apply

    def effective_dof(self, road: RoadTransform, noise_variance: float) -> float:
        """Return the number of the road's unknowns that the measurements determine."""
        left = np.real(np.trace(_inverse(self.precision(road, noise_variance)), axis1=1, axis2=2))
        return float(road.free.sum() * np.mean(2.0 - left))

    def density_scale(
        self, road: RoadTransform, noise_variance: float, u: np.ndarray
    ) -> np.ndarray:
        """Return the density (F,) of `u` (2, K) over its expectation, averaged over octaves.

        Resolved frequencies alone count: an empirical Bayes estimate of the prior's scale.
        """
        U = np.abs(rfft(road.free * u, axis=1)) ** 2 / max(road.free.sum(), 1.0)
        P = self.precision(road, noise_variance)
        resolved = np.real(P[:, [0, 1], [0, 1]].T) > RESOLVED_THRESHOLD
        octave = np.round(np.log2(np.maximum(road.n, road.n[1])))
        centre, group = np.unique(octave, return_inverse=True)
        members = [group == k for k in range(group.max() + 1)]
        power = np.array([np.sum(U[:, k], where=resolved[:, k]) for k in members])
        lines = np.array([np.sum(resolved[:, k]) for k in members])
        enough = lines >= 8
        if not enough.any():
            return np.ones_like(road.n)
        level = np.log(np.maximum(power[enough] / lines[enough], MIN_DENSITY_RATIO))
        return np.exp(np.interp(np.log2(np.maximum(road.n, 1e-9)), centre[enough], level))


def stationary_hessian(objective: Objective) -> StationaryHessian:
    """Return the Hessian of `objective` at its mean speed; strut states count by their duration."""
    road, inputs = objective.road, objective.inputs
    n, v = np.maximum(road.n, 1e-6), float(inputs.v.mean())
    information = np.zeros((n.size, 2, 2), dtype=complex)
    for byte, count in zip(*np.unique(inputs.commands, return_counts=True), strict=True):
        mode = _decode_mode(int(byte))
        damping = gaussian_damping(objective.model.plant, mode, DAMPING_RATE)
        model = linearise(objective.model.plant, mode, objective.model.locations, damping=damping)
        H = frequency_response(model, v, n=n) @ TO_WHEEL_PATHS
        information += count / inputs.n_steps * np.einsum("fsi,fsj->fij", H.conj(), H)
    fs = 1.0 / (inputs.h * inputs.decimation)
    response = np.sinc(n * v * objective.measurements.sample_weight.shape[2] / fs) ** 2
    return StationaryHessian(information * (response * fs * road.ds / v)[:, None, None])


def _decode_mode(byte: int) -> dict[str, str]:
    """Return the command of each wheel in a byte."""
    stiff, high = decode_commands(np.array([byte]))
    names = {flags: name for name, flags in MODES.items()}
    return {w: names[bool(stiff[0, i]), bool(high[0, i])] for i, w in enumerate(WHEELS)}


def _root(M: np.ndarray) -> np.ndarray:
    """Return the square roots of positive matrices (F, 2, 2)."""
    # Cayley and Hamilton: (M + det^1/2) / (tr + 2 det^1/2)^1/2
    det = np.sqrt(_determinant(M))[:, None, None]
    trace = np.real(np.trace(M, axis1=1, axis2=2))[:, None, None]
    return (M + det * np.eye(2)) / np.sqrt(trace + 2.0 * det)


def _inverse(M: np.ndarray) -> np.ndarray:
    """Return the inverses of Hermitian matrices (F, 2, 2)."""
    adjugate = np.stack([M[:, 1, 1], -M[:, 0, 1], -M[:, 1, 0], M[:, 0, 0]], axis=1)
    return adjugate.reshape(-1, 2, 2) / _determinant(M)[:, None, None]


def _determinant(M: np.ndarray) -> np.ndarray:
    """Return the determinants (F,) of Hermitian matrices (F, 2, 2)."""
    return np.real(M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0])
