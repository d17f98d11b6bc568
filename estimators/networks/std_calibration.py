"""How wide the standard deviations of a network have to be: a factor that follows speed and states.

A network learns its errors together with its heights: on cars that differ from the described one,
over all waves that it reads. On the very car, in the judged band, it errs less, by a share that
depends on how much the car's numbers matter to it, hence on states, speed and roughness. So what it
says is multiplied by

    exp(w . x)     x: (1, u, l, u l) times each of 1, the four states, their six products; u², l²

with u the speed, l the level and the states -1 or 1 as the network is told (`sequence.py`). w is
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

COVERED = ((0.5, 0.6745), (0.9, 1.6449))
"""Shares of errors, and the standard deviations within which they lie if they are Gaussian."""

TERMS = 46
RIDGE = 0.1
"""Weight of w = 0 in drives, for a unit of each term."""

QUANTILES, TINY, SOFT = 50, 1e-9, 0.1
"""By which the errors of a drive are told, the least of them that counts, and the width of the
logarithm over which being inside turns into being outside."""

PAD, CUT = 20.0, 5.0
"""Length [m] by which a drive is continued before it is filtered; ends [m] that count for
nothing."""


def constant(factor: float) -> np.ndarray:
    """The coefficients (TERMS,) of one factor for all speeds and states."""
    return np.log(factor) * np.eye(TERMS)[0]


def widths(coefficients: np.ndarray, conditions: np.ndarray) -> np.ndarray:
    """Factors (M,) on the standard deviations under `conditions` (8, M) of a network."""
    return np.exp(coefficients @ terms(conditions))


def terms(conditions: np.ndarray) -> np.ndarray:
    """What the logarithm of the factor is linear in (TERMS, M)."""
    u, states, level = conditions[0], conditions[2:6], conditions[6]
    pairs = [states[i] * states[j] for i, j in combinations(range(4), 2)]
    each = np.array([np.ones_like(u), *states, *pairs])
    return np.concatenate([each, u * each, level * each, u * level * each, [u**2, level**2]])


def fitted_widths(ratios: Sequence[np.ndarray], conditions: Sequence[np.ndarray]) -> np.ndarray:
    """Coefficients (TERMS,) with which errors over standard deviations, (2, M) for each drive, are
    as far out as those of a Gaussian; `conditions` (8, M or 1) likewise.
    """
    x = np.array([terms(told).mean(axis=1) for told in conditions])
    levels = (np.arange(QUANTILES) + 0.5) / QUANTILES
    far_out = np.log([np.maximum(np.quantile(np.abs(each), levels), TINY) for each in ratios])
    over = np.array([far_out - np.log(far) for _, far in COVERED])  # (2, drives, quantiles)
    share = np.array([inside for inside, _ in COVERED])[:, None, None]
    ridge = RIDGE * np.append(0.0, np.ones(TERMS - 1)) / len(x)

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        """Mean of both check functions, rounded at SOFT, and its slope."""
        left = over - (x @ w)[:, None]
        value = share * left + SOFT * np.logaddexp(0.0, -left / SOFT)
        slope = expit(-left / SOFT) - share
        total = value.mean() + 0.5 * ridge @ w**2
        return float(total), x.T @ slope.mean(axis=(0, 2)) / len(x) + ridge * w

    return minimize(loss, constant(1.0), jac=True, method="BFGS").x


def honest(ratios: np.ndarray) -> float:
    """The factor on standard deviations with which half and nine tenths of the errors are about
    as far out as those of a Gaussian; `ratios` (any shape) are errors over standard deviations.
    """
    return float(np.mean([np.quantile(np.abs(ratios), p) / far for p, far in COVERED]))


def judged(x: np.ndarray, v: float) -> np.ndarray:
    """The part of rows (k, M) at the stations that lies in the judged band at `v` [m/s]."""
    pad = min(round(PAD / SPACING), x.shape[1] - 1)
    low, high = scored_band(v)
    longer = np.pad(x, ((0, 0), (pad, pad)), mode="reflect", reflect_type="odd")
    size = longer.shape[1]
    n = rfftfreq(size, SPACING)
    lines = rfft(longer * signal.windows.tukey(size, 2.0 * pad / size), axis=1)
    return irfft(lines * ((n >= low) & (n <= high)), size, axis=1)[:, pad : pad + x.shape[1]]


def inside(size: int) -> slice:
    """Those of a drive's stations that count."""
    cut = min(round(CUT / SPACING), size // 10)
    return slice(cut, size - cut)
