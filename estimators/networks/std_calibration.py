"""How wide the standard deviations of a network have to be: a factor that follows speed and states.

A network learns its errors together with its heights: on cars that differ from the described one,
over all waves that it reads. On the very car, in the judged band, it errs less, by a share that
depends on how much the car's numbers matter to it, hence on states, speed and roughness. So what it
says is multiplied by

    exp(w . x)     x: (1, u, l, u l) times each of 1, the four states, their six products; u², l²

with u the speed, l the level and the states -1 or 1 as the network is drive_conditions (`sequence.py`). w is
fitted to drives by the car as described over roads that were not taught: quantile regression
(Koenker & Bassett, Econometrica 46, 1978) of the logarithm of |error| / standard deviation, for the
median and the ninth decile at once, so that about half and nine tenths of the errors lie where
those of a Gaussian would, at every speed and in every state.

Where wheels leave the ground errors are not Gaussian, however wide: on such drives too few lie
inside, and where many of the roads have obstacles, at speed, fewer than claimed do on average.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy import signal
from scipy.fft import irfft, rfft, rfftfreq
from scipy.optimize import minimize
from scipy.special import expit

from estimators.common.spatial_signals import SPACING
from road_envs.data.record import scored_band

COVERAGE_LEVELS = ((0.5, 0.6745), (0.9, 1.6449))
"""Shares of errors, and the standard deviations within which they lie if they are Gaussian."""

N_TERMS = 46
RIDGE = 0.1
"""Weight of w = 0 in drives, for a unit of each term."""

N_QUANTILES, RATIO_MIN, SMOOTHING = 50, 1e-9, 0.1
"""By which the errors of a drive are drive_conditions, the least of them that counts, and the width of the
logarithm over which being inside turns into being outside."""

PAD_LENGTH, EDGE_LENGTH = 20.0, 5.0
"""Length [m] by which a drive is continued before it is filtered; ends [m] that count for
nothing."""


def constant_scale(factor: float) -> np.ndarray:
    """The coefficients (N_TERMS,) of one factor for all speeds and states."""
    return np.log(factor) * np.eye(N_TERMS)[0]


def std_scale(coefficients: np.ndarray, conditions: np.ndarray) -> np.ndarray:
    """Factors (M,) on the standard deviations under `conditions` (8, M) of a network."""
    return np.exp(coefficients @ design_matrix(conditions))


def design_matrix(conditions: np.ndarray) -> np.ndarray:
    """What the logarithm of the factor is linear in (N_TERMS, M)."""
    u, states, level = conditions[0], conditions[2:6], conditions[6]
    pairs = [states[i] * states[j] for i, j in combinations(range(4), 2)]
    each = np.array([np.ones_like(u), *states, *pairs])
    return np.concatenate([each, u * each, level * each, u * level * each, [u**2, level**2]])


def fit_std_scale(ratios: Sequence[np.ndarray], conditions: Sequence[np.ndarray]) -> np.ndarray:
    """Coefficients (N_TERMS,) with which errors over standard deviations, (2, M) for each drive, are
    as n_std out as those of a Gaussian; `conditions` (8, M or 1) likewise.
    """
    x = np.array([design_matrix(drive_conditions).mean(axis=1) for drive_conditions in conditions])
    levels = (np.arange(N_QUANTILES) + 0.5) / N_QUANTILES
    log_ratios = np.log(
        [np.maximum(np.quantile(np.abs(each), levels), RATIO_MIN) for each in ratios]
    )
    over = np.array(
        [log_ratios - np.log(n_std) for _, n_std in COVERAGE_LEVELS]
    )  # (2, drives, quantiles)
    share = np.array([covered for covered, _ in COVERAGE_LEVELS])[:, None, None]
    ridge = RIDGE * np.append(0.0, np.ones(N_TERMS - 1)) / len(x)

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        """Mean of both check functions, rounded at SMOOTHING, and its slope."""
        excess = over - (x @ w)[:, None]
        value = share * excess + SMOOTHING * np.logaddexp(0.0, -excess / SMOOTHING)
        slope = expit(-excess / SMOOTHING) - share
        total = value.mean() + 0.5 * ridge @ w**2
        return float(total), x.T @ slope.mean(axis=(0, 2)) / len(x) + ridge * w

    return minimize(loss, constant_scale(1.0), jac=True, method="BFGS").x


def calibration_factor(ratios: np.ndarray) -> float:
    """The factor on standard deviations with which half and nine tenths of the errors are about
    as n_std out as those of a Gaussian; `ratios` (any shape) are errors over standard deviations.
    """
    return float(np.mean([np.quantile(np.abs(ratios), p) / n_std for p, n_std in COVERAGE_LEVELS]))


def in_scored_band(x: np.ndarray, v: float) -> np.ndarray:
    """The part of rows (k, M) at the stations that lies in the judged band at `v` [m/s]."""
    pad = min(round(PAD_LENGTH / SPACING), x.shape[1] - 1)
    low, high = scored_band(v)
    padded = np.pad(x, ((0, 0), (pad, pad)), mode="reflect", reflect_type="odd")
    size = padded.shape[1]
    n = rfftfreq(size, SPACING)
    lines = rfft(padded * signal.windows.tukey(size, 2.0 * pad / size), axis=1)
    return irfft(lines * ((n >= low) & (n <= high)), size, axis=1)[:, pad : pad + x.shape[1]]


def interior(size: int) -> slice:
    """Those of a drive's stations that count."""
    cut = min(round(EDGE_LENGTH / SPACING), size // 10)
    return slice(cut, size - cut)
