"""Tests of speed profiles: distance, arrival time, and drives that follow them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq
from speeds import speed_ramp, stop_and_go

from road_envs.core.config import ConfigError
from road_envs.roads import load_road
from road_envs.simulation.drive import APRON_LENGTH, DriveSimulator, simulate
from road_envs.simulation.speed import SpeedProfile
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import encode_command

CAR = load_vehicle("land_rover_defender_110")
BELGIAN = load_road({"name": "belgian", "length": 40.0}).realise(np.random.default_rng(0))

speeds = st.lists(st.floats(0.0, 40.0), min_size=1, max_size=6)


@st.composite
def profiles(draw):
    v = [*draw(speeds), draw(st.floats(0.5, 40.0))]
    gaps = draw(st.lists(st.floats(0.1, 20.0), min_size=len(v) - 1, max_size=len(v) - 1))
    return SpeedProfile(t=(0.0, *np.cumsum(gaps).tolist()), v=tuple(v))


@given(profiles(), st.floats(0.01, 100.0))
def test_distance_is_the_integral_of_speed(profile, t):
    def speed(x):
        return np.interp(x, profile.t, profile.v)

    knots = [k for k in profile.t if 0.0 < k < t]
    s, v, _ = (float(x[0]) for x in profile.at(np.array([t])))
    assert v == pytest.approx(speed(t), abs=1e-9)
    assert s == pytest.approx(quad(speed, 0.0, t, points=knots or None, limit=200)[0], abs=1e-6)


@given(profiles(), st.floats(0.1, 500.0))
def test_the_arrival_time_is_when_the_distance_is_covered(profile, distance):
    arrival_time = profile.arrival_time(distance)
    late = profile.t[-1] + distance / profile.v[-1] + 1.0
    result = brentq(lambda t: profile.at(np.array([t]))[0][0] - distance, 0.0, late, xtol=1e-12)
    covered = profile.at(np.array([arrival_time, result]))[0]
    np.testing.assert_allclose(covered, distance, rtol=1e-9, atol=1e-6)


def test_a_stop_and_go_profile_is_at_zero_speed_during_its_halts():
    profile = stop_and_go(10.0, 2.0, cruise=1.0, halt=1.5, stops=2)
    t = np.linspace(0.0, profile.t[-1], 100_001)
    _, v, a = profile.at(t)
    assert np.mean(v == 0.0) * profile.t[-1] == pytest.approx(3.0, abs=0.01)
    assert set(np.round(a, 12)) == {-2.0, 0.0, 2.0}


def test_a_constant_profile_equals_a_speed_given_as_a_number():
    by_number = simulate(CAR, BELGIAN, 15.0)
    by_profile = simulate(CAR, BELGIAN, SpeedProfile(t=(0.0,), v=(15.0,)))
    np.testing.assert_array_equal(by_number.signals, by_profile.signals)


def test_the_body_comes_to_rest_during_a_halt():
    profile = stop_and_go(8.0, 2.0, cruise=1.0, halt=6.0, stops=1)
    motion = simulate(CAR, BELGIAN, profile)
    halting = (motion.t > profile.t[2] + 5.5) & (motion.t < profile.t[3])
    assert np.ptp(motion.s[halting]) == 0.0
    assert np.abs(motion.acceleration[halting]).max() < 0.02
    assert motion.s[-1] == pytest.approx(BELGIAN.end + CAR.wheelbase + APRON_LENGTH, abs=0.01)


def test_a_drive_with_a_speed_profile_in_chunks_equals_the_whole_drive():
    whole = simulate(CAR, BELGIAN, speed_ramp(4.0, 15.0, 3.0, after=0.5))
    drive = DriveSimulator(build_plant(CAR), CAR, BELGIAN, speed_ramp(4.0, 15.0, 3.0, after=0.5))
    parts = []
    while drive.steps_left:
        n = min(333, drive.steps_left)
        parts.append(drive.advance(np.full(n, encode_command("ride"), dtype=np.uint8)).signals)
    np.testing.assert_array_equal(np.concatenate(parts), whole.signals)
    assert drive.speed == 15.0


@pytest.mark.parametrize(
    ("t", "v", "message"),
    [
        ((0.0, 1.0), (5.0,), "one length"),
        ((1.0, 2.0), (5.0, 5.0), "start at 0"),
        ((0.0, 2.0, 2.0), (5.0, 5.0, 5.0), "increase"),
        ((0.0, 2.0), (5.0, 0.0), "positive at the end"),
        ((0.0, 2.0), (-5.0, 1.0), "must not be negative"),
        ((0.0,), (np.inf,), "finite"),
    ],
)
def test_an_impossible_profile_is_rejected(t, v, message):
    with pytest.raises(ValueError, match=message):
        SpeedProfile(t=t, v=v)


def test_a_speed_that_is_not_positive_is_rejected():
    with pytest.raises(ConfigError, match="must be positive"):
        simulate(CAR, BELGIAN, 0.0)
