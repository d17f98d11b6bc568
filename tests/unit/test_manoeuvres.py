"""Tests of manoeuvres: roll and pitch of the body follow from the moments of inertia forces."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from speeds import speed_ramp

from road_envs.core.config import ConfigError
from road_envs.roads import load_road
from road_envs.simulation.drive import simulate
from road_envs.simulation.manoeuvres import (
    KINDS,
    Braking,
    LaneChange,
    Slalom,
    SteadyTurn,
    Successive,
    load_manoeuvre,
)
from road_envs.vehicle.equations import PHI, THETA, build_plant
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.linear_model import jacobian
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import encode_command, settled_strut_state

CAR = load_vehicle("land_rover_defender_110")
FLAT = load_road({"kind": "flat", "length": 200.0}).realise(np.random.default_rng(0))
LEVEL = np.zeros(4)


def without_stops(car):
    none = Curve(x=(-1.0, 1.0), F=(0.0, 0.0))
    stops = dataclasses.replace(car.strut.bump_stop, front=none, rear=none)
    strut = dataclasses.replace(car.strut, bushing=none, bump_stop=stops)
    return dataclasses.replace(car, strut=strut)


@pytest.mark.parametrize(("mode", "rate"), [("ride", 16.69e3), ("handling", 83.6e3)])
def test_a_gentle_steady_turn_rolls_the_body_by_moment_over_stiffness(mode, rate):
    a_y = 0.1
    motion = simulate(CAR, FLAT, 10.0, mode, manoeuvre=SteadyTurn(a_y=a_y))
    lever = 1734.0 * (1.19 - 0.6)
    struts, tyres = 4 * rate * 0.55**2, 4 * 250e3 * 0.75**2
    stiffness = 1.0 / (1.0 / struts + 1.0 / tyres)
    expected = lever * a_y / (stiffness - lever * 9.81)
    assert motion.state[-1, PHI] == pytest.approx(expected, rel=0.01)


def test_at_a_lateral_acceleration_of_0_4_g_the_bump_stops_limit_the_roll():
    # a linear vehicle would roll by 24 degrees in ride mode. The gas spring softens as it extends,
    # so without bump stops there is no equilibrium and the vehicle overturns
    lean = {
        mode: np.degrees(simulate(CAR, FLAT, 10.0, mode, manoeuvre=SteadyTurn()).state[-1, PHI])
        for mode in ("ride", "handling")
    }
    assert 8.0 < lean["ride"] < 14.0
    assert 2.5 < lean["handling"] < 5.0
    free = simulate(without_stops(CAR), FLAT, 10.0, "ride", manoeuvre=SteadyTurn())
    assert np.degrees(free.state[-1, PHI]) > 90.0


def test_a_turn_to_the_left_lifts_the_left_side_and_loads_the_right_tyres():
    motion = simulate(CAR, FLAT, 10.0, manoeuvre=SteadyTurn(a_y=2.0))
    left, right = motion.tyre_load[-1, [0, 2]], motion.tyre_load[-1, [1, 3]]
    assert motion.state[-1, PHI] > 0.0
    assert (left < right).all()


def test_braking_pitches_nose_down_and_accelerating_nose_up():
    braking = simulate(CAR, FLAT, 15.0, manoeuvre=Braking(a_x=3.0, hold=5.0))
    assert braking.state[3000, THETA] > 0.005
    still = SteadyTurn(a_y=0.0)
    away = simulate(CAR, FLAT, speed_ramp(2.0, 14.0, 4.0), manoeuvre=still)
    assert away.state[3000, THETA] < -0.005


def test_a_speed_profile_without_a_manoeuvre_causes_no_body_motion():
    motion = simulate(CAR, FLAT, speed_ramp(2.0, 14.0, 4.0))
    assert np.abs(motion.acceleration).max() < 1e-6


def test_the_jacobian_contains_the_moments_of_the_displaced_weight():
    strut_state = settled_strut_state(encode_command("ride"))
    state = np.zeros(14)
    leaning, upright = (
        jacobian(build_plant(CAR, manoeuvres=m), strut_state, state, LEVEL, LEVEL)
        for m in (True, False)
    )
    difference = np.zeros((14, 14))
    lever = 1734.0 * (1.19 - 0.6) * 9.81
    difference[7 + PHI, PHI], difference[7 + THETA, THETA] = lever / 688.0, lever / 2440.0
    np.testing.assert_allclose(leaning - upright, difference, atol=1e-9)


def test_a_lane_change_moves_one_lane_over_and_back():
    manoeuvre = LaneChange(v=15.0)
    t = np.linspace(0.0, 10.0, 200_001)
    a_y = manoeuvre.at(t)[:, 1]
    velocity = cumulative_trapezoid(a_y, t, initial=0.0)
    y = cumulative_trapezoid(velocity, t, initial=0.0)
    assert y[np.searchsorted(t, 1.0 + 30.0 / 15.0)] == pytest.approx(3.5, abs=1e-4)
    assert y[-1] == pytest.approx(0.0, abs=1e-3) and velocity[-1] == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_every_manoeuvre_begins_at_zero_and_is_continuous(kind):
    t = np.linspace(0.0, 20.0, 200_001)
    a = load_manoeuvre(kind).at(t)
    assert a.shape == (t.size, 2)
    assert np.abs(a[0]).max() == 0.0
    assert np.abs(np.diff(a, axis=0)).max() < 0.01


def test_mirrored_slaloms_mirror_the_motion():
    left, right = (
        simulate(CAR, FLAT, 15.0, "handling", manoeuvre=Slalom(a_y=a)) for a in (2.0, -2.0)
    )
    np.testing.assert_allclose(left.state[:, PHI], -right.state[:, PHI], atol=1e-12)


def test_an_unknown_manoeuvre_or_setting_is_rejected_with_the_choices():
    with pytest.raises(ConfigError, match="did you mean 'slalom'"):
        load_manoeuvre("slalon")
    with pytest.raises(ConfigError, match="unknown key, did you mean 'a_y'"):
        load_manoeuvre({"kind": "slalom", "a_z": 1.0})
    with pytest.raises(ConfigError, match="needs a key 'kind'"):
        load_manoeuvre({"a_y": 1.0})


def test_a_fishhook_reverses_and_ends():
    t = np.array([0.9, 1.6, 2.9, 4.7, 6.5])
    a_y = load_manoeuvre({"kind": "fishhook", "a_y": 4.0}).at(t)[:, 1]
    assert a_y == pytest.approx([0.0, 4.0, -4.0, -4.0, 0.0])


def test_successive_manoeuvres_add_up_and_a_slalom_ends():
    turn, slalom = load_manoeuvre("steady_turn"), Slalom(periods=2.0)
    t = np.linspace(0.0, 15.0, 300)
    both = Successive((turn, slalom)).at(t)
    np.testing.assert_array_equal(both, turn.at(t) + slalom.at(t))
    assert np.abs(slalom.at(t[t > 1.0 + 3.0 * 3.0])).max() < 1e-12
    assert slalom.at(t[t < 7.0])[:, 1].max() > 2.0
