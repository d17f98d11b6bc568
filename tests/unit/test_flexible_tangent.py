"""Tangent of the drive of a vehicle with a flexible frame."""

import numpy as np
import pytest
from vehicle_fixtures import DEFENDER, VARIED_MANOEUVRE_PLANTS

import estimators
from road_envs.drives.recording import simulate_record
from road_envs.simulation.tape import linearize_drive
from road_envs.vehicle.equilibrium import equilibrium
from road_envs.vehicle.suspension import encode_command, settled_strut_state
from road_envs.vehicle.tolerances import parameter_space

PLANT, STEPS, H = VARIED_MANOEUVRE_PLANTS["flexible"], 60, 1e-3


@pytest.mark.parametrize("mode", ["ride", "handling"])
def test_the_tangent_of_a_flexible_vehicle_equals_the_finite_difference(mode):
    rng = np.random.default_rng(5)
    strut_state = settled_strut_state(encode_command(mode))
    rest = equilibrium(PLANT, strut_state, np.zeros(4))
    start = rest + rng.normal(scale=np.repeat([5e-3, 0.2], 8))
    road = np.cumsum(rng.normal(scale=[[2e-4], [1e-2]], size=(2 * STEPS, 2, 4)), axis=0)
    dy, droad = rng.normal(scale=np.repeat([1e-2, 0.3], 8)), rng.normal(size=road.shape)
    droad *= np.array([[0.01], [0.3]])
    tape = linearize_drive(PLANT, strut_state, start, road, H)
    assert np.ptp(tape.acceleration[:, 7]) > 1.0 and tape.signals[:, 25:29].min() > 0.0
    a, end = tape.tangent(dy, droad)
    eps = 1e-7
    moved = [
        linearize_drive(PLANT, strut_state, start + e * dy, road + e * droad, H)
        for e in (eps, -eps)
    ]
    expected = (moved[0].acceleration - moved[1].acceleration) / (2.0 * eps)
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(a / scale, expected / scale, atol=2e-5)
    expected_end = (moved[0].end - moved[1].end) / (2.0 * eps)
    np.testing.assert_allclose(end, expected_end, atol=2e-5 * np.abs(expected_end).max())


def test_the_inverse_quarter_car_leaves_out_the_frame():
    car = parameter_space(DEFENDER, structure=True).car
    record, _ = simulate_record("iso_c", speed_kmh=30.0, seed=3, vehicle=DEFENDER, length=20.0)
    estimator = estimators.make_estimator("inverse_quarter_car")
    flexible, rigid = (estimator.estimate(record, one) for one in (car, car.rigid))
    np.testing.assert_array_equal(flexible.z, rigid.z)
    assert DEFENDER.rigid is DEFENDER
