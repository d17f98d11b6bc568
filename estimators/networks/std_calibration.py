"""Calibration of a network's standard deviations by a factor depending on speed, states and level.

A network is trained on vehicles that deviate from the nominal one, over all wavelengths that it
reads. On the nominal vehicle, within the scored band, its errors are smaller, by a factor that
depends on strut states, speed and roughness. Its standard deviations are therefore multiplied by

    exp(w . x)     x: (1, u, l, u l) times each of 1, the four states, their six products; u², l²

with u the speed, l the level and the states -1 or 1, all as in the network's conditions
(`inputs.py`). w is fitted to drives of the nominal vehicle over roads not used for training, by
quantile regression (Koenker & Bassett, Econometrica 46, 1978) of log(|error| / standard deviation)
for the median and the ninth decile jointly. Thus about half and nine tenths of the errors lie
within the Gaussian bounds, at every speed and in every state.

Limitations: where wheels leave the ground the errors are not Gaussian for any scale; on such
drives, and on average over boards with many obstacles at speed, the coverage is too low.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy import signal
from scipy.fft import irfft, rfft, rfftfreq
from scipy.optimize import minimize
from scipy.special import expit

from estimators.common.coverage import COVERAGE
from estimators.common.spatial_signals import SPACING
from road_envs.records.record import scored_band

N_TERMS = 46
_RIDGE = 0.1  # penalty on w for a unit of each term, in equivalent drives
_N_QUANTILES = 50  # quantiles that represent the errors of a drive
_RATIO_MIN = 1e-9  # smallest ratio of errors
_SMOOTHING = 0.1  # width, in the logarithm, over which the check function is smoothed
_PAD_LENGTH = 20.0  # length [m] by which a drive is extended before filtering


class StdScale(NamedTuple):
    """Factor on the standard deviations, of `coefficients` w (N_TERMS,)."""

    coefficients: np.ndarray

    @classmethod
    def constant(cls, factor: float) -> "StdScale":
        """Return the same `factor` under all conditions."""
        return cls(np.log(factor) * np.eye(N_TERMS)[0])

    @classmethod
    def fit(cls, ratios: Sequence[np.ndarray], conditions: Sequence[np.ndarray]) -> "StdScale":
        """Fit to `ratios`, errors over standard deviations (2, M) of each drive, and to its
        `conditions` (8, M or 1).
        """
        x = np.array([_design_matrix(each).mean(axis=1) for each in conditions])
        levels = (np.arange(_N_QUANTILES) + 0.5) / _N_QUANTILES
        quantiles = np.array([np.quantile(np.abs(each), levels) for each in ratios])
        log_ratios = np.log(np.maximum(quantiles, _RATIO_MIN))
        # (2, drives, quantiles)
        over = np.array([log_ratios - np.log(n_std) for _, n_std in COVERAGE])
        share = np.array([covered for covered, _ in COVERAGE])[:, None, None]
        ridge = _RIDGE * np.append(0.0, np.ones(N_TERMS - 1)) / len(x)

        def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
            """The mean of both check functions, smoothed, and its gradient."""
            excess = over - (x @ w)[:, None]
            value = share * excess + _SMOOTHING * np.logaddexp(0.0, -excess / _SMOOTHING)
            slope = expit(-excess / _SMOOTHING) - share
            total = value.mean() + 0.5 * ridge @ w**2
            return float(total), x.T @ slope.mean(axis=(0, 2)) / len(x) + ridge * w

        return cls(minimize(loss, np.zeros(N_TERMS), jac=True, method="BFGS").x)

    def __call__(self, conditions: np.ndarray) -> np.ndarray:
        """Return the factors (M,) under the `conditions` (8, M) of a network."""
        return np.exp(self.coefficients @ _design_matrix(conditions))


def _design_matrix(conditions: np.ndarray) -> np.ndarray:
    """Return the regressors (N_TERMS, M) of the logarithm of the factor."""
    u, states, level = conditions[0], conditions[2:6], conditions[6]
    pairs = [states[i] * states[j] for i, j in combinations(range(4), 2)]
    each = np.array([np.ones_like(u), *states, *pairs])
    return np.concatenate([each, u * each, level * each, u * level * each, [u**2, level**2]])


def in_scored_band(x: np.ndarray, v: float) -> np.ndarray:
    """Return the part of rows (k, M) at the stations in the scored band at `v` [m/s]."""
    pad = min(round(_PAD_LENGTH / SPACING), x.shape[1] - 1)
    low, high = scored_band(v)
    padded = np.pad(x, ((0, 0), (pad, pad)), mode="reflect", reflect_type="odd")
    size = padded.shape[1]
    n = rfftfreq(size, SPACING)
    lines = rfft(padded * signal.windows.tukey(size, 2.0 * pad / size), axis=1)
    return irfft(lines * ((n >= low) & (n <= high)), size, axis=1)[:, pad : pad + x.shape[1]]
