"""Vehicle parameters by marginal likelihood over a road that nobody measured: it is integrated out.

With the parameters p in units of their tolerances (`road_envs.vehicle.tolerances`) and the most
probable road x(p) of a drive, Laplace's approximation is

    -log p(y, p) = cost(x(p), p) + 1/2 log det A(x(p), p) + 1/2 |p|²

The log-determinant is needed: the road's prior alone rewards vehicles that need less road. (MacKay
2003, "Information Theory", chapter 27.) With the tangent J of the nonlinear vehicle at x,

    A = I + J' R^-1 J,     A F = J' R^-1 G,     A dx = J' R^-1 r - x

With the parameters p the road changes to x + dx - F dp, so that

    information      (G - J F)' R^-1 (G - J F) + F' F
    gradient         G' R^-1 (r - J dx) - 1/2 d log det A / dp
    1/2 d log det A / dp = tr A^-1 J' R^-1 dJ/dp = E (dJ/dp w)' R^-1 J w,     w ~ N(0, A^-1)

With the parameters the road moves, and with it the share of it that friction hides: dJ/dp is the
whole derivative. With q = E ((dJ/dx) w)' R^-1 J w, that of the log-determinant by the road,

    E (dJ/dp w)' R^-1 J w = E ((dG/dx) w)' R^-1 J w - F' q,     F' q = G' R^-1 J A^-1 q

Without the last term the stiffness of tyres over the mass of the body is 28 % too high on a class B
road. With it the gradient at the true vehicle is as large as the information says: chi squared 0.9
to 1.4 for each of 20 parameters of cars with independent wheels, 14 to 21 without (seeds 3100, 7700
and 7750). Of the Land Rover, whose friction hides more of the road than the linearization at its
most probable course says, it is 1 to 3 on class C and 4 to 7 on class B at 54 km/h, and 6 to 17 at
a walking pace in ride (seeds 5231 to 5234).

The systems are solved by conjugate gradients, the trace is a mean over samples w of the road's
posterior (Hutchinson 1990, doi:10.1080/03610919008812866), and derivatives along w are half the
differences between the roads x + w and x - w.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.fft import irfft

from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.marginal_likelihood import (
    LikelihoodTerms,
    perturbed_passes,
    sensitivities,
)
from estimators.map_smoother.objective import Linearization
from estimators.map_smoother.one_pass import Pass
from estimators.map_smoother.tuning import TUNING
from road_envs.vehicle.parameters import VehicleParameters


def tangent_terms(
    solution: MapSolution, cars: Sequence[VehicleParameters], known: LikelihoodTerms | None = None
) -> LikelihoodTerms:
    """Return the terms of a drive over an unmeasured road; `cars` as of `perturbed_cars`.

    If those of a vehicle nearby are `known`, only gradient and optimum are computed. Raises
    ArithmeticError if a motion is not finite.
    """
    lin, solve = solution.linearization, solution.inverse_hessian(*TUNING.tangent_cg)
    (one,) = lin.passes
    varied = perturbed_passes(one.source, cars)
    G = sensitivities(one, varied)
    known = known or _second_order_terms(solution, varied, G)
    to_optimum = solve(-lin.gradient())
    left = one.apply_inverse_covariance(one.residual - lin.tangent(to_optimum)[0])
    fit = np.einsum("psj,sj->p", G, left)
    return known._replace(gradient=fit - known.log_det_gradient, to_optimum=to_optimum)


def _second_order_terms(
    solution: MapSolution, varied: Sequence[Pass], G: np.ndarray
) -> LikelihoodTerms:
    """Return the terms without gradient and optimum, of the derivatives `G` (P, S, J)."""
    lin, solve = solution.linearization, solution.inverse_hessian(*TUNING.trace_cg)
    (one,), quick = lin.passes, solution.inverse_hessian(*TUNING.quick_cg)
    weighted = np.array([one.apply_inverse_covariance(g) for g in G])
    F = np.array([quick(lin.adjoint([g])) for g in weighted])
    left = G - np.array([lin.tangent(f)[0] for f in F])
    samples = [_trace_sample(lin, varied, solve(b)) for b in _posterior_noise(lin)]
    at_road, along = (np.array(part) for part in zip(*samples, strict=True))
    # A is symmetric: one system for the derivative along the road, not one for each parameter
    moved = lin.tangent(solve(along.mean(axis=0)))[0]
    log_det_gradient = at_road.mean(axis=0) - np.einsum("psj,sj->p", weighted, moved)
    weighted = np.array([one.apply_inverse_covariance(g) for g in left])
    information = np.einsum("psj,qsj->pq", left, weighted) + F @ F.T
    score = information + np.cov(at_road.T - F @ along.T) / len(samples)
    return LikelihoodTerms(-log_det_gradient, information, score, log_det_gradient, by_parameter=-F)


def _trace_sample(
    lin: Linearization, varied: Sequence[Pass], w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sample by `w` (n,) of the derivatives of 1/2 log det A: by the parameters (P,) at
    a fixed road, and by the unknowns (n,); `varied` as of `perturbed_passes`.
    """
    (one,) = lin.passes
    dual = one.apply_inverse_covariance(lin.tangent(w)[0])
    above, below = lin.relinearize(lin.x + w), lin.relinearize(lin.x - w)
    changes = [sensitivities(there.passes[0], varied) for there in (above, below)]
    at_road = np.einsum("psj,sj->p", 0.5 * (changes[0] - changes[1]), dual)
    return at_road, 0.5 * (above.adjoint([dual]) - below.adjoint([dual]))


def _posterior_noise(lin: Linearization) -> Iterator[np.ndarray]:
    """Yield samples J' R^-1/2 e_1 + e_2 (n,), of covariance A; A^-1 times one is a sample w. The
    rows of e_1 (S, J) and e_2 (2, K) are white, with flat spectra of random phases that are turned
    against each other from sample to sample. Of a stationary vehicle, few samples would then give
    the mean of a quadratic form without error.
    """
    rng = np.random.default_rng(0)
    (one,), u = lin.passes, lin.objective.split(lin.x)[0]
    shapes = one.residual.shape, u.shape
    phases = [rng.uniform(0.0, 2.0 * np.pi, (rows, size // 2 + 1)) for rows, size in shapes]
    rows = np.arange(sum(rows for rows, _ in shapes))
    turns = np.split(2.0 * np.pi / TUNING.trace_draws * rows, [len(one.residual)])
    for k in range(TUNING.trace_draws):
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
