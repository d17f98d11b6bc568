"""Vehicle parameters: the values of the paper and the static loads that follow from them."""

from dataclasses import replace

import oracles
import pytest
from vehicle_fixtures import CARS, DEFENDER

from road_envs.vehicle.parameters import GRAVITY, load_vehicle

PAPER = oracles.PAPER_CAR
every_car = pytest.mark.parametrize("name", CARS)


def test_the_shipped_defender_has_the_papers_parameters():
    for name in ("m_b", "I_xx", "I_yy"):
        assert getattr(DEFENDER, name) == getattr(PAPER, name)
    for ours, theirs in zip(DEFENDER.axles, (PAPER.front, PAPER.rear), strict=True):
        for name in ("x", "m", "I_xx", "y_s", "y_t", "k_t", "c_t"):
            assert getattr(ours, name) == pytest.approx(getattr(theirs, name), rel=1e-12)
    strut = DEFENDER.strut
    assert (strut.p_stat, strut.A, strut.n_p) == (oracles.P_STAT, oracles.BORE, oracles.N_P)
    assert strut.x_1 == oracles.X_STAT["handling"]
    assert strut.x_1 + strut.x_2 == pytest.approx(oracles.X_STAT["ride"], rel=1e-12)
    assert DEFENDER.h_cg == 1.19 and GRAVITY == oracles.G
    assert DEFENDER.wheelbase == pytest.approx(2.794)


def test_the_static_gas_pressure_carries_the_defender():
    struts = 4.0 * oracles.P_STAT * oracles.BORE
    assert struts == pytest.approx(DEFENDER.m_b * oracles.G, rel=5e-4)


@every_car
def test_loads_add_up_to_the_weight_and_balance_about_the_centre_of_mass(name):
    car = CARS[name]
    struts, tyres = oracles.static_loads(car)
    assert car.strut_loads == pytest.approx(tuple(struts))
    assert car.tyre_loads == pytest.approx(tuple(tyres))
    total = oracles.G * (car.m_b + car.front.m + car.rear.m)
    assert 2.0 * sum(car.tyre_loads) == pytest.approx(total)
    front, rear = car.strut_loads
    assert front * car.front.x + rear * car.rear.x == pytest.approx(0.0, abs=1e-9)


def test_the_axle_nearer_the_centre_of_mass_has_the_larger_load():
    front, rear = CARS["unequal_axles"].strut_loads
    assert front / rear == pytest.approx(1.6 / 1.2)


def test_the_load_share_of_the_defenders_axles_is_as_published():
    front, rear = DEFENDER.strut_loads
    assert front / (front + rear) == pytest.approx(0.5007, abs=5e-5)


@every_car
def test_tyre_deflections_come_from_the_loads_unless_one_is_given(name):
    car = CARS[name]
    for deflection, load, axle in zip(
        car.tyre_deflections, oracles.static_loads(car)[1], car.axles, strict=True
    ):
        assert deflection == pytest.approx(load / axle.k_t)
    assert replace(car, tyre_static_deflection=0.010).tyre_deflections == (0.010, 0.010)


def test_replaced_values_are_validated():
    with pytest.raises(ValueError, match="m_b: must be positive"):
        replace(DEFENDER, m_b=0.0)


def test_a_vehicle_is_loaded_by_name():
    assert load_vehicle("land_rover_defender_110") == DEFENDER
