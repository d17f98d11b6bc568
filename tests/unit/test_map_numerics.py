"""Numerical parts of the MAP smoother: conjugate gradients, smoothed friction and Huber weights."""

import numpy as np
import pytest
from vehicle_fixtures import DEFENDER

from estimators.common.conjugate_gradients import conjugate_gradients
from estimators.map_smoother.gauss_newton import (
    _huber_weights,
    _smooth_friction,
)
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.force_curves import interpolate_table
from road_envs.vehicle.suspension import V_0, V_STEP


def test_conjugate_gradients_agree_with_a_dense_solver():
    rng = np.random.default_rng(5)
    A = rng.standard_normal((30, 30))
    A, b = A @ A.T + np.eye(30), rng.standard_normal(30)
    M = np.diag(1.0 / np.diag(A))
    x, k = conjugate_gradients(lambda v: A @ v, b, lambda v: M @ v, 200, 1e-12)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-8)
    assert 10 < k < 100
    assert conjugate_gradients(lambda v: A @ v, b, lambda v: v, 4, 0.0)[1] == 4


def test_smoothed_friction_is_the_mean_over_a_gaussian_rate():
    plant = build_plant(DEFENDER)
    smooth = _smooth_friction(plant, 0.05)
    rates = np.random.default_rng(6).normal(0.0, 0.05, 200_000)[::20]
    for k, v in ((0.0, 0.03), (1.0, -0.2)):
        forces = [interpolate_table(plant.velocity, k, V_0, V_STEP, v + e)[0] for e in rates]
        force, slope = interpolate_table(smooth.velocity, k, V_0, V_STEP, v)
        assert force == pytest.approx(np.mean(forces), abs=6.0)
        ahead = interpolate_table(smooth.velocity, k, V_0, V_STEP, v + 1e-5)[0]
        assert (ahead - force) / 1e-5 == pytest.approx(slope, rel=1e-2)


def test_huber_weights_fall_in_proportion_to_the_residual():
    residual, inverse_variance = np.array([0.5, -4.0, 10.0]), np.array([1.0, 1.0, 4.0])
    np.testing.assert_allclose(_huber_weights(residual, inverse_variance, 2.0), [1.0, 0.5, 0.4])
