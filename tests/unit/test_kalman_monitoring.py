"""Monitoring of the Kalman filter: local and recent NIS, and heights no larger than their error."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.kalman.monitoring import (
    local_nis,
    recent_nis,
    reduce_uncertain,
    with_model_error,
)
from road_envs.records.record import profile_stations
from road_envs.vehicle.parameters import Tolerance, load_vehicle

DEFENDER = load_vehicle("land_rover_defender_110")


def test_the_local_nis_is_that_of_both_axles_and_no_later_than_the_lag():
    s, front = np.arange(0.0, 30.0, 0.025), np.arange(-5.0, 35.0, 0.05)
    nis = np.where(np.abs(front - 20.0) < 0.3, 9.0, 0.5)
    whole, lag = (local_nis(nis, front, s, lag) for lag in (np.inf, 3.0))
    assert whole.min() == lag.min() == 1.0
    assert whole.max() == lag.max() == 9.0
    for ratio, first in ((whole, 20.0 - 4.79), (lag, 20.0 - 3.0)):
        raised = s[ratio > 2.0]
        assert raised.min() == pytest.approx(first, abs=0.6)
        assert raised.max() == pytest.approx(20.5, abs=0.6)
    known_later = np.where(front > 18.0, 100.0, nis)
    before = s <= 15.0
    np.testing.assert_array_equal(local_nis(known_later, front, s, 3.0)[before], lag[before])


def test_the_recent_nis_is_the_mean_of_the_last_metres_or_blocks():
    front = np.arange(0.0, 10.0, 0.05)
    nis = np.where((front > 4.0) & (front < 5.0), 7.0, 1.0)
    recent = np.interp([3.9, 4.5, 5.0, 6.5, 7.2], front, recent_nis(nis, front, 2.0))
    np.testing.assert_allclose(recent, [1.0, 2.5, 3.8, 2.5, 1.0], atol=0.05)
    nis[30] = 21.0
    recent = recent_nis(nis, front, 0.1)[[29, 30, 49, 50]]  # 20 blocks are a metre
    np.testing.assert_allclose(recent, [1.0, 2.0, 2.0, 1.0])


def test_heights_no_larger_than_their_error_are_reduced_and_others_kept():
    s = profile_stations(60.0)
    z = np.array([np.sin(2.0 * np.pi * 0.5 * s), 0.1 * np.sin(2.0 * np.pi * 0.5 * s)])
    std = np.full(z.shape, 0.1)
    middle = (s > 10.0) & (s < 50.0)
    for drift in (0.0, 0.5 * np.sin(2.0 * np.pi * s / 60.0)):
        reduced = reduce_uncertain(z + drift, std, 1.0, drifting=True) - drift
        gain = np.linalg.norm(reduced[:, middle], axis=1) / np.linalg.norm(z[:, middle], axis=1)
        np.testing.assert_allclose(gain, [0.5 / 0.51, 0.005 / 0.015], rtol=0.05)
    behind = reduce_uncertain(z, std, 0.0, drifting=False)
    later = np.where(s > 30.0, 9.0, z)
    again = reduce_uncertain(later, std, 0.0, drifting=False)
    np.testing.assert_allclose(again[:, s <= 30.0], behind[:, s <= 30.0], rtol=1e-9)


def test_the_model_errs_by_tolerances_behind_a_station_and_with_the_accelerations():
    s = profile_stations(40.0)
    z, std, none = np.full((2, s.size), 0.02), np.full((2, s.size), 1e-3), np.zeros(s.size)
    source = {"source": "test"}
    car = replace(DEFENDER, tolerances={"m_b": Tolerance(relative=0.2, **source)})
    absent = replace(
        DEFENDER, tolerances={"variation.frame.f": Tolerance(relative=0.4, about=12.0, **source)}
    )
    np.testing.assert_allclose(
        with_model_error(std, z, none, car), np.hypot(1e-3, 1.5 * 0.2 * 0.02)
    )
    np.testing.assert_array_equal(with_model_error(std, z, none, absent), std)
    shaken = with_model_error(std, z, np.where(s < 20.0, 0.0, 4.5), absent)
    np.testing.assert_allclose(shaken, np.where(s < 20.0, std, np.sqrt(2.0) * std))
    later = with_model_error(std, np.where(s > 20.0, 5.0, z), none, car)
    before = with_model_error(std, z, none, car)
    np.testing.assert_allclose(later[:, s <= 20.0], before[:, s <= 20.0])
    forgotten = with_model_error(std, np.where(s < 20.0, 5.0, z), none, car)
    np.testing.assert_allclose(forgotten[:, s > 30.1], before[:, s > 30.1])
    assert forgotten[0, np.searchsorted(s, 29.0)] > 10.0 * before[0, 0]
