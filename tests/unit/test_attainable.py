"""Tests of the attainable error and of the bound of van Trees."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from vehicle_fixtures import DEFENDER

from estimators.common.spline import evaluate_spline
from estimators.map_smoother.attainable import (
    _ExpectedInformation,
    _whole_drive,
    attainable_error,
    van_trees_error,
)
from estimators.map_smoother.gauss_newton import MapSolution
from estimators.map_smoother.posterior_sampling import band_pass, draw_deviations, interior
from estimators.map_smoother.preconditioner import stationary_hessian
from road_envs.analysis.information_bound import RoadPrior
from road_envs.drives.recording import simulate_record
from road_envs.records.roughness import CLASSES

PRIOR = RoadPrior(G_d0=CLASSES["D"])


def drive(length, mode="handling", kmh=54.0):
    return simulate_record("iso_d", speed_kmh=kmh, mode=mode, seed=31, length=length)


def test_the_noise_of_the_truth_gives_the_true_heights():
    record, truth = drive(30.0)
    objective = _whole_drive(record, DEFENDER, PRIOR, 100.0, "paper")
    s, road = np.linspace(2.0, 28.0, 200), objective.road
    c = road.coefficients(road.noise_of(truth))
    z = evaluate_spline(c, (s - road.origin) / road.ds)
    true = np.array([np.interp(s, truth.s, path - path[0]) for path in truth.z])
    assert np.std(z - true) < 0.04 * np.std(true)  # what is shorter than two nodes is left out


@pytest.mark.costly
def test_samples_have_the_covariance_of_the_dense_posterior():
    record, truth = drive(6.0)
    objective = _whole_drive(record, DEFENDER, PRIOR, 50.0, "paper")
    lin = objective.linearize(objective.from_noise(objective.road.noise_of(truth)))
    H = np.array([lin.hessian_product(row) for row in np.eye(objective.size)])
    road = objective.road
    inside = (road.n > 0.3) & (road.n < 1.6)
    nodes = interior(road.free, 20)

    def in_band(x):
        return band_pass(road.apply(objective.split(x)[0]), inside)[:, nodes].ravel()

    B = np.array([in_band(row) for row in np.eye(objective.size)]).T
    expected = np.trace(B @ np.linalg.solve(0.5 * (H + H.T), B.T))
    solution = MapSolution(lin, stationary_hessian(objective), noise_scale=np.ones(1))
    solve, rng = solution.inverse_hessian(2000, 1e-6), np.random.default_rng(2)
    drawn = [in_band(dx) for dx in draw_deviations(lin, solve, rng, 60)]
    assert np.mean(np.sum(np.square(drawn), axis=1)) == pytest.approx(expected, rel=0.25)


@pytest.mark.costly
def test_more_bandwidth_and_less_noise_attain_less_error():
    record, truth = drive(60.0, "ride", 14.5)
    wide, narrow = (
        attainable_error(record, truth, DEFENDER, PRIOR, bandwidth=f) for f in (333.0, 25.0)
    )
    assert 0.03 < wide < 0.8 * narrow < 0.3
    rough = attainable_error(
        record, truth, DEFENDER, replace(PRIOR, G_d0=CLASSES["F"]), bandwidth=25.0
    )
    assert rough > 0.9 * narrow  # a weaker prior leaves no less to be found out


@pytest.mark.parametrize("cubic", [0.0, 0.3, 1.0])
def test_of_a_scalar_the_bound_of_van_trees_is_its_closed_form_and_below_the_least_error(cubic):
    """y = z + cubic z³ + e: of a linear measurement the bound is the posterior variance."""
    R, rng = 0.25, np.random.default_rng(0)

    def at(z):
        g = (1.0 + 3.0 * cubic * z**2) / np.sqrt(R)
        return SimpleNamespace(
            hessian_product=lambda x: x + g**2 * x,
            adjoint=lambda e: g * e,
            draw_noise=lambda rng: rng.standard_normal(),
        )

    expected = _ExpectedInformation([at(z) for z in rng.standard_normal(10_000)])
    precision = 1.0 + (1.0 + 6.0 * cubic + 27.0 * cubic**2) / R
    assert expected.hessian_product(np.ones(1)) == pytest.approx(precision, rel=0.1)
    few = _ExpectedInformation(expected.at[:20])
    scores = [few.adjoint(few.draw_noise(rng)) for _ in range(2000)]
    assert np.var(scores) == pytest.approx(few.hessian_product(np.ones(1))[0] - 1.0, rel=0.15)
    # the least error is that of the posterior mean, by quadrature over z and y
    z = np.linspace(-8.0, 8.0, 801)
    prior = np.exp(-0.5 * z**2) / np.exp(-0.5 * z**2).sum()
    g = z + cubic * z**3
    y = np.linspace(g[100] - 3.0, g[-101] + 3.0, 2001)  # beyond 6 deviations nothing is left
    joint = prior * np.exp(-0.5 * (y[:, None] - g) ** 2 / R) / np.sqrt(2.0 * np.pi * R)
    total = np.maximum(joint.sum(axis=1), 1e-300)
    least = 1.0 - np.sum((joint @ z) ** 2 / total) * (y[1] - y[0])
    assert 1.0 / precision <= least * (1.0 + 1e-6)
    if cubic == 0.0:
        assert 1.0 / precision == pytest.approx(least, rel=1e-6)


def test_the_bound_of_van_trees_falls_with_the_roads_and_is_below_what_is_attainable():
    record, truth = drive(30.0)
    one, many = (van_trees_error(record, DEFENDER, PRIOR, roads=n) for n in (1, 6))
    assert 0.005 < many < 0.7 * one
    assert many < attainable_error(record, truth, DEFENDER, PRIOR)
