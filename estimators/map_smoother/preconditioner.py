"""The same drive as if speed, struts and dampers never changed: what each wave of the road would be
worth by itself.

Then Gauss and Newton's Hessian is a matrix P(n) (2, 2) for each line n of mean and half difference,

    P(n) = I + (H T)* (H T) fs ds / (v R)

with H the response of the linear car, T that of the heights to the noise u, fs / R the readings'
information in a second and ds / v the time between two nodes. Friction makes the true one vary
along the drive by more than a factor of ten either way, from strut to strut and from moment to
moment. The preconditioner is therefore P^-1/2: on class-D roads it needs a quarter of the
iterations of P^-1, and of none at all.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq

from estimators.map_smoother.objective import Problem
from estimators.map_smoother.road_prior import TO_PATHS, Road
from road_envs.vehicle.linear_model import frequency_response, gaussian_damping, linearise
from road_envs.vehicle.suspension import MODES, WHEELS, strut_states

RATE = 0.3
"""Typical rate of the struts [m/s] for which their dampers stand."""

DECIDED = 10.0
"""A line counts as decided by the readings from this many times the prior's information on."""


LOWEST = 1e-4
"""Share of the prior's density below which a level is not taken in one go: a road may be flat."""


@dataclass(frozen=True, eq=False)
class Stationary:
    """`weight` (F, 2, 2): information of readings of unit variance on the heights of mean and half
    difference at each line of the road.
    """

    weight: np.ndarray

    def hearing(self, problem: Problem, gain: np.ndarray) -> "Stationary":
        """The same if each frequency of the readings (J // 2 + 1,) counts times `gain`."""
        course = problem.course
        block = course.h * course.every * problem.readings.share.shape[2]
        f = rfftfreq(problem.readings.y.shape[1], block)
        heard = np.interp(problem.road.n * course.v.mean(), f, gain)
        return Stationary(self.weight * heard[:, None, None])

    def precision(self, road: Road, noise: float) -> np.ndarray:
        """P(n) (F, 2, 2) under a `noise` [(m/s²)²] of each sample."""
        T = road.transfer().T
        return np.eye(2) + self.weight / noise * T.conj()[:, :, None] * T[:, None, :]

    def preconditioner(self, problem: Problem, noise: float) -> Callable[[np.ndarray], np.ndarray]:
        """A function that takes a gradient to a step."""
        road = problem.road
        root = _inverse(_root(self.precision(road, noise)))
        count = problem.readings.count.sum(axis=1)
        offsets = np.sqrt(1.0 + problem.belief.offset**2 * count / noise)
        others = np.concatenate([np.ones(problem.reach.size), offsets])

        def apply(g: np.ndarray) -> np.ndarray:
            u, rest = np.split(g, [2 * road.size])
            u = u.reshape(2, -1)
            U = np.einsum("fij,jf->if", root, rfft(road.free * u, axis=1))
            step = road.free * irfft(U, road.size, axis=1) + (1.0 - road.free) * u
            return np.concatenate([step.ravel(), rest / others])

        return apply

    def decided(self, road: Road, noise: float) -> float:
        """How many of the road's unknowns the readings decide in all."""
        left = np.real(np.trace(_inverse(self.precision(road, noise)), axis1=1, axis2=2))
        return float(road.free.sum() * np.mean(2.0 - left))

    def levels(self, road: Road, noise: float, u: np.ndarray) -> np.ndarray:
        """Density (F,) of `u` (2, K) over its expectation at each line: what the prior should have
        been, an octave at a time, from the lines that the readings decide (empirical Bayes).
        """
        U = np.abs(rfft(road.free * u, axis=1)) ** 2 / max(road.free.sum(), 1.0)
        P = self.precision(road, noise)
        decided = np.real(P[:, [0, 1], [0, 1]].T) > DECIDED
        octave = np.round(np.log2(np.maximum(road.n, road.n[1])))
        centres, of = np.unique(octave, return_inverse=True)
        power = np.array(
            [np.sum(U[:, of == k], where=decided[:, of == k]) for k in range(of.max() + 1)]
        )
        lines = np.array([np.sum(decided[:, of == k]) for k in range(of.max() + 1)])
        known = lines >= 8
        if not known.any():
            return np.ones_like(road.n)
        level = np.log(np.maximum(power[known] / lines[known], LOWEST))
        return np.exp(np.interp(np.log2(np.maximum(road.n, 1e-9)), centres[known], level))


def stationary_picture(problem: Problem) -> Stationary:
    """The stationary picture of a problem at its mean speed; states count by the time they last."""
    road, course = problem.road, problem.course
    n, v = np.maximum(road.n, 1e-6), float(course.v.mean())
    weight = np.zeros((n.size, 2, 2), dtype=complex)
    for byte, times in zip(*np.unique(course.commands, return_counts=True), strict=True):
        mode = _mode(int(byte))
        damping = gaussian_damping(problem.belief.plant, mode, RATE)
        model = linearise(problem.belief.plant, mode, problem.belief.places, damping=damping)
        H = frequency_response(model, v, n=n) @ TO_PATHS
        weight += times / course.steps * np.einsum("fsi,fsj->fij", H.conj(), H)
    fs = 1.0 / (course.h * course.every)
    heard = np.sinc(n * v * problem.readings.share.shape[2] / fs) ** 2
    return Stationary(weight * (heard * fs * road.ds / v)[:, None, None])


def _mode(byte: int) -> dict[str, str]:
    """The command of each wheel in a byte."""
    stiff, high = strut_states(np.array([byte]))
    names = {flags: name for name, flags in MODES.items()}
    return {w: names[bool(stiff[0, i]), bool(high[0, i])] for i, w in enumerate(WHEELS)}


def _root(M: np.ndarray) -> np.ndarray:
    """Square roots of positive matrices (F, 2, 2): (M + det^1/2) / (tr + 2 det^1/2)^1/2."""
    det = np.sqrt(_determinant(M))[:, None, None]
    trace = np.real(np.trace(M, axis1=1, axis2=2))[:, None, None]
    return (M + det * np.eye(2)) / np.sqrt(trace + 2.0 * det)


def _inverse(M: np.ndarray) -> np.ndarray:
    """Inverses of Hermitian matrices (F, 2, 2)."""
    turned = np.stack([M[:, 1, 1], -M[:, 0, 1], -M[:, 1, 0], M[:, 0, 0]], axis=1)
    return turned.reshape(-1, 2, 2) / _determinant(M)[:, None, None]


def _determinant(M: np.ndarray) -> np.ndarray:
    """Determinants (F,) of Hermitian matrices (F, 2, 2)."""
    return np.real(M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0])
