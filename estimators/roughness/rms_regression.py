"""Roughness from the RMS of the accelerations: a Gaussian-process regression over speed and RMS.

The RMS acceleration grows with roughness and speed. The relation is learned from drives over known
roads, without a vehicle model (after Heyns, de Villiers & Heyns, "Consistent haul road condition
monitoring by means of vehicle response normalisation with Gaussian processes", Eng. Appl. Artif.
Intell. 25, 2012):

    y = b . x + g(x) + e       x: 1 and the logarithms of the speed and of the RMS of the
                               accelerations of front, rear and roll; y: the logarithm of G_d(n0)

b has a wide normal prior, g is a Gaussian process with squared-exponential covariance and a length
scale per input, e is noise (Rasmussen & Williams, "Gaussian Processes for Machine Learning", 2006,
sections 2.2, 2.7 and 5.4.1). Amplitudes and length scales maximise the marginal likelihood. The
posterior of y is normal, so classes have probabilities as in `spectral.py`.

Limitations: strut states and speeds outside the training data; roads of another waviness, since
one RMS per sensor does not resolve frequency; single obstacles, which mislead it more than
`spectral` (`studies/roughness_alone.py`). Drives of the described vehicle alone would teach an
interval that no other vehicle keeps to.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from estimators.common.spatial_signals import N_MOTIONS, body_motions
from estimators.preprocessing import clean_record
from estimators.roughness.spectral import class_probabilities, scored_octaves
from road_envs.records.record import Profile, Record
from road_envs.records.roughness import displacement_psd, octave_levels

N_INPUTS = 1 + N_MOTIONS
SLOPE_STD = 3.0  # standard deviation of b for standardised inputs and output: a wide prior
# Bounds of the hyperparameters theta: logarithms of the process amplitude, of its length scales
# and of the noise amplitude, for inputs and output of standard deviation 1
_THETA_BOUNDS = ((-4.0, 1.5), *((-1.5, 4.0),) * N_INPUTS, (-5.0, 0.0))


class RoughnessEstimate(NamedTuple):
    """`G_d0` [m³] of a road over the scored octaves, the standard deviation `log_std` of its
    natural logarithm, and the `probability` of each class by letter.
    """

    G_d0: float
    log_std: float
    probability: dict[str, float]

    @property
    def letter(self) -> str:
        """The most probable class."""
        return max(self.probability, key=self.probability.__getitem__)


@dataclass(frozen=True, eq=False)
class RmsRoughness:
    """A fitted regression: standardised inputs `x` (N, N_INPUTS) and outputs `y` (N,), mean and
    standard deviation of inputs and output (2, N_INPUTS + 1) before it, and `theta`, logarithms as
    in _THETA_BOUNDS.
    """

    x: np.ndarray
    y: np.ndarray
    scales: np.ndarray
    theta: np.ndarray

    @classmethod
    def fit(cls, records: Sequence[Record], truths: Sequence[Profile]) -> Self:
        """Fit to drives over known roads. Raises RecordError."""
        X = np.array([_features(record) for record in records])
        pairs = zip(records, truths, strict=True)
        levels = [roughness_level(truth, float(np.nanmedian(x.v))) for x, truth in pairs]
        table = np.column_stack([X, np.log(levels)])
        mean, std = table.mean(axis=0), table.std(axis=0)
        std = np.where(std > 1e-9, std, 1.0)  # of a constant column 1
        x, y = np.split((table - mean) / std, [N_INPUTS], axis=1)
        start = np.array([-1.0, *np.full(N_INPUTS, 1.0), -1.5])
        loss = partial(_neg_log_marginal_likelihood, x, y[:, 0])
        optimum = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=_THETA_BOUNDS)
        return cls(x, y[:, 0], np.array([mean, std]), optimum.x)

    def predict(self, record: Record) -> RoughnessEstimate:
        """Return the roughness of the road of a `record`. Raises RecordError."""
        x_scale, (y_mean, y_std) = self.scales[:, :-1], self.scales[:, -1]
        at = (_features(record) - x_scale[0]) / x_scale[1]
        mean, std = _predict_gp(self.x, self.y, self.theta, at[None])
        log_level, log_std = float(y_mean + y_std * mean[0]), float(y_std * std[0])
        probability = class_probabilities(log_level, log_std)
        return RoughnessEstimate(float(np.exp(log_level)), log_std, probability)


def _features(record: Record) -> np.ndarray:
    """Return log speed and log RMS of front, rear and roll (N_INPUTS,). Raises RecordError."""
    record, _ = clean_record(record)
    on_road = (record.s >= 0.0) & (record.s <= record.length)
    on_road = on_road if on_road.any() else np.ones(record.s.size, dtype=bool)
    a = body_motions(record, causal=False)[:N_MOTIONS, on_road]
    rms = np.sqrt(np.mean(a**2, axis=1))
    return np.log(np.maximum([np.median(record.v[on_road]), *rms], 1e-6))


def roughness_level(truth: Profile, v: float) -> float:
    """Return G_d(n0) [m³] of both paths: geometric mean over the octaves scored at `v` [m/s]."""
    centres = scored_octaves(v)
    _, levels = octave_levels(*displacement_psd(truth.z, truth.ds), (centres[0], centres[-1]))
    return float(np.exp(np.mean(np.log(np.maximum(levels.mean(axis=0), 1e-12)))))


def _covariance(x: np.ndarray, at: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariances (N, M) of linear part and process for inputs (N, k), (M, k)."""
    scaled_difference = (x[:, None] - at[None]) * np.exp(-theta[1:-1])
    line = SLOPE_STD**2 * (1.0 + x @ at.T)
    return line, np.exp(2.0 * theta[0] - 0.5 * np.sum(scaled_difference**2, axis=2))


def _neg_log_marginal_likelihood(
    x: np.ndarray, y: np.ndarray, theta: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the negative log marginal likelihood of `y` (N,) at `x` (N, k), and its gradient."""
    line, process = _covariance(x, x, theta)
    noise = np.exp(2.0 * theta[-1]) * np.eye(y.size)
    factor = cho_factor(line + process + noise, lower=True)
    inverse = cho_solve(factor, np.eye(y.size))
    alpha = inverse @ y
    value = 0.5 * y @ alpha + np.log(np.diag(factor[0])).sum() + 0.5 * y.size * np.log(2.0 * np.pi)
    scaled_difference = (x[:, None] - x[None]) * np.exp(-theta[1:-1])
    slopes = [
        2.0 * process,
        *(process * scaled_difference[:, :, d] ** 2 for d in range(x.shape[1])),
        2.0 * noise,
    ]
    inner = inverse - np.outer(alpha, alpha)
    return float(value), np.array([0.5 * np.sum(inner * slope) for slope in slopes])


def _predict_gp(
    x: np.ndarray, y: np.ndarray, theta: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation (M,), noise included, of the outputs at inputs `at` (M,
    k). `y` (N,): the known outputs at `x` (N, k).
    """
    noise = np.exp(2.0 * theta[-1])
    K = np.add(*_covariance(x, x, theta)) + noise * np.eye(y.size)
    across, own = np.add(*_covariance(at, x, theta)), np.add(*_covariance(at, at, theta))
    solved = cho_solve(cho_factor(K, lower=True), np.column_stack([y, across.T]))
    variance = np.diag(own) + noise - np.einsum("mn,nm->m", across, solved[:, 1:])
    return across @ solved[:, 0], np.sqrt(variance)
