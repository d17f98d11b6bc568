"""Derivatives of the marginal likelihood through the tangent of the nonlinear vehicle.

`marginal_likelihood` takes log-determinant and information from the stationary linear vehicle. That
is quick, and leads near the optimum; but friction hides part of the road, so that its information
is up to 25 times too high, and the axles' masses and inertias are biased. Here both are those of
the nonlinear vehicle, with its tangent J at the most probable road x:

    A = I + J' R^-1 J,     A F = J' R^-1 G,     A dx = J' R^-1 r - x

With the parameters p the road changes to x + dx - F dp, so that

    information      (G - J F)' R^-1 (G - J F) + F' F
    gradient         G' R^-1 (r - J dx) - 1/2 d log det A / dp
    1/2 d log det A / dp = tr A^-1 J' R^-1 dJ/dp = E (dJ/dp w)' R^-1 J w,     w ~ N(0, A^-1)

The systems are solved by conjugate gradients, the trace is a mean over samples w of the road's
posterior (Hutchinson 1990, doi:10.1080/03610919008812866), and dJ/dp w is half the difference of G
on the roads x + w and x - w.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft

from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.marginal_likelihood import perturbed_passes, sensitivities
from estimators.map_smoother.objective import Linearization
from estimators.map_smoother.one_pass import LinearizedPass, Pass
from road_envs.vehicle.parameters import VehicleParameters

DRAWS = 8
"""Samples of the road's posterior for the trace."""

CG_ITERATIONS, CG_TOLERANCE = 150, 0.01
"""Conjugate gradients of each system."""


class TangentTerms(NamedTuple):
    """Terms of one drive's marginal likelihood: `gradient` (P,) with the covariance
    `sampling_covariance` (P, P) of its error by sampling, and `information` (P, P); and the change
    of the solution's unknowns `to_optimum` (n,), and `by_parameter` (P, n).
    """

    gradient: np.ndarray
    sampling_covariance: np.ndarray
    information: np.ndarray
    to_optimum: np.ndarray
    by_parameter: np.ndarray


def tangent_terms(solution: MapSolution, cars: Sequence[VehicleParameters]) -> TangentTerms:
    """Return the terms of a drive over an unmeasured road; `cars` as of `perturbed_cars`.

    Raises ArithmeticError if a motion is not finite.
    """
    lin, solve = solution.linearization, solution.inverse_hessian(CG_ITERATIONS, CG_TOLERANCE)
    (one,) = lin.passes
    varied = perturbed_passes(one.source, cars)
    G = sensitivities(one, varied)
    weighted = np.array([one.apply_inverse_covariance(g) for g in G])
    F = np.array([solve(lin.adjoint([g])) for g in weighted])
    left = G - np.array([lin.tangent(f)[0] for f in F])
    to_optimum = solve(-lin.gradient())
    fit = np.einsum("psj,sj->p", weighted, one.residual - lin.tangent(to_optimum)[0])
    traces = np.array([trace_sample(lin, varied, solve(b)) for b in posterior_noise(lin)])
    weighted = np.array([one.apply_inverse_covariance(g) for g in left])
    return TangentTerms(
        gradient=fit - traces.mean(axis=0),
        sampling_covariance=np.cov(traces.T) / len(traces),
        information=np.einsum("psj,qsj->pq", left, weighted) + F @ F.T,
        to_optimum=to_optimum,
        by_parameter=-F,
    )


def trace_sample(lin: Linearization, varied: Sequence[Pass], w: np.ndarray) -> np.ndarray:
    """Return (dJ/dp w)' R^-1 J w (P,) of a sample `w` (n,); `varied` as of `perturbed_passes`."""
    (one,) = lin.passes

    def moved(dx: np.ndarray) -> LinearizedPass:
        u, (own,), _ = lin.objective.split(lin.x + dx)
        return replace(one, c=lin.objective.road.coefficients(u), own=own)

    above, below = (sensitivities(moved(dx), varied) for dx in (w, -w))
    dual = one.apply_inverse_covariance(lin.tangent(w)[0])
    return np.einsum("psj,sj->p", 0.5 * (above - below), dual)


def posterior_noise(lin: Linearization) -> Iterator[np.ndarray]:
    """Yield DRAWS samples J' R^-1/2 e_1 + e_2 (n,), of covariance A; A^-1 times one is a sample w.

    The rows of e_1 (S, J) and e_2 (2, K) are white, with flat spectra of random phases that are
    turned against each other from sample to sample. Of a stationary vehicle, few samples would then
    give the mean of a quadratic form without error.
    """
    rng = np.random.default_rng(0)
    (one,), u = lin.passes, lin.objective.split(lin.x)[0]
    shapes = one.residual.shape, u.shape
    phases = [rng.uniform(0.0, 2.0 * np.pi, (rows, size // 2 + 1)) for rows, size in shapes]
    turns = np.split(
        2.0 * np.pi / DRAWS * np.arange(sum(rows for rows, _ in shapes)), [len(one.residual)]
    )
    for k in range(DRAWS):
        e_1, e_2 = (
            _flat_noise(phase + k * turn[:, None], size)
            for (_, size), phase, turn in zip(shapes, phases, turns, strict=True)
        )
        measured = lin.adjoint([one.shape_noise(e_1)])
        rest = rng.standard_normal(measured.size - u.size)
        yield measured + np.concatenate([e_2.ravel(), rest])


def _flat_noise(phases: np.ndarray, size: int) -> np.ndarray:
    """Return signals (rows, size) of unit variance with these phases (rows, size // 2 + 1)."""
    spectrum = np.sqrt(size) * np.exp(1j * phases)
    spectrum[:, 0] *= np.sqrt(2.0)  # of lines without a phase the real part is left
    if size % 2 == 0:
        spectrum[:, -1] *= np.sqrt(2.0)
    return irfft(spectrum, size, axis=1)
