"""An estimate is moved onto the truth by the lag of their largest correlation, or refused."""

import numpy as np
import pytest

from leaderboard.metrics.alignment import align
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.registry import compute_scores
from road_envs.core.config import ConfigError
from road_envs.records.record import PROFILE_SPACING, Estimate, Profile, profile_stations
from road_envs.roads import Surface, realise_road
from road_envs.sensing.perturbed_vehicle import load_plant_mismatch

ROAD = realise_road("iso_c", 4, 200.0)
NOISE = 0.0005 * np.random.default_rng(0).standard_normal((2, 10_000))


def estimate(begin, length, shift=0.0):
    """The road from station `begin`, with stations that are wrong by `shift` [m]."""
    s = profile_stations(length)
    z = ROAD.height(s + begin + shift) + NOISE[:, : s.size]
    return Estimate(s, z, np.ones((2, s.size)))


@pytest.mark.parametrize("shift", [0.0, 7.8, -3.3, 31.0])
@pytest.mark.parametrize("chainage", [20.0, 60.0])
def test_the_lag_and_the_heights_of_the_overlap_are_found(chainage, shift):
    found = align(ROAD, estimate(chainage, 90.0, shift), 10.0, chainage)
    assert found.lag == pytest.approx(shift, abs=PROFILE_SPACING)
    assert found.correlation > 0.9
    if shift:
        assert found.correlation_before < 0.5
    assert found.estimate.z.shape == found.truth.z.shape == found.estimate.z_std.shape
    size = found.truth.z.shape[1]
    # a grid cell off at most, and the noise
    assert np.std(found.truth.z - found.estimate.z) < 0.002
    assert size * PROFILE_SPACING == pytest.approx(min(90.0, 200.0 - chainage - shift), abs=0.1)


def test_only_the_overlap_is_used():
    before = align(ROAD, estimate(-30.0, 90.0), 10.0, -30.0)
    assert before.truth.z.shape[1] * PROFILE_SPACING == pytest.approx(60.0, abs=0.1)
    np.testing.assert_allclose(
        before.truth.z[:, 100], ROAD.height(PROFILE_SPACING * 101), atol=1e-3
    )


def test_another_road_matches_nowhere():
    for seed in range(10, 18):  # the shorter, the larger a correlation by chance
        with pytest.raises(ConfigError, match="at no lag within 50 m"):
            align(realise_road("iso_c", seed, 200.0), estimate(0.0, 31.0), 10.0)
    other = realise_road("iso_c", 5, 200.0)
    for length in (40.0, 90.0, 180.0):
        with pytest.raises(ConfigError, match="at no lag within 50 m"):
            align(other, estimate(0.0, length), 10.0)


def test_too_short_and_far_away_drives_are_refused():
    with pytest.raises(ConfigError, match="too short to be aligned"):
        align(ROAD, estimate(0.0, 20.0), 10.0)
    with pytest.raises(ConfigError, match="do not overlap within 50 m"):
        align(ROAD, estimate(0.0, 90.0), 10.0, 5000.0)
    with pytest.raises(ConfigError, match="too short"):
        align(Surface(ROAD.z[:, :100], ROAD.ds), estimate(0.0, 90.0), 10.0)


def local_scores(shift, wandering=True):
    """Return the scores of the road read at stations that are wrong by `shift` (M,) [m]."""
    s = profile_stations(180.0)
    truth = Profile(s, ROAD.height(s + 10.0))
    found = Estimate(s, ROAD.height(s + 10.0 + shift(s)), 0.0003 * np.ones((2, s.size)))
    return compute_scores(ScoredEstimate(truth, found, 10.0, bumps=False, wandering=wandering))


def test_an_estimate_whose_stations_wander_by_a_metre_is_right_after_local_alignment():
    def wander(s):
        return 1.0 + np.interp(s, [0.0, 50.0, 110.0, 180.0], [0.0, 0.7, -0.5, 0.4])

    found = local_scores(wander)
    assert found["nrmse"] > 1.0 and found["coverage_90"] < 0.3
    assert found["nrmse_aligned"] < 0.1 and found["coverage_90_aligned"] > 0.85
    assert np.isnan(local_scores(wander, wandering=False)["nrmse_aligned"])


def test_a_delay_is_taken_back_as_far_as_the_worst_receiver_errs():
    """Three standard deviations: a longer one is the estimator's own."""
    farthest = 3.0 * load_plant_mismatch().instruments.position_noise[1]
    assert local_scores(lambda s: farthest - 1.0 + 0.0 * s)["nrmse_aligned"] < 0.1
    found = local_scores(lambda s: farthest + 1.0 + 0.0 * s)
    assert found["nrmse_aligned"] == found["nrmse"] > 1.0


def test_an_estimate_that_matches_nowhere_is_scored_as_it_is():
    s = profile_stations(180.0)
    truth, other = ROAD.height(s), realise_road("iso_c", 9, 200.0).height(s)
    for z in (other, 0.0 * s * np.ones((2, 1))):
        found = compute_scores(
            ScoredEstimate(Profile(s, truth), Estimate(s, z), 10.0, bumps=False, wandering=True)
        )
        assert found["nrmse_aligned"] == found["nrmse"]
