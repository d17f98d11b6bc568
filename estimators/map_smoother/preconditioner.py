"""Stationary approximation of the Gauss-Newton Hessian, as preconditioner and for noise and prior.

At constant speed, strut states and damping, the Hessian is a matrix P(n) (2, 2) for mean and half
difference at each spatial frequency n,

    P(n) = I + (H T)* (H T) fs ds / (v R)

with H the response of the linear vehicle, T that of the heights to the noise u, fs / R the
measurements' information per second and ds / v the time from node to node. Friction makes the true
information vary along the drive, from strut to strut and from moment to moment, by more than a
factor of ten either way. The preconditioner is therefore P^-1/2: on class-D roads it needs a
quarter of the iterations of P^-1 or of no preconditioner. Where the road is rough in places only,
the nodes are shared out among levels of local roughness, and the preconditioner is the sum of those
of the levels.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq
from scipy.linalg import solve_continuous_lyapunov
from scipy.ndimage import gaussian_filter1d

from estimators.common.bending import BODY
from estimators.common.conjugate_gradients import Operator
from estimators.common.gaps import read_share
from estimators.map_smoother.objective import Linearization, Means, Objective
from estimators.map_smoother.one_pass import Pass
from estimators.map_smoother.road_prior import TO_WHEEL_PATHS, RoadTransform
from estimators.map_smoother.tuning import TUNING
from road_envs.vehicle.linear_model import (
    LinearModel,
    frequency_response,
    gaussian_damping,
    linearise,
)
from road_envs.vehicle.suspension import MODES, WHEELS, decode_commands

ROUGHNESS_STEPS = np.geomspace(*TUNING.roughness_range, TUNING.roughness_steps)
"""Local roughness, from its least to its greatest value, at which tables are computed."""


class _PassInformation(NamedTuple):
    """Information of the measurements of one pass, if of unit variance: `on_road` (F, 2, 2) on the
    heights of mean and half difference at each spatial frequency of the road, `on_start` (14,) on
    each coordinate of the initial vehicle state. The pass has `covered` this share of the nodes
    that any pass covers, and its sensors have `read` this share (K,) of its way over each of them.
    """

    on_road: np.ndarray
    on_start: np.ndarray
    covered: float
    read: np.ndarray


@dataclass(frozen=True, eq=False)
class StationaryHessian:
    """Stationary Hessian of P `passes`, whose information adds; noise variances (P,) [(m/s²)²] are
    those of a sample of each.
    """

    passes: tuple[_PassInformation, ...]

    @property
    def read(self) -> np.ndarray:
        """Share (K,) of the way over each node that the sensors of any pass have read; 1 ahead."""
        return np.max([one.read for one in self.passes], axis=0)

    def reweighted(self, objective: Objective, weights: Means) -> "StationaryHessian":
        """The Hessian for measurements with weights (J // 2 + 1,) on their frequencies."""
        passes = []
        for known, one, part in zip(self.passes, objective.passes, weights, strict=True):
            f = rfftfreq(one.measurements.y.shape[1], one.block_duration)
            response = np.interp(objective.road.n * one.inputs.v.mean(), f, part)
            passes.append(known._replace(on_road=known.on_road * response[:, None, None]))
        return StationaryHessian(tuple(passes))

    def of_pass(self, k: int) -> "StationaryHessian":
        return StationaryHessian((self.passes[k]._replace(covered=1.0),))

    def excess(self, road: RoadTransform, noise_variance: np.ndarray) -> np.ndarray:
        """P(n) (F, 2, 2) under the noise variances (P,), less that of the prior, which is 1."""
        T = road.transfer_function().T
        pairs = zip(self.passes, noise_variance, strict=True)
        information = np.sum([one.on_road / variance for one, variance in pairs], axis=0)
        return information * T.conj()[:, :, None] * T[:, None, :]

    def preconditioner(self, lin: Linearization, noise_variance: np.ndarray) -> Operator:
        """A function that maps a gradient at `lin` to a step, under noise variances (P,)."""
        road = lin.objective.road
        offset_scale = lin.offset_scale(noise_variance, [one.on_start for one in self.passes])
        excess = self.excess(road, noise_variance)
        # levels of local roughness, and the nodes' shares in them, which add to 1
        log = 0.5 * np.log(np.mean(road.local**2, axis=0))
        count = 1 + int(np.ceil(np.ptp(log) / TUNING.max_level_step))
        levels = np.linspace(log.min(), log.max(), count)
        shares = [np.interp(log, levels, row) for row in np.eye(count)]
        roots = [
            (np.sqrt(share), _inverse(_root(np.eye(2) + level**2 * excess)))
            for level, share in zip(np.exp(levels), shares, strict=True)
        ]

        def apply(g: np.ndarray) -> np.ndarray:
            u, rest = np.split(g, [2 * road.size])
            u = u.reshape(2, -1)
            step = (1.0 - road.free) * u
            for share, root in roots:
                U = np.einsum("fij,jf->if", root, rfft(share * road.free * u, axis=1))
                step += share * road.free * irfft(U, road.size, axis=1)
            return np.concatenate([step.ravel(), rest / offset_scale])

        return apply

    def effective_dof(self, road: RoadTransform, noise_variance: np.ndarray) -> np.ndarray:
        """Number (P,) of the road's unknowns that each pass determines, in all those that the
        passes do together, shared out by the traces of posterior covariance times information.
        """
        covariance = _inverse(np.eye(2) + self.excess(road, noise_variance))
        left = np.real(np.trace(covariance, axis1=1, axis2=2))
        T = road.transfer_function().T
        product = T.conj()[:, :, None] * T[:, None, :]
        pairs = zip(self.passes, noise_variance, strict=True)
        each = (one.on_road / variance * product for one, variance in pairs)
        traces = np.array([np.einsum("fij,fji->f", covariance, x).real.mean() for x in each])
        covered = np.array([one.covered for one in self.passes])
        known = np.sum(road.free * self.read)
        return known * np.mean(2.0 - left) * covered * (traces / max(traces.sum(), 1e-300))

    def density_of(
        self, road: RoadTransform, noise_variance: np.ndarray, u: np.ndarray
    ) -> np.ndarray:
        """Return the density (F,) over the prior's that the road of `u` (2, K) suggests: in each
        octave the power of `u` over the number of its unknowns that are determined (MacKay 1992,
        doi:10.1162/neco.1992.4.3.415); where these are too few, the ratio of the nearest octave.
        """
        power = np.sum(np.abs(rfft(road.free * u, axis=1)) ** 2, axis=0) / max(road.free.sum(), 1.0)
        read = np.sum(road.free * self.read) / max(road.free.sum(), 1.0)
        left = _posteriors(self.excess(road, noise_variance), np.ones(1))[0]
        told = read * np.sum(1.0 - left, axis=1)
        octave = np.round(np.log2(np.maximum(road.n, road.n[1])))
        centre, group = np.unique(octave, return_inverse=True)
        lines = np.bincount(group)
        power, told, before = (np.bincount(group, x) for x in (power, told, np.log(road.density)))
        enough = (told >= 2.0 * TUNING.least_told * lines) & (told >= TUNING.least_count)
        if not enough.any():
            return road.density
        ratio = np.maximum(power / np.maximum(told, 1e-9), TUNING.min_density_ratio)
        log = before / lines + np.log(ratio)
        return np.exp(np.interp(np.log2(np.maximum(road.n, 1e-9)), centre[enough], log[enough]))

    def local_roughness(
        self, road: RoadTransform, noise_variance: np.ndarray, u: np.ndarray, passed: np.ndarray
    ) -> np.ndarray:
        """Return the local roughness (2, K) that `u` (2, K) suggests, relative to the spectrum, by
        what is known of the nodes that wheels have `passed` (K,): the power of the increments in a
        narrow window over the share of it that the measurements resolve (MacKay 1992,
        doi:10.1162/neco.1992.4.3.415), but no less than a share of that in a wide one. Some
        increments of a prior roughness are added, so the distribution of the increments is
        Student's: a few large ones, the edges of an obstacle, are more probable than many small
        ones.
        """
        w = road.local * (TO_WHEEL_PATHS @ u) * np.sqrt(0.5) * road.free
        excess = self.excess(road, noise_variance)
        told = 1.0 - _posteriors(excess, ROUGHNESS_STEPS).mean(axis=(1, 2))
        resolved = road.free * self.read * np.interp(road.local, ROUGHNESS_STEPS, told)
        passed = passed & (self.read > 0.5)

        def variance_within(length: float) -> np.ndarray:
            width = length / road.ds
            count = np.sqrt(2.0 * np.pi) * width  # of nodes in the window
            power, dof = (count * gaussian_filter1d(x, width, axis=1) for x in (w**2, resolved))
            prior = TUNING.prior_count * TUNING.prior_roughness**2
            return np.asarray((power + prior) / (dof + TUNING.prior_count))

        wide = variance_within(TUNING.local_length)
        contrast = np.log(wide[:, passed].mean()) - np.log(wide[:, passed]).mean()
        if not contrast > TUNING.min_contrast:
            return np.ones_like(wide)
        variance = np.maximum(variance_within(TUNING.edge_length), TUNING.level_share * wide)
        local = np.sqrt(variance / variance[:, passed].mean())  # the mean power is the spectrum's
        local = np.where(self.read > 0.5, local, 1.0)
        return np.clip(local, ROUGHNESS_STEPS[0], ROUGHNESS_STEPS[-1])

    def error_variance(
        self, road: RoadTransform, noise_variance: np.ndarray, lines: np.ndarray
    ) -> np.ndarray:
        """Return the variance (2, K) of the heights' error at the local roughness, in the spatial
        frequencies `lines` (F,) alone and up to a factor.
        """
        density = 0.5 * np.abs(road.transfer_function().T) ** 2
        posteriors = _posteriors(self.excess(road, noise_variance), ROUGHNESS_STEPS)
        variance = ROUGHNESS_STEPS**2 * np.sum((density * posteriors)[:, lines], axis=(1, 2))
        return np.interp(road.local, ROUGHNESS_STEPS, variance)


def stationary_hessian(objective: Objective) -> StationaryHessian:
    """The Hessian of `objective`, each pass at its mean speed, strut states by their duration."""
    road, station = objective.road, objective.road.stations
    spans = [(one.inputs.s[0] - one.model.wheelbase, one.inputs.s[-1]) for one in objective.passes]
    passed = np.array([(station >= first) & (station <= last) for first, last in spans])
    ahead, free = ~passed.any(axis=0), passed[:, road.free > 0]
    shares = np.sum(free, axis=1) / max(np.any(free, axis=0).sum(), 1)
    parts = []
    for one, there, share in zip(objective.passes, passed, shares, strict=True):
        blocks = one.measurements
        size = blocks.sample_weight.shape[2]
        middle = one.inputs.decimation * size * (2 * np.arange(blocks.y.shape[1]) + 1)
        s = one.inputs.s[np.minimum(middle, one.inputs.s.size - 1)]
        # what one sensor at least has read
        part = blocks.sample_count.max(axis=0) / size
        read = np.where(there, read_share(station, s, part, one.model.wheelbase), ahead)
        information = _road_information(one, road), _start_information(one)
        parts.append(_PassInformation(*information, share, read))
    return StationaryHessian(tuple(parts))


def _road_information(one: Pass, road: RoadTransform) -> np.ndarray:
    inputs = one.inputs
    n, v = np.maximum(road.n, 1e-6), float(inputs.v.mean())
    parts = ((share * H.conj(), H) for share, H in linear_responses(one, n * v))
    information = np.sum([np.einsum("fsi,fsj->fij", dual, H) for dual, H in parts], axis=0)
    fs = 1.0 / (inputs.h * inputs.decimation)
    response = np.sinc(n * v * one.measurements.sample_weight.shape[2] / fs) ** 2
    response *= n * v <= one.model.bandwidth
    return np.asarray(information * (response * fs * road.ds / v)[:, None, None])


def _posteriors(excess: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Posterior over prior variance (D, F, 2) of `u` at the local roughness `local` (D,), by the
    `excess` (F, 2, 2) of P(n) over the prior.
    """
    matrices = (_inverse(np.eye(2) + d**2 * excess) for d in local)
    return np.array([np.real(M[:, [0, 1], [0, 1]]) for M in matrices])


def linear_responses(one: Pass, f: np.ndarray) -> Iterator[tuple[float, np.ndarray]]:
    """Yield the share of each strut state in the drive, and the response (F, S, 2) of the sensors
    in it at `f` (F,) [Hz] to mean and half difference.
    """
    inputs, model, v = one.inputs, one.model, float(one.inputs.v.mean())
    response = np.sinc(f / v * model.contact_length)
    if model.filter is not None:
        response = response * model.filter.response(f)
    for command, count in zip(*np.unique(inputs.commands, return_counts=True), strict=True):
        H = frequency_response(_linear_model(one, command), v, f=f)
        if model.bending is not None:
            H = model.bending.response(H, f)
        yield count / inputs.n_steps, response[:, None, None] * H @ TO_WHEEL_PATHS


def _linear_model(one: Pass, command: int) -> LinearModel:
    """Return the linear vehicle in the strut states of a `command` byte, with the points whose
    accelerations the sensors need.
    """
    model = one.model
    stiff, high = (flags[0].tolist() for flags in decode_commands(np.array([command])))
    names = {flags: name for name, flags in MODES.items()}
    mode = {w: names[k, c] for w, k, c in zip(WHEELS, stiff, high, strict=True)}
    damping = gaussian_damping(model.plant, mode, TUNING.damping_rate)
    locations = {**model.locations, **({} if model.bending is None else BODY)}
    v = float(one.inputs.v.mean())
    return linearise(model.plant, mode, locations, damping=damping, speed=v)


def _start_information(one: Pass) -> np.ndarray:
    """Information (14,) on the initial vehicle state: the diagonal of the observability Gramian,
    the integral over time of the squared accelerations that all sensors have after a unit deviation
    of a coordinate, times the sampling rate.
    """
    linear = _linear_model(one, one.inputs.commands[0])
    C = linear.C[: len(one.model.locations)]
    fs = 1.0 / (one.inputs.h * one.inputs.decimation)
    return fs * np.diag(solve_continuous_lyapunov(linear.A.T, -C.T @ C))


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
