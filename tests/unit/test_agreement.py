"""Measures of agreement against published examples and closed forms."""

import numpy as np
import pytest

from leaderboard.metrics.agreement import (
    bland_altman,
    intraclass_correlation,
    iri_filtered_correlation,
    repeatability,
)
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.registry import compute_scores
from road_envs.records.record import PROFILE_SPACING, Estimate, Profile, profile_stations
from road_envs.records.roughness import iri
from road_envs.roads import realise_road

RATINGS = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
"""Shrout & Fleiss (1979), table 2: six targets, four judges."""


def road(name="iso_c", seed=1, length=200.0):
    return realise_road(name, seed, length).height(profile_stations(length))


def test_icc_of_the_published_example():
    assert intraclass_correlation(RATINGS) == pytest.approx(0.29, abs=0.005)  # table 4
    assert intraclass_correlation(np.outer(np.arange(5.0), [1.0, 1.0])) == pytest.approx(1.0)
    assert np.isnan(intraclass_correlation([[1.0, 2.0]]))


def test_icc_recovers_the_ratio_of_variances():
    rng = np.random.default_rng(1)
    true, passes = rng.standard_normal((4000, 1)), 0.2 * rng.standard_normal((1, 300))
    x = true + passes + 0.5 * rng.standard_normal((4000, 300))
    assert intraclass_correlation(x) == pytest.approx(1.0 / (1.0 + 0.04 + 0.25), abs=0.02)
    assert repeatability(x - passes) == pytest.approx(0.5, rel=0.01)


def test_limits_of_agreement_contain_95_percent_of_the_differences():
    rng = np.random.default_rng(2)
    y = rng.uniform(1.0, 5.0, 20_000)
    x = y + 0.3 + 0.1 * rng.standard_normal(y.size)
    found = bland_altman(x, y)
    assert found.bias == pytest.approx(0.3, abs=0.01)
    inside = (x - y > found.lower) & (x - y < found.upper)
    assert inside.mean() == pytest.approx(0.95, abs=0.005)
    assert np.isnan(bland_altman(np.array([1.0]), np.array([2.0])).lower)


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.0, 1.25])
def test_the_correlation_of_a_scaled_profile_is_the_smaller_ratio(factor):
    z = road()[0]
    expected = min(factor, 1.0 / factor)
    assert iri_filtered_correlation(z, factor * z, PROFILE_SPACING) == pytest.approx(expected)


def test_the_correlation_finds_small_shifts_and_sees_noise_and_other_roads():
    z, ds = road()[0], PROFILE_SPACING
    assert iri_filtered_correlation(z[20:-20], z[:-40], ds) > 0.98  # 0.5 m
    assert iri_filtered_correlation(z[200:-200], z[:-400], ds) < 0.8  # 5 m
    assert iri_filtered_correlation(z, road(seed=9)[0], ds) < 0.4
    # uncorrelated roughness of equal power: <PQ> / max² = 1 / 2
    noisy = z + road(seed=9)[0]
    assert iri_filtered_correlation(z, noisy, ds) == pytest.approx(0.5, abs=0.15)
    assert np.isnan(iri_filtered_correlation(z, 0.0 * z, ds))


def test_the_metrics_of_an_estimate_that_is_ten_percent_too_high():
    z = road("iso_d", length=300.0)
    s = profile_stations(300.0)
    scores = compute_scores(ScoredEstimate(Profile(s, z), Estimate(s, 1.1 * z), 15.0, bumps=False))
    assert scores["iri_cross_correlation"] == pytest.approx(1.0 / 1.1)
    assert scores["iri_bias"] == pytest.approx(scores["iri_rmse"], rel=0.01)
    assert scores["iri_error"] == pytest.approx(scores["iri_bias"], rel=0.05)
    short = iri(z, PROFILE_SPACING, segment=20.0).ravel()  # differences are a tenth of these
    spread = 0.196 * short.std(ddof=1)
    assert scores["iri_lower_limit"] == pytest.approx(0.1 * short.mean() - spread, rel=1e-6)
    assert scores["iri_upper_limit"] == pytest.approx(0.1 * short.mean() + spread, rel=1e-6)
    assert scores["iri_icc"] == pytest.approx(
        intraclass_correlation(np.stack([short, 1.1 * short], axis=1))
    )
    assert 0.5 < scores["iri_icc"] < 1.0
