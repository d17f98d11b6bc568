"""Posterior of the road under identified responses, by banded Cholesky factors.

Unknown are the coefficients of both wheel paths at the nodes of a cubic spline, left and right in
turn. The prior is a random walk over distance for each path, that is a waviness of 2, with a weak
pull towards level ground. It also pulls the paths together: on an isotropic surface they differ
only by waves that are short against their distance. The level of the prior and a factor on all
noise are those of the largest marginal likelihood.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import signal, sparse
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.optimize import minimize_scalar

from estimators.common.spline import height_weights
from estimators.linear.impulse_responses import OVERSAMPLING, Responses, acceleration_filter

_CHUNK = 64  # samples whose rows are formed at a time
# Length [m] over which a random walk is pulled towards level ground: about 1 / (2 pi n), with n
# 0.01 cycles/m
_LEVEL_LENGTH = 16.0
# Length [m] over which the difference of the paths is pulled towards zero: about 1 / (2 pi n),
# with the n of 0.13 cycles/m at which the coherence of paths 1.5 m apart is one half
_PATH_LENGTH = 1.2
# First guess of the logarithms of the variance of the rise over a metre [m²], and of the factor
# on the noise
START = np.array([np.log(1e-5), 0.0])
# Largest change of the logarithm of the ratio of noise to rise in the search for the settings
_SEARCHED = 8.0


class Nodes(NamedTuple):
    """`size` nodes `ds` [m] apart, the first at the station `start` [m]."""

    start: float
    ds: float
    size: int

    def heights(self, s: np.ndarray) -> sparse.csr_array:
        """Return the matrix (M, size) from coefficients to heights at the stations `s` (M,)."""
        # node i below each station; weights of nodes beyond the ends are taken by the last node
        x = np.clip((s - self.start) / self.ds, 0.0, self.size - 1.0)
        i = np.minimum(x.astype(int), self.size - 2)
        weights = np.array(height_weights.py_func(x - i))  # type: ignore[attr-defined]
        columns = np.clip(i + np.arange(-1, 3)[:, None], 0, self.size - 1)
        rows = np.tile(np.arange(s.size), (4, 1))
        indices = (rows.ravel(), columns.ravel())
        return sparse.csr_array((weights.ravel(), indices), shape=(s.size, self.size))

    def accelerations(self, fine: np.ndarray) -> sparse.csr_array:
        """Return the matrix (N, size) [1/s²] from coefficients to accelerations of the road at the
        stations `fine` that an axle has at the instants of `fine_stations`.
        """
        # row k of F has the filter's weights over the fine instants around sample k
        weights = acceleration_filter()
        N = (fine.size - weights.size) // OVERSAMPLING + 1
        columns = OVERSAMPLING * np.arange(N)[:, None] + np.arange(weights.size)
        rows = np.repeat(np.arange(N), weights.size)
        data = np.tile(weights, N)  # the filter is symmetric
        F = sparse.csr_array((data, (rows, columns.ravel())), shape=(N, fine.size))
        return (F @ self.heights(fine)).tocsr()

    def prior_bands(self) -> np.ndarray:
        """Return the lower bands (3, 2 size) of the prior's precision [1/m²] for a rise over a
        metre of variance 1 m².
        """
        # order of the coefficients: left and right of the first node, then of the next. Squared
        # rises from node to node give 2 on the diagonal (1 at both ends) and -1 at the same side of
        # the next node, two places on; squared differences of the paths couple left to right, one
        # place on
        level, path = (self.ds / _LEVEL_LENGTH) ** 2, 0.5 * (self.ds / _PATH_LENGTH) ** 2
        bands = np.zeros((3, 2 * self.size))
        bands[0] = 2.0 + level + path
        bands[0, [0, 1, -2, -1]] -= 1.0
        bands[1, ::2] = -path
        bands[2, :-2] = -1.0
        return bands / self.ds


class _LinearPosterior(NamedTuple):
    """Posterior `mean` (p,) [m], the banded Cholesky `factor` of its precision, and the logarithm
    of the marginal likelihood up to a constant.
    """

    mean: np.ndarray
    factor: np.ndarray
    log_likelihood: float

    def draw(self, number: int, rng: np.random.Generator) -> np.ndarray:
        """Return `number` deviations (p, number) [m] from the mean."""
        white = rng.standard_normal((self.factor.shape[1], number))
        return dtbtrs(self.factor, white, uplo="L", trans="T")[0]


class NormalEquations(NamedTuple):
    """Lower `bands` (width, p) of H' R^-1 H, H' R^-1 a (p,), a' R^-1 a, and the readings `n`."""

    bands: np.ndarray
    rhs: np.ndarray
    square: float
    n: int

    @classmethod
    def of(
        cls, responses: Responses, a: np.ndarray, roads: Sequence[sparse.csr_array]
    ) -> "NormalEquations":
        """Return the equations of sensors `a` (k, N) [m/s²]; `roads`: for each axle, the
        accelerations of the road from its nodes (`Nodes.accelerations`).
        """
        # `mix` makes the innovations of the sensors independent and of variance 1, `white` makes
        # those of each independent over time: both act on readings and taps, which the filter makes
        # longer
        size, white = roads[0].shape[1], np.append(1.0, -responses.ar)
        mix = np.linalg.inv(np.linalg.cholesky(responses.innovation))
        taps = np.pad(responses.taps, ((0, 0), (0, 0), (0, 0), (0, white.size - 1)))
        taps = np.einsum("ij,jxpt->xpti", mix, signal.lfilter(white, 1.0, taps, axis=3))
        y = mix @ signal.lfilter(white, 1.0, a)
        n_taps, k = taps.shape[2:]
        N = a.shape[1]
        # a chunk of samples involves the nodes low to high alone: its H'H fills the bands of these
        # nodes, and a full H is never needed. Left and right coefficient of a node stand side by
        # side
        chunks = [(first, min(first + _CHUNK, N)) for first in range(0, N, _CHUNK)]
        spans = [_columns(roads, max(first - n_taps + 1, 0), last) for first, last in chunks]
        bands = np.zeros((2 * max(high - low for low, high in spans), 2 * size))
        rhs = np.zeros(2 * size)
        for (first, last), (low, high) in zip(chunks, spans, strict=True):
            H = np.zeros((last - first, high - low, 2, k))
            for road, axle_taps in zip(roads, taps, strict=True):
                # the accelerations of the road at the n_taps samples up to each one, the newest
                # first, times the taps; before the record there are none
                past = road[max(first - n_taps + 1, 0) : last, low:high].toarray()
                past = np.pad(past, ((max(n_taps - 1 - first, 0), 0), (0, 0)))
                windows = np.lib.stride_tricks.sliding_window_view(past, n_taps, axis=0)[:, :, ::-1]
                H += np.tensordot(windows, axle_taps, axes=(2, 1))
            H = H.transpose(0, 3, 1, 2).reshape(-1, 2 * (high - low))
            gram = H.T @ H
            for d in range(len(gram)):
                bands[d, 2 * low : 2 * high - d] += np.diagonal(gram, -d)
            rhs[2 * low : 2 * high] += H.T @ y[:, first:last].T.ravel()
        # a chunk spans more nodes than each of its samples
        used = np.flatnonzero(bands.any(axis=1))
        bands = np.asfortranarray(bands[: used[-1] + 1])  # as LAPACK reads them
        return cls(bands, rhs, float(np.sum(y**2)), y.size)

    def solve(self, prior: np.ndarray, settings: np.ndarray) -> _LinearPosterior:
        """Return the posterior; `settings`: logarithms of the variance of the rise over a metre
        [m²], and of the factor on the noise.
        """
        weight, precision = np.exp(-settings[1]), np.exp(-settings[0])
        bands = weight * self.bands
        bands[: len(prior)] += precision * prior
        factor = cholesky_banded(bands, overwrite_ab=True, lower=True, check_finite=False)
        mean = cho_solve_banded((factor, True), weight * self.rhs, check_finite=False)
        misfit = weight * (self.square - self.rhs @ mean)
        log_det = np.log(factor[0]).sum() + 0.5 * factor.shape[1] * settings[0]
        log_likelihood = -0.5 * (misfit + self.n * settings[1]) - log_det
        return _LinearPosterior(mean, factor, float(log_likelihood))

    def fit_settings(self, prior: np.ndarray, start: np.ndarray = START) -> np.ndarray:
        """Return the settings of `solve` of the largest marginal likelihood.

        The mean depends on the ratio of both factors only, and for each ratio the best factor on
        the noise is known: the misfit per reading. So the search has one dimension.
        """

        def settings_of(log_ratio: float) -> tuple[float, np.ndarray]:
            found = self.solve(prior, np.array([-log_ratio, 0.0]))
            misfit = self.square - self.rhs @ found.mean
            noise = np.log(misfit / self.n)
            loss = 0.5 * (self.n * (1.0 + noise) - misfit) - found.log_likelihood
            return float(loss), np.array([noise - log_ratio, noise])

        first = start[1] - start[0]
        bounds, options = (first - _SEARCHED, first + _SEARCHED), {"xatol": 0.1}
        found = minimize_scalar(lambda x: settings_of(x)[0], bounds=bounds, options=options)
        return settings_of(found.x)[1]


def _columns(roads: Sequence[sparse.csr_array], first: int, last: int) -> tuple[int, int]:
    """Return the range of the nodes that the rows `first` to `last` involve."""
    used = np.concatenate([road.indices[road.indptr[first] : road.indptr[last]] for road in roads])
    return int(used.min()), int(used.max()) + 1
