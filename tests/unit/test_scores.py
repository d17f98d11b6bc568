"""Scores and their statistics against independent implementations, on stored cases."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import oracles_scores as oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from leaderboard.metrics import bootstrap as statistics
from leaderboard.metrics import heights, roughness
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.bootstrap import (
    bootstrap,
    count_roads,
    interquartile_mean,
    iqm_interval,
    iqm_slope,
    performance_profile,
    rank_entries,
)
from leaderboard.metrics.obstacles import detect_obstacles, true_obstacles
from leaderboard.metrics.registry import SCORES, compute_scores
from road_envs.records.record import PROFILE_SPACING, Estimate, Profile, profile_stations

STORED = Path(__file__).parents[1] / "data" / "scores.json"
CASES = {"late": 1, "quiet": 2, "loud": 3}
SPEEDS = {"late": 14.5 / 3.6, "quiet": 30.0 / 3.6, "loud": 15.0}
SETTINGS = {"late": {}, "quiet": {"share": 0.3, "noise": 0.0005}, "loud": {"noise": 0.03}}


@cache
def case(name):
    return oracle.case(CASES[name], **SETTINGS[name])


@cache
def found(name):
    y, a, sigma, ds = case(name)
    s = ds * np.arange(y.shape[1])
    return compute_scores(
        ScoredEstimate(Profile(s, y), Estimate(s, a, sigma), SPEEDS[name], bumps=True)
    )


def expected(name):
    """Return the same scores by independent implementations of their definitions."""
    y, a, sigma, ds = case(name)
    v = SPEEDS[name]
    band = (0.2, min(1.8, 0.9 * 25.0 / v))
    e = np.array([oracle.in_band(a[i] - y[i], ds, *band) for i in range(2)])
    trim = (y.shape[1] - e.shape[1]) // 2
    sigma = sigma[:, trim : trim + e.shape[1]]
    thin = (slice(None), slice(0, None, 400))  # quadrature is slow: use a sample of the errors
    r, lag, r_at_lag = oracle.pearson(y, a, ds, *band)
    distance, bias = oracle.dsd_distance(y, a, ds, *band)
    octaves = [n for n in (0.25, 0.5, 1.0, 2.0) if n * np.sqrt(2.0) <= 22.5 / v]
    steps = {
        n: np.subtract(oracle.octave_classes(a, ds, n), oracle.octave_classes(y, ds, n))
        for n in octaves
    }
    all_steps = np.concatenate(list(steps.values()))
    return {
        "nrmse": oracle.error_over_truth(y, a, ds, *band),
        "nrmse_at_lag": oracle.error_at_best_lag(y, a, ds, *band),
        "nrmse_full": oracle.error_over_truth(y, a, ds, 0.05, 3.0),
        "r": r,
        "lag": lag,
        "r_at_lag": r_at_lag,
        "coherence": oracle.coherence(y, a, ds, *band),
        "level_bias": oracle.level_error(y, a),
        "dsd_distance_db": distance,
        "dsd_bias_db": bias,
        "class_exact": np.mean(all_steps == 0),
        "class_within_one": np.mean(np.abs(all_steps) <= 1),
        **{
            f"class_exact_{n:g}": np.mean(steps[n] == 0) if n in steps else np.nan
            for n in (0.25, 0.5, 1.0, 2.0)
        },
        "error_at_0.5": oracle.error_at(y, a, ds, 0.5),
        "error_at_1.26": oracle.error_at(y, a, ds, 2.0 ** (1 / 3)),
        "coverage_50": oracle.coverage(e, sigma, 0.5),
        "coverage_90": oracle.coverage(e, sigma, 0.9),
        "crps of a sample": np.mean(np.vectorize(oracle.crps)(e[thin], sigma[thin])),
    }


@pytest.mark.parametrize("name", CASES)
@pytest.mark.costly
def test_scores_equal_an_independent_implementation(name):
    y, a, sigma, ds = case(name)
    mine = dict(found(name))
    band = heights.scored_band(SPEEDS[name])
    e = heights.band_pass(a - y, ds, band)
    trim = (y.shape[1] - e.shape[1]) // 2
    sigma = sigma[:, trim : trim + e.shape[1]]
    thin = e[:, ::400]
    mine["crps of a sample"] = heights.uncertainty(0.0 * thin, thin, sigma[:, ::400]).crps
    for score, value in expected(name).items():
        assert mine[score] == pytest.approx(value, rel=1e-6, abs=1e-9, nan_ok=True), score


@pytest.mark.parametrize("name", CASES)
def test_scores_of_the_stored_cases_are_unchanged(name):
    """After an intended change, raise `heights.VERSION` and write the file anew."""
    stored = json.loads(STORED.read_text())
    assert stored["metrics"] == heights.VERSION
    assert stored[name].keys() == {k for k, x in found(name).items() if np.isfinite(x)}
    for score, value in stored[name].items():
        assert found(name)[score] == pytest.approx(value, rel=1e-6, abs=1e-9), score


def test_every_score_has_a_format():
    assert found("late").keys() == SCORES.keys() - {"attainable_nrmse", "attainable_efficiency"}
    assert all(score.label and score.help for score in SCORES.values())
    assert (
        SCORES["crps"].format_value(0.00123) == "1.23"
        and SCORES["level_bias"].format_value(0.1) == "+10.0"
    )


# --- uncertainty ----------------------------------------------------------------------------------


def noise(seed, level, length=300.0):
    """Return white noise (2, M) with RMS `level` inside the band."""
    e = np.random.default_rng(seed).standard_normal((2, profile_stations(length).size))
    inside = heights.band_pass(e, PROFILE_SPACING, (0.2, 1.8))
    return level * e / np.sqrt(np.mean(inside**2))


def uncertainty(e, sigma):
    inside = heights.band_pass(np.stack([0.0 * e, e]), PROFILE_SPACING, (0.2, 1.8))
    return heights.uncertainty(*inside, sigma)


@pytest.mark.parametrize(("factor", "share_50", "share_90"), [(1.0, 0.5, 0.9), (0.5, 0.264, 0.589)])
def test_intervals_cover_their_nominal_share_only_with_the_true_deviation(
    factor, share_50, share_90
):
    # P(|x| < k z) of a normal x with k = 0.5: 2 Phi(0.5 x 0.674) - 1 and 2 Phi(0.5 x 1.645) - 1
    e = noise(1, 0.01)
    sigma = np.full_like(e, 0.01 * factor)
    found = uncertainty(e, sigma)
    assert found.coverage_50 == pytest.approx(share_50, abs=0.05)
    assert found.coverage_90 == pytest.approx(share_90, abs=0.05)


@given(factor=st.floats(0.2, 5.0))
@settings(max_examples=10)
def test_the_true_deviation_minimises_the_crps(factor):
    e = noise(2, 0.01)
    true, other = (uncertainty(e, np.full_like(e, x)).crps for x in (0.01, 0.01 * factor))
    assert true <= other * (1.0 + 1e-3)


def test_the_crps_of_a_zero_deviation_is_the_mean_absolute_error():
    e = noise(3, 0.01)
    found = uncertainty(e, np.zeros_like(e))
    assert found.crps == pytest.approx(
        np.mean(np.abs(heights.band_pass(e, PROFILE_SPACING, (0.2, 1.8))))
    )
    assert found.coverage_50 == found.coverage_90 == 0.0


def test_an_estimate_without_a_deviation_has_no_uncertainty_scores():
    y, a, _, ds = case("late")
    s = ds * np.arange(y.shape[1])
    scores = compute_scores(ScoredEstimate(Profile(s, y), Estimate(s, a), 4.0, bumps=False))
    assert np.isnan([scores[name] for name in ("crps", "coverage_50", "coverage_90")]).all()


# --- over spatial frequency, and obstacles --------------------------------------------------------


def test_the_third_octave_error_is_largest_at_the_frequency_of_an_added_sine():
    y, _, _, ds = case("late")
    s = ds * np.arange(y.shape[1])
    a = y + 0.002 * np.sin(2.0 * np.pi * 1.26 * s)

    def errors(z):
        scores = compute_scores(ScoredEstimate(Profile(s, y), Estimate(s, z), 4.0, bumps=False))
        return [x for name, x in scores.items() if name.startswith("error_at_")]

    error = errors(a)
    assert int(np.argmax(error)) == list(np.round(roughness.THIRD_OCTAVES, 2)).index(1.26)
    assert error[0] < 0.01 < 0.2 < max(error)
    assert errors(0.0 * y) == pytest.approx([1.0] * len(roughness.THIRD_OCTAVES))


def level_road(*blocks):
    s = profile_stations(60.0)
    z = np.zeros((2, s.size))
    for side, start, end, height in blocks:
        z[side, (start <= s) & (s <= end)] = height
    return z


def obstacle_scores(y, a):
    s = PROFILE_SPACING * np.arange(y.shape[1])
    scored = ScoredEstimate(Profile(s, y), Estimate(s, a), 4.0, bumps=True)
    return {key: x.compute(scored) for key, x in SCORES.items() if key.startswith("bump_")}


def test_a_hole_does_not_match_a_bump():
    y = level_road((0, 20.0, 20.8, -0.06), (1, 30.0, 30.8, 0.1))
    (hole,), (bump,) = true_obstacles(y, PROFILE_SPACING)
    assert hole.height == -0.06 and bump.height == 0.1
    assert hole.s == pytest.approx(20.4, abs=PROFILE_SPACING)
    assert list(obstacle_scores(y, y).values())[:3] == [1.0, 1.0, 1.0]
    upside_down = obstacle_scores(y, -y)
    assert upside_down["bump_f1"] == upside_down["bump_wrong_side"] == 0.0
    deep = obstacle_scores(y, 0.9 * y)
    assert deep["bump_height_error"] == pytest.approx(0.008)
    assert deep["bump_height_error_relative"] == pytest.approx(0.1)


def test_an_uneven_road_has_no_obstacles():
    y = level_road((0, 20.0, 20.8, 0.1)) + case("late")[0][:, : profile_stations(60.0).size] * 4.0
    assert np.isnan(list(obstacle_scores(y, y).values())).all()
    assert detect_obstacles(y[0], PROFILE_SPACING, 0.02)


# --- statistics -----------------------------------------------------------------------------------


@given(st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=30))
@settings(max_examples=50)
def test_the_interquartile_mean_is_the_mean_of_the_middle_quantiles(x):
    assert interquartile_mean(np.array(x)) == pytest.approx(oracle.interquartile_mean(x), abs=1e-9)


def test_with_one_seed_the_interval_equals_that_of_scipys_bootstrap():
    roads = np.random.default_rng(1).gamma(2.0, size=25)
    mine = iqm_interval(roads[:, None, None])
    theirs = stats.bootstrap(
        (roads,),
        oracle.interquartile_mean,
        vectorized=False,
        n_resamples=2000,
        method="percentile",
        rng=np.random.default_rng(2),
    ).confidence_interval
    width = theirs.high - theirs.low
    assert mine.low == pytest.approx(theirs.low, abs=0.1 * width)
    assert mine.high == pytest.approx(theirs.high, abs=0.1 * width)


def test_replicates_are_distributed_as_in_a_loop_over_roads_and_seeds():
    rng = np.random.default_rng(3)
    road, seed = rng.standard_normal((8, 1, 1)), rng.standard_normal((1, 1, 4))
    scores = road + 0.5 * seed + 0.2 * rng.standard_normal((8, 3, 4))
    mine, brute = bootstrap(scores, 0, 4000), oracle.hierarchical(scores, 4000, rng)
    assert mine.mean() == pytest.approx(brute.mean(), abs=0.03)
    assert np.quantile(mine, [0.025, 0.5, 0.975]) == pytest.approx(
        np.quantile(brute, [0.025, 0.5, 0.975]), abs=0.12
    )
    assert np.std(mine) == pytest.approx(np.std(brute), rel=0.06)


def test_replicates_do_not_depend_on_the_batch_size(monkeypatch):
    scores = np.random.default_rng(4).standard_normal((6, 2, 3))
    whole = bootstrap(scores, 0)
    monkeypatch.setattr(statistics, "MAX_BATCH_SCORES", 100)
    np.testing.assert_allclose(bootstrap(scores, 0), whole, rtol=0.0, atol=1e-12)


def test_a_rank_is_the_place_by_how_many_entries_are_significantly_better():
    rng = np.random.default_rng(13)
    road = rng.standard_normal((12, 2, 1))
    scores = {
        f"entry {k}": road + 0.12 * k + 0.3 * rng.standard_normal((12, 2, 3))
        for k in (3, 0, 5, 1, 4, 2)
    }
    drawn = {name: bootstrap(x.reshape(12, 6, 1), 0) for name, x in scores.items()}  # roads alone
    better = {
        name: sum(np.quantile(drawn[x] - drawn[name], 0.975) < 0.0 for x in drawn) for name in drawn
    }
    means = {name: oracle.interquartile_mean(x.ravel()) for name, x in scores.items()}
    found = rank_entries(scores)
    assert list(found) == sorted(found, key=lambda name: (better[name], means[name]))
    for name, rank in found.items():
        assert rank == 1 + sum(better[other] < better[name] for other in found)
    assert any(rank != 1 + better[name] for name, rank in found.items())


def test_an_entry_that_gives_up_some_drives_for_a_better_mean_lifts_nobody():
    rng = np.random.default_rng(6)
    road = 1.0 + 0.1 * rng.uniform(size=(12, 1, 1))
    honest = {name: error * road for name, error in (("best", 1.0), ("next", 1.3), ("last", 2.0))}
    spoiler = 0.6 * road
    spoiler[rng.permutation(12)[:2]] *= 1000.0  # outside the interquartile mean, not of replicates
    assert list(rank_entries(honest).values()) == [1, 2, 3]
    assert rank_entries({**honest, "spoiler": spoiler}) == {
        "spoiler": 1, "best": 1, "next": 3, "last": 4,
    }  # fmt: skip


def test_the_slope_equals_that_of_polyfit_and_its_interval_is_paired():
    rng = np.random.default_rng(7)
    road = rng.standard_normal((20, 1, 1))
    parts = [1.0 + 0.3 * k + road + 0.05 * rng.standard_normal((20, 2, 3)) for k in range(4)]
    found = iqm_slope(dict(enumerate(parts)))
    means = [oracle.interquartile_mean(part.ravel()) for part in parts]
    assert found.mean == pytest.approx(np.polyfit(range(4), means, 1)[0])
    # unpaired, the spread of the roads alone would give it +-0.2
    assert 0.0 < found.high - found.low < 0.05 and found.low < 0.3 < found.high
    apart = iqm_slope({0: parts[0], 3: parts[3]})  # of what was left out between them
    assert apart.mean == pytest.approx((means[3] - means[0]) / 3.0)


@pytest.mark.parametrize("strata", [None, [[0, 1, 2], [3, 4, 5]]])
def test_roads_without_a_score_of_anybody_leave_ranks_and_intervals(strata):
    scores = {name: x + 0.01 * np.arange(6.0) for name, x in (("a", 0.1), ("b", 0.3), ("c", 0.5))}
    scores = {name: x.reshape(6, 1, 1) for name, x in scores.items()}
    for x in scores.values():
        x[2:4] = np.nan
    assert rank_entries(scores, strata) == {"a": 1, "b": 2, "c": 3}
    assert np.isfinite(iqm_interval(scores["a"], strata)).all()
    lost = {**scores, "b": np.full((6, 1, 1), np.nan)}
    assert rank_entries(lost, strata) == {"a": 1, "c": 2, "b": 3}
    kept = {name: x[[0, 1, 4, 5]] for name, x in scores.items()}
    assert iqm_interval(kept["a"]) == iqm_interval(scores["a"])


def test_runs_that_were_not_driven_count_nowhere():
    rng = np.random.default_rng(8)
    scores = rng.uniform(size=(12, 7, 2))
    scores[rng.uniform(size=(12, 7)) < 0.7] = np.nan
    scores[:, 0] = rng.uniform(size=(12, 2))  # every road has some run
    driven = scores[~np.isnan(scores)]
    assert interquartile_mean(scores.ravel()) == pytest.approx(interquartile_mean(driven))
    assert np.isnan(interquartile_mean(np.full(3, np.nan)))
    assert count_roads(scores) == 12 and count_roads(np.full((3, 2, 1), np.nan)) == 0
    share, _, _ = performance_profile(scores, np.array([0.25, 0.5]))
    assert share == pytest.approx([np.mean(driven <= 0.25), np.mean(driven <= 0.5)])
    assert np.isfinite(bootstrap(scores, 0)).all()


def test_a_stratified_bootstrap_keeps_the_share_of_every_family():
    rng = np.random.default_rng(9)
    easy, hard = 0.1 + 0.01 * rng.uniform(size=6), 0.9 + 0.01 * rng.uniform(size=6)
    scores = np.concatenate([easy, hard])[:, None, None]
    strata = [list(range(6)), list(range(6, 12))]
    spread = {name: np.std(bootstrap(scores, 0, strata=x)) for name, x in
              {"roads": None, "families": strata}.items()}  # fmt: skip
    # half of the roads of each replicate are easy, so its interquartile mean stays between both
    assert 20 * spread["families"] < spread["roads"]
    # the same by hand: means of three of each family at least
    means = bootstrap(scores, 0, strata=strata)
    assert means.min() > 0.45 and means.max() < 0.56
    pairs = rank_entries({"a": scores, "b": scores + 0.05}, strata=strata)
    assert list(pairs.values()) == [1, 2]


def test_a_performance_profile_is_the_share_of_runs_below_each_threshold():
    scores = np.random.default_rng(6).uniform(size=(30, 2, 2))
    scores[0] = np.inf  # undefined: above every threshold
    thresholds = np.array([-1.0, 0.25, 0.5, 2.0])
    share, low, high = performance_profile(scores, thresholds)
    by_hand = [sum(x <= limit for x in scores.ravel()) / scores.size for limit in thresholds]
    assert share == pytest.approx(by_hand)
    assert share[0] == 0.0 and share[-1] == pytest.approx(29 / 30)
    assert (low <= share).all() and (share <= high).all()
    # of independent roads the share's deviation is binomial: sqrt(p (1 - p) / 30), at p = 1/2
    assert high[2] - low[2] == pytest.approx(4 * 0.5 / np.sqrt(60), rel=0.4)
