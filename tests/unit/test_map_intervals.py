"""Intervals of the maximum a posteriori road where wheels lift off."""

import numpy as np
import pytest
from scipy.fft import rfftfreq
from vehicle_fixtures import DEFENDER

from estimators import create
from estimators.map_smoother.posterior_sampling import (
    LIFTOFF_SHARE,
    band_pass,
    liftoff_variance,
)
from leaderboard.metrics.heights import band_pass as in_band
from leaderboard.metrics.heights import uncertainty
from road_envs.data.record import PROFILE_SPACING, scored_band
from road_envs.data.recording import simulate_record

DS, SIZE = 0.05, 1200


def test_the_road_below_a_lifted_wheel_is_known_to_a_share_of_the_height_about_it():
    n = rfftfreq(SIZE, DS)
    lines = (n > 0.2) & (n < 1.6)
    unloaded = np.zeros((2, SIZE), dtype=bool)
    c = np.zeros((2, SIZE))
    unloaded[0, 400:410], unloaded[0, 800:806] = True, True
    c[0, 405], c[0, 790], c[1, 405] = 0.05, -0.02, 3.0
    variance = liftoff_variance(unloaded, c, DS, lines)
    assert not variance[1].any()  # wheels on that path pressed everywhere
    for at, height in ((405, 0.05), (803, 0.02)):
        assert np.sqrt(variance[0, at]) == pytest.approx(LIFTOFF_SHARE * height, rel=0.05)
    # an error below the wheel has the envelope of a step up and down in the band
    error = band_pass(unloaded[:1].astype(float), lines)[0]
    tops = [k for k in range(380, 430) if abs(error[k]) >= abs(error[k - 10 : k + 11]).max()]
    expected = LIFTOFF_SHARE * 0.05 * abs(error[tops]) / abs(error[380:430]).max()
    np.testing.assert_allclose(np.sqrt(variance[0, tops]), expected, rtol=0.15)


def test_intervals_are_wide_where_wheels_fly_and_narrow_elsewhere():
    record, truth = simulate_record(
        "random_bumps", speed_kmh=54.0, mode="ride", seed=211, length=60.0, step=5e-4
    )
    estimate = create("map_smoother").estimate(record, DEFENDER)
    assert any("in the air" in note for note in estimate.notes)
    y, a = in_band(np.stack([truth.z, estimate.z]), PROFILE_SPACING, scored_band(15.0))
    scores = uncertainty(y, a, estimate.z_std)
    assert 0.3 < scores.coverage_50 < 0.8
    assert scores.coverage_90 > 0.75
    assert estimate.z_std.max() > 10.0 * np.median(estimate.z_std)
