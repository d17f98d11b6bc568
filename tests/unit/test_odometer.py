"""Calibration of the odometer against its position fixes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from estimators import create
from estimators.api import check_estimate
from estimators.common.odometer import (
    _calibrate_odometer_online,
    calibrate_odometer,
    to_true_distance,
)
from road_envs.drives.recording import simulate_record
from road_envs.records.record import DistanceScale, Estimate, Record, profile_stations
from road_envs.roads import realise_road
from road_envs.vehicle.parameters import load_vehicle

FS, DURATION = 200.0, 8.0


def true_speed(t):
    return 14.0 + 2.0 * np.sin(0.7 * t)


def drive(error, length, noise=0.0):
    """Return the record of an odometer with this speed error and distance of its fixes, and the
    true stations.
    """
    t = np.arange(int(DURATION * FS)) / FS

    def rates(time, y):
        v = true_speed(time)
        return [v, v * (error - y[1] / length)]

    found = solve_ivp(rates, (0.0, DURATION), [-3.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-10)
    s, displacement = found.y
    s_read = s + displacement + noise * np.random.default_rng(1).standard_normal(t.size)
    states = np.zeros((t.size, 4), dtype=bool)
    v = (1.0 + error) * true_speed(t)
    return Record(t, np.zeros((3, t.size)), v, s_read, states, states, 100.0), s


@pytest.mark.parametrize("error, length", [(0.02, 10.0), (-0.015, 10.0), (0.05, 4.0), (0.01, 30.0)])
def test_the_displacement_of_an_odometer_with_position_fixes_is_found(error, length):
    record, s = drive(error, length)
    calibrated, notes = calibrate_odometer(record)
    assert np.abs(record.s - s).max() > 0.1
    np.testing.assert_allclose(calibrated.s, s, atol=2e-3)
    np.testing.assert_allclose(calibrated.v, true_speed(record.t), rtol=1e-4)
    assert notes[0].startswith(f"the speed signal reads {100.0 * error:+.1f} % beside")
    assert calibrate_odometer(calibrated) == (calibrated, ())


@pytest.mark.parametrize("length, noise", [(1e9, 0.0), (1e-3, 0.0), (10.0, 0.3)])
def test_an_odometer_without_fixes_with_immediate_or_with_noisy_ones_is_left_alone(length, noise):
    record, _ = drive(0.02, length, noise)
    assert calibrate_odometer(record)[0] is record


def test_fixes_with_some_noise_leave_centimetres():
    record, s = drive(0.02, 10.0, 0.01)
    calibrated, _ = calibrate_odometer(record)
    assert np.abs(calibrated.s - s).max() < 0.2 * np.abs(record.s - s).max() + 4.0 * 0.01


def test_a_record_with_lost_speeds_is_left_alone():
    record, _ = drive(0.02, 10.0)
    lost = replace(record, v=np.where(record.t > 7.0, np.nan, record.v))
    assert calibrate_odometer(lost) == (lost, ())


@pytest.mark.parametrize("error, length", [(0.02, 10.0), (-0.015, 10.0), (0.05, 4.0), (0.01, 30.0)])
def test_online_the_displacement_is_found_from_the_samples_before_alone(error, length):
    record, s = drive(error, length)
    calibrated, notes = _calibrate_odometer_online(record)
    assert (np.abs(calibrated.s - s) <= np.abs(record.s - s) + 2e-3).all()
    np.testing.assert_allclose(calibrated.s[400:], s[400:], atol=3e-3)
    assert notes[0].startswith(f"the speed signal reads {100.0 * error:+.1f} % beside")
    half = slice(0, record.t.size // 2)
    first = replace(record, **{name: getattr(record, name)[half] for name in ("t", "v", "s")})
    before, _ = _calibrate_odometer_online(first)
    np.testing.assert_array_equal(before.s, calibrated.s[half])
    np.testing.assert_array_equal(before.v, calibrated.v[half])


@pytest.mark.parametrize("length, noise", [(1e9, 0.0), (1e-3, 0.0), (10.0, 0.3)])
def test_online_an_unclear_displacement_is_left_alone(length, noise):
    record, _ = drive(0.02, length, noise)
    assert _calibrate_odometer_online(record)[0] is record


def test_stations_speed_and_heights_follow_the_distance_scale_that_was_found():
    record, _ = drive(0.0, 1e9)
    s = profile_stations(record.length)
    found = Estimate(s, np.exp(-((s - 50.0) ** 2)) * np.ones((2, 1)), 0.01 * np.ones((2, s.size)))
    assert to_true_distance(record, found) == (record, found)
    corrected, estimate = to_true_distance(
        record, replace(found, distance=DistanceScale(1.01, 0.002))
    )
    first = record.s[0]
    np.testing.assert_allclose(corrected.s - first, 1.01 * (record.s - first))
    np.testing.assert_allclose(corrected.v, 1.01 * record.v)
    check_estimate(estimate, corrected)
    assert estimate.s[estimate.z[0].argmax()] == pytest.approx(
        first + 1.01 * (50.0 - first), abs=0.02
    )
    assert estimate.z.max() == pytest.approx(1.0, abs=1e-3)
    assert estimate.distance == (1.0, 0.002)
    assert estimate.notes[0].startswith(
        "the rear axle follows the front axle 0.99 ± 0.39 % earlier than speed and wheelbase say"
    )


@pytest.mark.parametrize("name", ["wiener", "fir_ridge", "tcn", "tcn_causal"])
def test_an_estimate_is_that_of_the_calibrated_stations(name):
    surface = realise_road("iso_d", 3, 40.0)
    record, _ = simulate_record(surface, speed_kmh=54.0, mode="ride", seed=3)
    distance = record.s - record.s[0]
    error, length = 0.02, 10.0
    displacement = -error * length * np.expm1(-distance / length)
    displaced = replace(record, s=record.s + displacement, v=(1.0 + error) * record.v)
    estimator, car = create(name), load_vehicle("land_rover_defender_110")
    found, plain = (estimator.estimate(each, car) for each in (displaced, record))
    assert any("beside the position fixes" in note for note in found.notes)
    assert not any("beside the position fixes" in note for note in plain.notes)
    reached = 10 if name.endswith("causal") else 0  # [m], before the displacement is clear
    from_there = slice(int(reached / 0.05), None)
    error = (found.z - plain.z)[:, from_there]
    assert error.std() < 0.1 * plain.z[:, from_there].std()
