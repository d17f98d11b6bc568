"""Stretches that no sensor has read: what is said of them, and that they do not narrow the rest."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from estimators import estimate
from estimators.common.gaps import mark_gaps, read_share, unread_stations
from road_envs import simulate_record
from road_envs.records.record import Estimate, Record

GAP = (55.0, 90.0)  # [m]


@pytest.fixture(scope="module")
def drive():
    """A drive over a road of class C at 54 km/h, and its true profile."""
    road = {"kind": "iso8608", "road_class": "C", "length": 140.0}
    return simulate_record(road, speed_kmh=54, seed=77)


def with_gap(record: Record) -> Record:
    lost = (record.s > GAP[0]) & (record.s < GAP[1])
    return replace(record, a=np.where(lost, np.nan, record.a))


def without_rows(record: Record) -> Record:
    kept = (record.s < GAP[0]) | (record.s > GAP[1])
    names = ("t", "v", "s", "spring_stiff", "damper_high")
    parts = {name: getattr(record, name)[kept] for name in names}
    return replace(record, a=record.a[:, kept], **parts)


def in_band(z: np.ndarray, ds: float) -> np.ndarray:
    band = butter(4, (0.2, 1.8), "bandpass", fs=1.0 / ds, output="sos")
    return sosfiltfilt(band, z, axis=1)


@pytest.mark.parametrize("name", ["map_smoother", "wiener", "kalman_rts"])
@pytest.mark.costly
def test_what_was_not_read_is_not_known_and_the_rest_is_known_as_before(drive, name):
    record, truth = drive
    whole, holed = estimate(name, record), estimate(name, with_gap(record))
    true = np.array([np.interp(whole.s, truth.s, z) for z in truth.z])
    level = np.std(in_band(true, whole.ds))
    error = in_band(holed.z - true, whole.ds)
    gap = (holed.s > GAP[0] + 3.0) & (holed.s < GAP[1] - 5.0)
    apart = (holed.s < GAP[0] - 10.0) | (holed.s > GAP[1] + 10.0)
    assert np.std(error[:, gap]) > 0.8 * level  # nothing tells it
    assert 0.6 < np.mean(holed.z_std[:, gap]) / level < 1.8
    assert np.mean(np.abs(error[:, gap]) < 1.645 * holed.z_std[:, gap]) > 0.75
    assert holed.z_std[:, apart].mean() == pytest.approx(whole.z_std[:, apart].mean(), rel=0.3)
    assert "no sensor was read over 3" in holed.notes[0] and "not known" in holed.notes[0]
    assert holed.unsure[gap].all() and not holed.unsure[apart].any()
    if holed.draws is not None:
        draws = np.array([in_band(road, whole.ds) for road in holed.draws.astype(float)])
        spread = (draws - in_band(holed.z, whole.ds)).std(axis=(0, 1))
        assert 0.6 < spread[gap].mean() / level < 1.8
        assert spread[apart].mean() < 0.4 * level


def test_rows_that_are_not_there_are_a_gap_like_rows_without_values(drive):
    record = drive[0]
    stations = np.arange(0.0, 140.0, 0.5)
    empty, absent = (unread_stations(stations, f(record), 2.6) for f in (with_gap, without_rows))
    assert np.count_nonzero(absent != empty) <= 1
    # the rear axle passes the first metres of the gap when sensors are read again
    np.testing.assert_allclose(stations[empty][[0, -1]], [GAP[0], GAP[1] - 2.6], atol=0.6)


def test_a_station_is_read_by_either_axle():
    s = np.arange(0.0, 10.0, 0.1)
    read = np.where((s > 4.0) & (s < 6.0), 0.0, 1.0)
    np.testing.assert_array_equal(read_share(np.arange(10.0), s, read, 3.0), 1.0)
    assert read_share(np.array([5.0]), s, read, 0.5) == 0.0
    assert read_share(np.array([-3.0, 20.0]), s, read, 3.0).tolist() == [1.0, 1.0]


def test_single_lost_samples_are_no_gap(drive):
    record = drive[0]
    lost = np.random.default_rng(0).random(record.t.size) < 0.05
    record = replace(record, a=np.where(lost, np.nan, record.a))
    flat = Estimate(np.arange(0.0, 140.0, 0.05), np.zeros((2, 2800)))
    assert mark_gaps(flat, record, 2.6) is flat
