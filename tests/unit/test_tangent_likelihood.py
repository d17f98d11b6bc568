"""Derivatives of the marginal likelihood by the tangent, against dense matrices."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.fft import irfft, rfft
from scipy.linalg import circulant
from vehicle_fixtures import DEFENDER

from estimators.map_smoother import tangent_likelihood
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.gauss_newton import GaussNewton, MapSolution, minimize
from estimators.map_smoother.marginal_likelihood import (
    perturbed_cars,
    perturbed_passes,
    sensitivities,
)
from estimators.map_smoother.preparation import SolverSettings
from estimators.map_smoother.tangent_likelihood import (
    _posterior_noise,
    _trace_sample,
    tangent_terms,
)
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.windows import whole_objective
from road_envs.analysis.information_bound import RoadPrior
from road_envs.drives.recording import simulate_record
from road_envs.roads.iso8608 import Iso8608
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.tolerances import ParameterSpace, parameter_space

PAPER, FULL = load_instruments("paper"), parameter_space(DEFENDER)
SPACE = ParameterSpace(DEFENDER, FULL.names[:6], FULL.std[:6])
"""Masses and inertias of body and axles."""


@cache
def solution() -> MapSolution:
    surface = Iso8608(road_class="D", length=20.0).realise(np.random.default_rng(5))
    record, _ = simulate_record(surface, vehicle=DEFENDER, speed_kmh=54.0, mode="handling", seed=5)
    drive, _ = MapSmoother().prepare(record, DEFENDER)
    objective = whole_objective(drive, RoadPrior(), 200)
    return minimize(objective, GaussNewton(adapt_prior=False))


@pytest.fixture(scope="module")
def terms():
    """Terms whose systems are solved well."""
    with pytest.MonkeyPatch.context() as patch:
        well = dict.fromkeys(("tangent_cg", "quick_cg", "trace_cg"), (1000, 1e-4))
        patch.setattr(tangent_likelihood, "TUNING", replace(TUNING, **well))
        return tangent_terms(solution(), perturbed_cars(SPACE, np.zeros(SPACE.size)))


@cache
def dense_system():
    """The linearization with its varied vehicles; J (M, n), A (n, n), G (P, M) and G' R^-1."""
    lin, cars = solution().linearization, perturbed_cars(SPACE, np.zeros(SPACE.size))
    (one,) = lin.passes
    varied = perturbed_passes(one.source, cars)
    J = np.array([lin.tangent(row)[0] for row in np.eye(lin.x.size)])
    G = sensitivities(one, varied)
    RJ, RG = (np.array([one.apply_inverse_covariance(row) for row in rows]) for rows in (J, G))
    J, RJ, G, RG = (rows.reshape(len(rows), -1) for rows in (J, RJ, G, RG))
    return (lin, varied), J.T, np.eye(lin.x.size) + J @ RJ.T, G, RG


def test_what_the_road_cannot_explain_is_information(terms):
    _, J, A, G, RG = dense_system()
    road = np.linalg.solve(A, J.T @ RG.T)
    expected = RG @ G.T - RG @ J @ road
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        terms.information / np.outer(scale, scale), expected / np.outer(scale, scale), atol=5e-3
    )
    size = np.sqrt(np.einsum("np,nm,mp->p", road, A, road))
    error = terms.by_parameter.T + road
    assert (np.sqrt(np.einsum("np,nm,mp->p", error, A, error)) < 1e-2 * size).all()


def test_the_gradient_is_that_at_the_optimum_less_that_of_the_log_determinant(terms):
    (lin, varied), J, A, _, RG = dense_system()
    dx = np.linalg.solve(A, -lin.gradient())
    samples = [_trace_sample(lin, varied, np.linalg.solve(A, b)) for b in _posterior_noise(lin)]
    at_road, along = (np.mean(part, axis=0) for part in zip(*samples, strict=True))
    road = np.linalg.solve(A, J.T @ RG.T)  # moves by -road with the parameters
    expected = RG @ (lin.residual[0].ravel() - J @ dx) - (at_road - road.T @ along)
    scale = np.sqrt(np.diag(terms.information))
    np.testing.assert_allclose(terms.gradient / scale, expected / scale, atol=0.02)
    for part in (at_road, road.T @ along):
        assert (np.abs(part) > 0.1 * scale).any()


