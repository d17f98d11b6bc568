"""Stations from position fixes that wander, as those of a receiver.

The error of an odometer follows that of its fixes within the time l in which the vehicle covers
the distance of the fixes. With the error of the fixes a first-order Gauss-Markov process of the
standard deviation sigma and the correlation time T, that of the odometer has the covariance

    K(t) = sigma² T / (T² - l²) (T exp(-t / T) - l exp(-t / l))

(the process behind a first-order low-pass). Such an odometer stretches short distances by some
percent, which the integral x of the speed does not, but for a constant relative error:

    s - s_0 = offset + (1 + excess) x + error,      error of covariance K

Offset and excess follow by generalised least squares (Rasmussen & Williams, "Gaussian Processes for
Machine Learning", 2006, section 2.7), averaged over sigma and l by their marginal likelihood. T is
assumed: drives are too short to tell it.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve

_CORRELATION_TIME = 30.0  # [s] of a receiver's error
_WANDER = 0.1  # least standard deviation [m] of what wanders between speed and fixes
_MAX_WANDER = 10.0  # greatest one [m] that a receiver explains
SPEED_STD = 0.02  # standard deviation of the relative error of a speed signal, beforehand
_OFFSET_STD = 100.0  # [m] of the offset, beforehand: it is not known
_WHITE_STD = 0.03  # [m] of errors of single fixes that are not correlated
_SIGMAS, _LATENCIES = np.geomspace(0.2, 12.0, 14), np.geomspace(0.1, 5.0, 8)  # [m], l [s]
# Medians of both beforehand, and the standard deviation of their logarithms
_SIGMA, _LATENCY, _LOG_STD = 2.0, 0.7, 0.7
_BLOCK, _MAX_BLOCKS = 0.25, 150  # time [s] over which positions are averaged; most of them


def _block_means(t: np.ndarray, *signals: np.ndarray) -> np.ndarray:
    """Return the means (1 + k, B) of times (N,) [s] and k signals (N,) over about _BLOCK each."""
    count = int(np.clip((t[-1] - t[0]) / _BLOCK, 1, _MAX_BLOCKS))
    edges = np.linspace(0, t.size, min(count, t.size) + 1).astype(int)
    sums = np.add.reduceat(np.stack([t, *signals]), edges[:-1], axis=1)
    return np.asarray(sums / np.diff(edges))


def wanders(t: np.ndarray, left: np.ndarray) -> bool:
    """Return whether the differences `left` (N,) [m] of speed and fixes are errors of a receiver.

    They are too small or too large, constant, or change from sample to sample, where they are not.
    """
    return _WANDER < float(_block_means(t, left)[1].std()) < _MAX_WANDER


def fit_wander(
    t: np.ndarray, travelled: np.ndarray, s: np.ndarray
) -> tuple[float, float, float, float]:
    """Fit stations `s` (N,) [m], less the first, to the integral of the speed `travelled` (N,).

    Return offset [m] and relative excess of the true distance over that of the speed signal, with
    its standard deviation, and that of the stations [m], root mean square along the drive.
    """
    times, x, y = _block_means(t, travelled, s - travelled)
    basis = np.stack([np.ones_like(x), x], axis=1)
    prior = np.diag([_OFFSET_STD**-2, SPEED_STD**-2])
    lags, T = np.abs(times[:, None] - times), _CORRELATION_TIME
    logs, means, covariances = list[float](), list[np.ndarray](), list[np.ndarray]()
    for latency in _LATENCIES:
        decays = T * np.exp(-lags / T) - latency * np.exp(-lags / latency)
        correlation = T / (T**2 - latency**2) * decays
        for sigma in _SIGMAS:
            factor = cho_factor(sigma**2 * correlation + _WHITE_STD**2 * np.eye(x.size))
            weighted = cho_solve(factor, np.column_stack([basis, y]))
            precision = basis.T @ weighted[:, :2] + prior
            mean = np.linalg.solve(precision, basis.T @ weighted[:, 2])
            misfit = y @ weighted[:, 2] - mean @ precision @ mean
            log_determinant = 2.0 * np.log(np.diag(factor[0])).sum()
            rarity = np.log([sigma / _SIGMA, latency / _LATENCY]) / _LOG_STD
            misfit += rarity @ rarity + log_determinant + np.linalg.slogdet(precision).logabsdet
            logs.append(-0.5 * float(misfit))
            means.append(mean)
            covariances.append(np.linalg.inv(precision) + np.outer(mean, mean))
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    found = weights @ np.array(means)
    covariance = np.tensordot(weights, np.array(covariances), 1) - np.outer(found, found)
    variance = np.einsum("ni,ij,nj->n", basis, covariance, basis)
    excess_std, station_std = np.sqrt([covariance[1, 1], variance.mean()])
    return float(found[0]), float(found[1]), float(excess_std), float(station_std)
