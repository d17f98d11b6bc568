"""Calibration of the odometer against its position fixes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from estimators import create
from estimators.api import check_estimate
from estimators.common.odometer import (
    WANDER_NOTE,
    Odometer,
    calibrate_odometer,
    to_true_distance,
)
from estimators.estimation import estimate
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.registry import compute_scores
from road_envs.drives.recording import simulate_record
from road_envs.records.record import DistanceScale, Estimate, Record, profile_stations
from road_envs.roads import realise_road
from road_envs.sensing.data_logger import DataLogger, load_instruments
from road_envs.sensing.sensor_faults import SensorFaults
from road_envs.vehicle.parameters import load_vehicle

FS, DURATION = 200.0, 8.0
CAR = load_vehicle("land_rover_defender_110")


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
    calibrated, notes, *_ = calibrate_odometer(record)
    assert np.abs(record.s - s).max() > 0.1
    np.testing.assert_allclose(calibrated.s, s, atol=2e-3)
    np.testing.assert_allclose(calibrated.v, true_speed(record.t), rtol=1e-4)
    assert notes[0].startswith(f"the speed signal reads {100.0 * error:+.1f} % beside")
    assert calibrate_odometer(calibrated) == Odometer(calibrated)


@pytest.mark.parametrize("length, noise", [(1e9, 0.0), (1e-3, 0.0), (10.0, 0.3)])
@pytest.mark.costly
def test_an_odometer_without_fixes_with_immediate_or_with_noisy_ones_is_left_alone(length, noise):
    record, _ = drive(0.02, length, noise)
    assert calibrate_odometer(record)[0] is record


def test_fixes_with_some_noise_leave_centimetres():
    record, s = drive(0.02, 10.0, 0.01)
    calibrated = calibrate_odometer(record).record
    assert np.abs(calibrated.s - s).max() < 0.2 * np.abs(record.s - s).max() + 4.0 * 0.01


def test_a_record_with_lost_speeds_is_left_alone():
    record, _ = drive(0.02, 10.0)
    lost = replace(record, v=np.where(record.t > 7.0, np.nan, record.v))
    assert calibrate_odometer(lost) == Odometer(lost)


@pytest.mark.parametrize("error, length", [(0.02, 10.0), (-0.015, 10.0), (0.05, 4.0), (0.01, 30.0)])
def test_online_the_displacement_is_found_from_the_samples_before_alone(error, length):
    record, s = drive(error, length)
    calibrated, notes, *_ = calibrate_odometer(record, causal=True)
    assert (np.abs(calibrated.s - s) <= np.abs(record.s - s) + 2e-3).all()
    np.testing.assert_allclose(calibrated.s[400:], s[400:], atol=3e-3)
    assert notes[0].startswith(f"the speed signal reads {100.0 * error:+.1f} % beside")
    half = slice(0, record.t.size // 2)
    first = replace(record, **{name: getattr(record, name)[half] for name in ("t", "v", "s")})
    before = calibrate_odometer(first, causal=True).record
    np.testing.assert_array_equal(before.s, calibrated.s[half])
    np.testing.assert_array_equal(before.v, calibrated.v[half])


@pytest.mark.parametrize("length, noise", [(1e9, 0.0), (1e-3, 0.0), (10.0, 0.3)])
@pytest.mark.costly
def test_online_an_unclear_displacement_is_left_alone(length, noise):
    record, _ = drive(0.02, length, noise)
    assert calibrate_odometer(record, causal=True)[0] is record


def wandering(seed, noise=None, speed_kmh=54.0):
    """Return the record of a drive whose fixes wander by 1 to 3 m, without accelerations, and the
    true stations.
    """
    rng = np.random.default_rng((seed, 1))
    std, error = (rng.uniform(1.0, 3.0) if noise is None else noise), rng.uniform(-0.02, 0.02)
    faults = SensorFaults(speed=error, position_fix_length=10.0, position_noise=std)
    logger = DataLogger(load_instruments("paper"), CAR, 0.001, np.random.default_rng(seed), faults)
    t, v = np.arange(0.0, 310.0 / (speed_kmh / 3.6), 1.0 / logger.fs), speed_kmh / 3.6
    s, states = -10.0 + v * t, np.zeros((t.size, 4), dtype=bool)
    speed = np.full(t.size, logger.speed_gain * v)
    read = -10.0 + logger.odometer(v * t)
    return Record(t, np.zeros((3, t.size)), speed, read, states, states, 300.0), s


@pytest.mark.costly
def test_stations_beside_fixes_that_wander_are_within_their_deviation():
    inside, errors = [], []
    for seed in range(40):
        record, s = wandering(seed)
        found, notes, std, _ = calibrate_odometer(record)
        assert std is not None and notes == (WANDER_NOTE.format(std),)
        error = found.s - s
        inside.append(np.mean(np.abs(error) < 1.645 * std))
        errors.append([np.abs(np.diff(x)).mean() for x in (error, record.s - s)])
        assert calibrate_odometer(found) == Odometer(found)  # the stations follow the speed
    assert 0.8 < np.mean(inside) < 0.97
    smooth, raw = np.mean(errors, axis=0)
    assert smooth < 0.4 * raw


def test_online_stations_follow_the_speed_once_fixes_wander():
    record, s = wandering(3, 2.0)
    found, notes, *_ = calibrate_odometer(record, causal=True)
    assert "stations are uncertain by ±" in notes[0]
    late = s > 40.0
    np.testing.assert_allclose(np.diff(found.s[late]), record.v[late][1:] / 1000.0, rtol=1e-6)
    half = slice(0, record.t.size // 2)
    first = replace(record, **{name: getattr(record, name)[half] for name in ("t", "v", "s")})
    np.testing.assert_array_equal(calibrate_odometer(first, causal=True)[0].s, found.s[half])


def test_fixes_that_do_not_wander_leave_no_deviation():
    for record in (wandering(1, 0.0)[0], *(drive(0.02, *x)[0] for x in ((10.0, 0.3), (1e9, 0.0)))):
        for causal in (True, False):
            assert calibrate_odometer(record, causal).s_std is None


@pytest.mark.parametrize("name", ["wiener", "kalman_rts"])
@pytest.mark.costly
def test_heights_beside_fixes_that_wander_are_right_after_alignment(name):
    record, truth = simulate_record("iso_d", speed_kmh=54.0, mode="handling", seed=7, length=150.0)
    errors = []
    for noise in (0.0, 2.0):
        faults = SensorFaults(speed=0.004, position_fix_length=10.0, position_noise=noise)
        rng = np.random.default_rng(2)
        logger = DataLogger(load_instruments("paper"), CAR, 0.001, rng, faults)
        read = record.s[0] + logger.odometer(record.s - record.s[0])
        found = estimate(name, replace(record, s=read, v=logger.speed_gain * record.v), CAR)
        assert (found.s_std is not None) == (noise > 0.0)
        assert any("stations are uncertain" in note for note in found.notes) == (noise > 0.0)
        scored = ScoredEstimate(truth, found, 15.0, bumps=False, wandering=True)
        errors.append(compute_scores(scored)["nrmse_aligned"])
    assert errors[1] < 1.3 * errors[0]


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
@pytest.mark.costly
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
