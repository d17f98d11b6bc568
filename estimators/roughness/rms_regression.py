"""Roughness of a road from the RMS of the accelerations, freed of the speed by a Gaussian process.

How hard a car shakes tells how rough a road is, once it is known how hard it shakes at this speed
in these states. That is learnt from drives over known roads and nothing else, no model of the car
(after Heyns, de Villiers & Heyns, "Consistent haul road condition monitoring by means of vehicle
response normalisation with Gaussian processes", Eng. Appl. Artif. Intell. 25, 2012):

    y = b . x + g(x) + e       x: 1 and the logarithms of the speed and of the RMS of the
                               accelerations of front, rear and roll; y: the logarithm of G_d(n0)

with a wide normal prior on b, g a Gaussian process of squared exponential covariance with a length
for each input, e noise (Rasmussen & Williams, "Gaussian Processes for Machine Learning", 2006,
sections 2.2, 2.7 and 5.4.1). Amplitudes and lengths are those of the greatest marginal likelihood.
The posterior of y is normal, so classes have probabilities as in `spectral_class.py`.

Measured on 60 roads of 200 m as the corpus has them, at 14.5 to 54 km/h, a regression on 60 others
for each of ride, handling, and ride in front with handling behind: the median error is 0.5 dB, its
RMS 2.1 to 2.5 dB, the class right in 83 %. `spectral_class` on the same: 0.4, 0.9 to 1.1 dB, 92 %.
The RMS errors come from roads with single obstacles; on stationary roads both are as good.

Known to fail: in states and at speeds that it was not taught; on roads whose waviness differs, for
one number per sensor does not tell at which frequency the road is rough.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from estimators.common.spatial_signals import N_MOTIONS, body_motions
from estimators.preprocessing import clean_record
from estimators.roughness.spectral import class_probabilities, scored_octaves
from road_envs.analysis.roughness import displacement_psd, octave_levels
from road_envs.data.record import Profile, Record

N_INPUTS = 1 + N_MOTIONS
SLOPE_STD = 3.0
"""Standard deviation of b, of standardised inputs and output: wide."""

THETA_BOUNDS = ((-4.0, 1.5), *((-1.5, 4.0),) * N_INPUTS, (-5.0, 0.0))
"""Logarithms of the process's amplitude, of its lengths and of the noise's amplitude stay inside;
inputs and output have a standard deviation of 1."""


class RoughnessEstimate(NamedTuple):
    """`G_d0` [m³] of a road in the judged octaves, the standard deviation `log_std` of its natural
    logarithm, and the `probability` of each class by its letter.
    """

    G_d0: float
    log_std: float
    probability: dict[str, float]

    @property
    def letter(self) -> str:
        """The likeliest class."""
        return max(self.probability, key=lambda name: self.probability[name])


class Standardizer(NamedTuple):
    """Means and standard deviations of columns."""

    mean: np.ndarray
    std: np.ndarray

    @classmethod
    def fit(cls, x: np.ndarray) -> "Standardizer":
        """Those of `x` (N, k); a column that does not vary has none."""
        std = x.std(axis=0)
        return cls(x.mean(axis=0), np.where(std > 1e-9, std, 1.0))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Columns (N, k) standardised."""
        return (x - self.mean) / self.std


@dataclass(frozen=True, eq=False)
class RmsRoughness:
    """A fitted regression: standardised inputs `x` (N, INPUTS) and outputs `y` (N,) with their
    scales, and `theta`, logarithms as in LIMITS.
    """

    x: np.ndarray
    y: np.ndarray
    x_scale: Standardizer
    y_scale: Standardizer
    theta: np.ndarray

    @classmethod
    def fit(cls, records: Sequence[Record], truths: Sequence[Profile]) -> Self:
        """From drives over known roads. Raises RecordError."""
        X = np.array([features(record) for record in records])
        pairs = zip(records, truths, strict=True)
        Y = np.log([roughness_level(truth, float(np.median(record.v))) for record, truth in pairs])[
            :, None
        ]
        scales = Standardizer.fit(X), Standardizer.fit(Y)
        x, y = scales[0](X), scales[1](Y)[:, 0]
        start = np.array([-1.0, *np.full(N_INPUTS, 1.0), -1.5])
        optimum = minimize(
            lambda theta: neg_log_marginal_likelihood(x, y, theta),
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=THETA_BOUNDS,
        )
        return cls(x, y, *scales, optimum.x)

    def predict(self, record: Record) -> RoughnessEstimate:
        """What a `record` tells of its road. Raises RecordError."""
        at = self.x_scale(features(record)[None])
        mean, std = predict_gp(self.x, self.y, self.theta, at)
        log_level = float(self.y_scale.mean[0] + self.y_scale.std[0] * mean[0])
        log_std = float(self.y_scale.std[0] * std[0])
        return RoughnessEstimate(
            float(np.exp(log_level)), log_std, class_probabilities(log_level, log_std)
        )


def features(record: Record) -> np.ndarray:
    """Logarithms (INPUTS,) of the speed and of the RMS of front, rear and roll on the road."""
    record, _ = clean_record(record)
    on_road = (record.s >= 0.0) & (record.s <= record.length)
    on_road = on_road if on_road.any() else np.ones(record.s.size, dtype=bool)
    a = body_motions(record, causal=False)[:N_MOTIONS, on_road]
    rms = np.sqrt(np.mean(a**2, axis=1))
    return np.log(np.maximum([np.median(record.v[on_road]), *rms], 1e-6))


def roughness_level(truth: Profile, v: float) -> float:
    """G_d(n0) [m³] of a road: the geometric mean over the octaves judged at `v` [m/s], both paths
    together.
    """
    centres = scored_octaves(v)
    _, levels = octave_levels(*displacement_psd(truth.z, truth.ds), (centres[0], centres[-1]))
    return float(np.exp(np.mean(np.log(np.maximum(levels.mean(axis=0), 1e-12)))))


def covariance(
    x: np.ndarray, other: np.ndarray, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Covariances (N, M) of the line and of the process between inputs (N, k) and (M, k)."""
    scaled_difference = (x[:, None] - other[None]) * np.exp(-theta[1:-1])
    line = SLOPE_STD**2 * (1.0 + x @ other.T)
    return line, np.exp(2.0 * theta[0] - 0.5 * np.sum(scaled_difference**2, axis=2))


def neg_log_marginal_likelihood(
    x: np.ndarray, y: np.ndarray, theta: np.ndarray
) -> tuple[float, np.ndarray]:
    """Negative logarithm of the marginal likelihood of `y` (N,) at `x` (N, k), and its slope."""
    line, process = covariance(x, x, theta)
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


def predict_gp(
    x: np.ndarray, y: np.ndarray, theta: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (M,), noise included, of outputs at inputs `at` (M, k), given
    `y` (N,) at `x` (N, k).
    """
    noise = np.exp(2.0 * theta[-1])
    K = np.add(*covariance(x, x, theta)) + noise * np.eye(y.size)
    across, own = np.add(*covariance(at, x, theta)), np.add(*covariance(at, at, theta))
    solved = cho_solve(cho_factor(K, lower=True), np.column_stack([y, across.T]))
    variance = np.diag(own) + noise - np.einsum("mn,nm->m", across, solved[:, 1:])
    return across @ solved[:, 0], np.sqrt(variance)
