"""Impossible heights: what they demand of the vehicle is told by Newton's law alone."""

import re
from dataclasses import dataclass

import numpy as np
import pytest
from vehicle_fixtures import DEFENDER

import estimators
from estimators.common.explained import mark_impossible
from estimators.kalman.monitoring import reduce_slope
from estimators.wiener.wiener import Wiener
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Estimate, Record, profile_stations
from road_envs.roads import realise_road
from road_envs.sensing.instruments import load_instruments

LENGTH, V, WAVE, FS = 240.0, 10.0, 40.0, 400.0
MIXED = {"front": "ride", "rear": "handling"}


def swell(height):
    """Record and heights of a car that follows long waves: a = v² z'', within some percent."""
    s = np.arange(-5.0, LENGTH + 5.0, V / FS)
    centre, k = s - 0.5 * DEFENDER.wheelbase, 2.0 * np.pi / WAVE
    on = (centre > 0.0) & (centre < LENGTH)
    a = np.tile(np.where(on, 0.5 * height * (k * V) ** 2 * np.cos(k * centre), 0.0), (3, 1))
    rng, paper = np.random.default_rng(6), load_instruments("paper")
    a += paper.noise_rms(FS) * rng.standard_normal(a.shape)
    no = np.zeros((s.size, 4), dtype=bool)
    record = Record(s / V, a, np.full(s.size, V), s, no, no, LENGTH)
    stations = profile_stations(LENGTH)
    return record, np.tile(0.5 * height * (1.0 - np.cos(k * stations)), (2, 1))


def marked(record, z):
    s = profile_stations(record.length)
    estimate = Estimate(s, z, np.full_like(z, 1e-4), ("other",))
    return s, mark_impossible(estimate, record, DEFENDER, Wiener())


def test_heights_that_demand_three_times_the_measured_acceleration_are_impossible():
    record, z = swell(0.2)
    _, right = marked(record, z)
    assert right.unsure is None and right.notes == ("other",)
    assert marked(record, 1.6 * z)[1].unsure is None
    s, found = marked(record, 3.0 * z)
    assert found.unsure[(s > 40.0) & (s < 210.0)].all()
    assert re.search("up to [34] times as hard as was measured", found.notes[0])
    assert found.notes[0].startswith("no wheel load supports") and found.notes[-1] == "other"


def test_the_stretch_that_is_impossible_is_marked_and_its_interval_is_wider():
    record, z = swell(0.2)
    s = profile_stations(record.length)
    z = z * np.where(s < 120.0, 1.0, 4.0)  # z is 0 at 120 m: no step
    _, found = marked(record, z)
    assert found.unsure[(s > 140.0) & (s < 220.0)].all() and not found.unsure[s < 100.0].any()
    assert (found.z_std[:, found.unsure] > 1e-3).all()
    assert (found.z_std[:, ~found.unsure] == 1e-4).all()


def test_what_is_small_beside_the_sensors_noise_is_not_impossible():
    record, _ = swell(0.0)
    # RMS of the noise below 25 Hz, of which the heights demand 2 times, and 8 times
    noise = load_instruments("paper").noise_density * 5.0
    z = swell(noise * np.sqrt(8.0) / (2.0 * np.pi * V / WAVE) ** 2)[1]
    assert marked(record, 2.0 * z)[1].unsure is None
    assert marked(record, 8.0 * z)[1].unsure is not None


@dataclass(frozen=True)
class Exaggerated:
    """An estimator that gives a road many times too high."""

    z: np.ndarray
    instruments: str = "paper"
    causal = False

    def estimate(self, record, car):
        """Estimate what it was given."""
        return Estimate(profile_stations(record.length), self.z, None, ("other",))


def test_every_estimate_by_a_model_is_checked_alone_and_of_several_passes():
    record, truth = simulate_record("iso_c", speed_kmh=36.0, seed=3601, length=60.0)
    again, _ = simulate_record("iso_c", speed_kmh=30.0, seed=3601, length=60.0)
    wrong = Exaggerated(5.0 * truth.z)
    for drives in (record, [record, again]):
        found = estimators.estimate(wrong, drives)
        assert found.notes[0].startswith("no wheel load") and found.unsure.mean() > 0.3
        assert found.z_std is None
        assert estimators.estimate(Exaggerated(truth.z), drives).unsure is None


def test_turns_and_impossible_heights_are_marked_together():
    record, z = swell(0.2)
    s = profile_stations(LENGTH)
    turned = Estimate(s, 3.0 * z, None, ("turned",), unsure=s < 10.0)
    found = mark_impossible(turned, record, DEFENDER, Wiener())
    assert found.unsure[s < 10.0].all() and found.unsure[(s > 40.0) & (s < 210.0)].all()


def test_of_a_lost_drift_the_slope_is_reduced_and_no_step_is_made():
    s = np.arange(100.0)
    long = np.stack([0.1 * s, -0.2 * s]) + 3.0
    share = np.where((s >= 40.0) & (s < 60.0), 0.0, 1.0)
    found = reduce_slope(long, share)
    np.testing.assert_allclose(found[:, :40], long[:, :40])
    np.testing.assert_allclose(np.diff(found[:, 39:60]), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.diff(found[:, 59:]), np.diff(long[:, 59:]))
    assert reduce_slope(long, np.ones(100)) is long


@pytest.mark.parametrize(
    ("name", "road", "speed", "mode", "grade", "instruments"),
    [
        ("kalman_rts", "iso_b", 100.0, MIXED, "S2", "paper"),  # 58 times its range
        ("kalman_rts", "iso_a", 100.0, MIXED, "S2", "paper"),  # 62 times
        ("kalman_rts", "twist", 54.0, MIXED, "S0", "paper"),  # 2.5 times
        pytest.param(
            *("map_smoother", "washboard", 54.0, "handling", "S0", "phone"),  # raised ValueError
            marks=pytest.mark.slow,
        ),
    ],
)
def test_no_estimate_rises_beyond_three_times_the_range_of_the_road(
    name, road, speed, mode, grade, instruments
):
    seed = 3501 + int(speed) if road.startswith("iso") else 3101
    surface = realise_road(road, seed, 60.0 if road.startswith("iso") else None)
    record, truth = simulate_record(
        surface, speed_kmh=speed, mode=mode, seed=seed, grade=grade, instruments=instruments
    )
    found = estimators.estimate(name, record, DEFENDER)
    assert np.ptp(found.z) < 3.0 * np.ptp(truth.z)
    assert found.notes
