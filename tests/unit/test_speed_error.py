"""The error of the speed, found by the time from axle to axle."""

from dataclasses import replace

import numpy as np
import pytest
from test_map_smoother import residual_at
from vehicle_fixtures import DEFENDER

from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.gauss_newton import GaussNewton, minimize
from estimators.map_smoother.objective import Objective
from estimators.map_smoother.solver import _estimate_speed_error, distance_scale
from estimators.map_smoother.windows import whole_objective
from road_envs.analysis.information_bound import RoadPrior
from road_envs.drives.recording import simulate_record
from road_envs.roads.iso8608 import Iso8608
from road_envs.sensing.instruments import load_instruments

PAPER = load_instruments("paper")
SPEED_STD = 0.005


def objective_of(too_fast: float, length: float = 20.0) -> Objective:
    """Return the objective of a drive of the described vehicle whose speed reads `too_fast`."""
    surface = Iso8608(road_class="D", length=length).realise(np.random.default_rng(5))
    record, _ = simulate_record(surface, vehicle=DEFENDER, speed_kmh=36.0, mode="handling", seed=5)
    first, factor = record.s[0], 1.0 + too_fast
    s = first + factor * (record.s - first)
    record = replace(record, s=s, v=factor * record.v, length=factor * record.length)
    drive, _ = MapSmoother().prepare(record, DEFENDER)
    model = replace(drive.model, speed_std=SPEED_STD)
    return whole_objective(replace(drive, model=model), RoadPrior())


def test_the_derivative_by_the_speed_is_that_of_drives_and_has_its_transpose():
    objective = objective_of(0.0, 12.0)
    rng = np.random.default_rng(1)
    x = 0.3 * rng.standard_normal(objective.size)
    lin = objective.linearize(x)
    last = (np.arange(x.size) == x.size - 1).astype(float)
    step = 1e-3 * last
    before, after = (residual_at(objective, x + change) for change in (-step, step))
    expected = (before - after) / 2e-3
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(lin.tangent(last)[0], expected, atol=0.02 * np.abs(expected).max())
    dx, dual = rng.standard_normal(x.size), rng.standard_normal(expected.shape)
    assert np.sum(lin.tangent(dx)[0] * dual) == pytest.approx(dx @ lin.adjoint([dual]), rel=1e-9)


def test_a_wrong_speed_is_found_with_the_road():
    objective = objective_of(too_fast=0.012)
    solution = minimize(objective, GaussNewton(prior_updates=0))
    error, variance = _estimate_speed_error(solution)
    assert error == pytest.approx(1.0 / 1.012 - 1.0, abs=4e-4)
    assert 1e-5 < np.sqrt(variance) < 4e-4


def test_distances_are_corrected_where_the_speed_is_identified_and_not_doubted():
    model = objective_of(0.0, 12.0).passes[0].model
    found, notes = distance_scale([(0.004, 1e-8), (0.006, 3e-8)], model)
    assert found is not None and not notes
    assert found.factor == pytest.approx(1.0045)
    assert 0.001 < found.std < 0.0011
    assert distance_scale([(0.004, 1e-6)], model) == (None, ())  # hardly more than the speed tells
    assert distance_scale([], model) == (None, ())
    doubted, (note,) = distance_scale([(0.03, 1e-8)], model)
    assert doubted is None
    assert "differs by +3.0 %, or a wheelbase of 2.71 m instead of 2.79 m" in note
