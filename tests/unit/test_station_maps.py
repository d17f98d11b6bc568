"""Stations of one odometer are mapped to those of another by the profiles that both have seen."""

import numpy as np
import pytest

from estimators.common.alignment import StationMap, identity_map, map_stations
from road_envs.records.record import PROFILE_SPACING, profile_stations
from road_envs.roads import realise_road

BAND = (0.2, 1.5)
ROAD = realise_road("iso_c", 4, 300.0)


def noisy(z, seed):
    """Heights with errors of a fifth of those of the road in the band."""
    return z + 0.0006 * np.random.default_rng(seed).standard_normal(z.shape)


@pytest.mark.parametrize("stretch", [0.0, 0.01, -0.0063])
@pytest.mark.parametrize("lag", [0.0, -4.37, 21.6])
def test_lag_and_scale_of_the_odometer_are_found_within_two_centimetres(lag, stretch):
    reference, own = profile_stations(120.0), profile_stations(100.0)
    true = 60.0 + lag + (1.0 + stretch) * own
    found, matches = map_stations(
        noisy(ROAD.height(60.0 + reference), 1), noisy(ROAD.height(true), 2), PROFILE_SPACING, BAND
    )
    assert matches and found.correlation > 0.8
    seen = (true - 60.0 > 5.0) & (true - 60.0 < 115.0) & (own > 5.0) & (own < 95.0)
    assert np.abs(found.apply(own) - (true - 60.0))[seen].max() < 0.02
    assert found.scale(own).mean() == pytest.approx(1.0 + stretch, abs=1e-3)
    np.testing.assert_allclose(found.inverse().apply(found.apply(own)), own, atol=1e-9)


def test_an_odometer_that_position_fixes_pull_back_is_followed():
    s = profile_stations(100.0)
    true = s + 0.25 * (1.0 - np.exp(-s / 30.0))
    z = (noisy(ROAD.height(60.0 + x), k) for k, x in enumerate((s, true)))
    found, matches = map_stations(*z, PROFILE_SPACING, BAND)
    assert matches
    assert np.abs(found.apply(s) - true)[400:-400].max() < 0.03


def test_on_a_long_road_the_windows_follow_an_odometer_whose_scale_changes():
    long, s = realise_road("iso_c", 5, 1300.0), profile_stations(1200.0)
    true = 1.006 * s + 4.0 * np.sin(s / 400.0)
    z = (noisy(long.height(20.0 + x), k) for k, x in enumerate((s, true)))
    found, matches = map_stations(*z, PROFILE_SPACING, BAND)
    assert matches
    error = found.apply(s) - true
    assert np.abs(error[(true > 10.0) & (true < 1160.0)]).max() < 0.03


def test_another_road_does_not_match_at_any_lag_or_scale():
    s = profile_stations(100.0)
    for seed in range(20, 26):
        other = realise_road("iso_c", seed, 120.0)
        _, matches = map_stations(ROAD.height(s), other.height(s), PROFILE_SPACING, BAND)
        assert not matches
        _, matches = map_stations(ROAD.height(s), ROAD.height(s)[::-1, ::-1], PROFILE_SPACING, BAND)
        assert not matches


def test_a_map_goes_on_beyond_its_ends():
    one = StationMap(np.array([0.0, 10.0, 20.0]), np.array([5.0, 15.0, 26.0]))
    np.testing.assert_allclose(one.apply(np.array([-1.0, 5.0, 30.0])), [4.0, 10.0, 37.0])
    np.testing.assert_allclose(one.scale(np.array([-1.0, 12.0])), [1.0, 1.1])
    assert one.lag == pytest.approx(16.0 / 3.0) and one.stretch == pytest.approx(0.05)


def test_profiles_that_are_too_short_are_refused():
    s = profile_stations(20.0)
    with pytest.raises(ValueError, match=r"20.0 m are too short to be aligned: at least 30 m"):
        map_stations(ROAD.height(s), ROAD.height(s), PROFILE_SPACING, BAND)


@pytest.mark.parametrize("length", np.random.default_rng(0).uniform(50.0, 400.0, 8))
def test_the_ends_of_a_road_are_mapped_to_themselves_to_the_last_bit(length):
    s = np.append(np.arange(0.0, length, 0.05), length)
    np.testing.assert_array_equal(identity_map(length).inverse().apply(s), s)
