"""Tests of the note on drives whose struts friction holds."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.estimation import estimate, friction_note
from road_envs.drives.recording import simulate_record
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import friction_peaks

DEFENDER = load_vehicle("land_rover_defender_110")
FACTORS = (1.1, 0.9, 1.2, 0.8)


def test_peaks_are_those_of_the_curves_times_the_wheels_factors():
    car = replace(DEFENDER, variation=replace(DEFENDER.variation, friction=FACTORS))
    expected = np.outer([225.0, 375.0], FACTORS)  # configs/vehicles/land_rover_defender_110.yaml
    np.testing.assert_allclose(friction_peaks(car), expected)
    passive = load_vehicle("volkswagen_vanagon")
    low, high = friction_peaks(passive)
    np.testing.assert_array_equal(low, high)
    assert low[0] == low[1] and (low > 0.0).all()


def test_the_note_begins_where_the_accelerations_are_below_what_friction_passes_on():
    record, _ = simulate_record("iso_d", speed_kmh=36.0, mode="ride", seed=3, length=40.0)
    rms = np.sqrt(np.mean(np.var(record.a, axis=1)))
    passed = 4.0 * 225.0 / DEFENDER.m_b
    for share, noted in ((1.2, True), (1.3, False)):
        slower = replace(record, a=record.a * share * passed / rms)
        assert bool(friction_note(slower, DEFENDER)) is noted
    stiffer = replace(slower, damper_high=np.ones_like(record.damper_high))
    assert "0.87 m/s²" in friction_note(stiffer, DEFENDER)[0]


@pytest.mark.parametrize("road, first", [("iso_a", True), ("iso_d", False)])
def test_a_walk_over_a_smooth_road_is_uncertain_in_the_first_line(road, first):
    record, _ = simulate_record(road, speed_kmh=14.5, mode="ride", seed=3, length=40.0)
    notes = estimate("wiener", record, adapt=False).notes
    assert (bool(notes) and "friction holds" in notes[0]) is first