def test_with_known_terms_gradient_and_optimum_are_those_of_the_other_vehicle(terms):
    lin, cars = solution().linearization, perturbed_cars(SPACE, np.full(SPACE.size, 0.2))
    (one,) = lin.objective.passes
    objective = replace(lin.objective, passes=(one.with_car(cars[0]),))
    moved = replace(solution(), linearization=objective.linearize(lin.x))
    with pytest.MonkeyPatch.context() as patch:
        poorly = replace(TUNING, quick_cg=(3, 0.5), trace_cg=(3, 0.5))
        patch.setattr(tangent_likelihood, "TUNING", poorly)
        fresh, quick = tangent_terms(moved, cars), tangent_terms(moved, cars, terms)
    scale = np.sqrt(np.diag(terms.information))
    fit, expected = (one.gradient + one.log_det_gradient for one in (quick, fresh))
    np.testing.assert_allclose(fit / scale, expected / scale, atol=1e-9)
    np.testing.assert_array_equal(quick.to_optimum, fresh.to_optimum)
    assert (np.abs(fit - terms.gradient - terms.log_det_gradient) > 0.1 * scale).any()
    assert quick.information is terms.information


def test_a_sample_of_the_trace_is_the_change_of_the_tangent_by_a_parameter():
    lin = solution().linearization
    cars = perturbed_cars(SPACE, np.zeros(SPACE.size))
    small = 1e-3 * next(_posterior_noise(lin)) / np.sqrt(lin.x.size)
    (means,), (weight,) = lin.tangent(small), lin.inverse_variance
    varied = perturbed_passes(lin.objective.passes[0], cars)
    objectives = (replace(lin.objective, passes=(one,)) for one in varied)
    there = (one.linearize(lin.x).with_noise([weight]) for one in objectives)
    first, *rest = [np.vdot(one.tangent(small)[0], weight * means) for one in there]
    found, _ = _trace_sample(lin, varied, small)
    np.testing.assert_allclose(found, (np.array(rest) - first) / TUNING.difference, rtol=0.02)


def test_a_sample_of_the_trace_is_the_change_of_the_tangent_along_the_road():
    lin = solution().linearization
    small = 1e-3 * next(_posterior_noise(lin)) / np.sqrt(lin.x.size)
    (means,), (weight,) = lin.tangent(small), lin.inverse_variance
    _, along = _trace_sample(lin, [lin.objective.passes[0]] * 2, small)
    for direction in np.random.default_rng(3).standard_normal((3, lin.x.size)):
        dx = 1e-4 * direction / np.sqrt(lin.x.size)
        above, below = (lin.relinearize(lin.x + sign * dx) for sign in (1.0, -1.0))
        change = 0.5 * (above.tangent(small)[0] - below.tangent(small)[0])
        assert along @ dx == pytest.approx(np.vdot(change, weight * means), rel=0.02)


@pytest.mark.costly
def test_the_gradient_at_the_true_vehicle_is_as_large_as_the_information_says():
    """On a road that friction hides in part, the sign of a likelihood that is right."""
    car = load_vehicle("compact")
    record, _ = simulate_record("iso_b", vehicle=car, speed_kmh=36.0, seed=15, length=200.0)
    settings = SolverSettings()
    drive, _ = settings.prepare(record, car)
    objective = whole_objective(drive, settings.road_prior)
    found = minimize(objective, GaussNewton(settings.huber))
    space = parameter_space(car)
    terms = tangent_terms(found, perturbed_cars(space, np.zeros(space.size)))
    values, vectors = np.linalg.eigh(terms.information)
    told = values > 3.0
    squares = (vectors.T @ terms.gradient)[told] ** 2 / values[told]
    assert told.sum() > 10 and np.mean(squares) < 3.0


def test_a_few_samples_average_a_quadratic_form_of_a_stationary_vehicle_exactly():
    K, rng = 64, np.random.default_rng(0)
    lin = SimpleNamespace(
        x=np.zeros(2 * K), adjoint=lambda e: np.zeros(2 * K + 3),
        passes=[SimpleNamespace(residual=np.zeros((3, K)), shape_noise=lambda e: e)],
        objective=SimpleNamespace(split=lambda x: (x.reshape(2, K),)),
    )  # fmt: skip
    waves = rfft(rng.standard_normal((4, K)))
    waves[:, [0, -1]] = 0.0  # no constant and no wave of two nodes, which have no phase
    a, b, c, d = (circulant(row) for row in irfft(waves))
    B = np.block([[a, b], [c, d]])
    samples = [sample[: 2 * K] for sample in _posterior_noise(lin)]
    assert len(samples) == TUNING.trace_draws
    assert np.mean([e @ B @ e for e in samples]) == pytest.approx(np.trace(B), abs=1e-9)
