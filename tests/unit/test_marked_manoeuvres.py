"""Tests of marked stretches: simulated turns and stops are marked, straight drives are not."""

import dataclasses

import numpy as np
import pytest
from speeds import stop_and_go

from estimators import estimate
from estimators.common.manoeuvres import _speed_changes, _turns, mark_manoeuvres
from road_envs.drives.recording import simulate_record, true_profile
from road_envs.records.record import Estimate, Record, profile_stations
from road_envs.roads import realise_road
from road_envs.sensing.instruments import load_instruments
from road_envs.simulation.drive import simulate
from road_envs.simulation.manoeuvres import LaneChange, SteadyTurn
from road_envs.vehicle.parameters import load_vehicle

CAR = load_vehicle("land_rover_defender_110")
WHEELBASE = 2.79


def drive(road="iso_b", speed=10.0, manoeuvre=None, mode="ride"):
    """Return the record of a drive with a manoeuvre, from the motion of the body itself."""
    surface = realise_road(road, 8990, 120.0)
    motion = simulate(CAR, surface, speed, mode, manoeuvre=manoeuvre)
    every = slice(None, None, max(1, round(0.005 / (motion.t[1] - motion.t[0]))))
    places = load_instruments("paper").locations(CAR).values()
    a = np.array([motion.vertical_acceleration(p.x, p.y)[every] for p in places])
    no = np.zeros((a.shape[1], 4), dtype=bool)
    parts = motion.t[every], a, motion.v[every], motion.s[every]
    return Record(*parts, no, no, surface.length), true_profile(surface)


@pytest.mark.parametrize("a_y", [1.96, -1.96])
def test_a_curve_of_a_fifth_of_g_is_marked_where_it_was_driven(a_y):
    record, _ = drive(manoeuvre=SteadyTurn(a_y=a_y, begin=4.0, hold=3.0))
    turned = _turns(record)
    during = (record.t > 4.2) & (record.t < 8.8)
    assert turned[during].all()
    assert not turned[(record.t < 1.5) | (record.t > 11.7)].any()


@pytest.mark.parametrize("a_y", [1.96, -1.96])
def test_a_curve_is_marked_on_class_c_and_a_road_that_twists_is_none(a_y):
    record, _ = drive("iso_c", manoeuvre=SteadyTurn(a_y=a_y, begin=4.0, hold=3.0))
    assert _turns(record).any()
    twisted, _ = simulate_record("twist", speed_kmh=14.5, seed=9400)
    assert not _turns(twisted).any()


@pytest.mark.parametrize("mode, offset", [("ride", 1.0), ("handling", 3.5)])
def test_a_lane_change_is_marked(mode, offset):
    change = LaneChange(v=15.0, begin=3.0, offset=offset)
    assert _turns(drive(speed=15.0, manoeuvre=change, mode=mode)[0]).any()


def test_a_stop_is_marked_and_said_first_and_the_interval_is_wider():
    record, _ = drive(speed=stop_and_go(10.0, 2.5, 3.0, 2.0, 1))
    s = profile_stations(record.length)
    z = 0.01 * np.sin(2.0 * np.pi * np.array([s, s]))
    found = mark_manoeuvres(Estimate(s, z, np.full_like(z, 1e-4), ("other",)), record, WHEELBASE)
    # 3 s at 10 m/s from 5 m before the road, 20 m to the stop, 20 m until the speed is back
    assert found.unsure[(s > 25.0) & (s < 63.0)].all()
    assert not found.unsure[(s < 20.0) | (s > 68.0)].any()
    assert "stood: heights there are not known" in found.notes[0] and found.notes[-1] == "other"
    assert (found.z_std[:, found.unsure] > 0.005).all()
    assert (found.z_std[:, ~found.unsure] == 1e-4).all()


@pytest.mark.parametrize("road", ["iso_a", "iso_b", "iso_c", "iso_d"])
@pytest.mark.parametrize("speed_kmh", [14.5, 36.0, 100.0])
@pytest.mark.costly
def test_straight_drives_are_not_marked(road, speed_kmh):
    record, _ = simulate_record(road, speed_kmh=speed_kmh, seed=8991, grade="S1", length=300.0)
    assert not _turns(record).any() and not _speed_changes(record).any()


def test_sensors_that_tell_no_roll_see_no_turn():
    record, _ = drive(manoeuvre=SteadyTurn(a_y=1.96, begin=4.0, hold=3.0))
    layout = load_instruments("paper").layout
    name = next(iter(layout))
    one = dataclasses.replace(record, a=record.a[:1], sensors={name: layout[name]})
    assert not _turns(one).any()


@pytest.mark.costly
def test_estimate_marks_a_turn_for_an_estimator_that_knows_none():
    record, _ = drive(manoeuvre=SteadyTurn(a_y=1.96, begin=4.0, hold=3.0))
    found = estimate("iterated_wiener", record)
    assert found.unsure is not None and "turned" in found.notes[0]
    assert estimate("iterated_wiener", drive()[0]).unsure is None
