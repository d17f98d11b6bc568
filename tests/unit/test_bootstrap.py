"""Statistics of scores: interquartile mean, bootstrap intervals, ranks."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from leaderboard.metrics.bootstrap import (
    bootstrap,
    interquartile_mean,
    iqm_interval,
    performance_profile,
    rank_entries,
    resample,
)


def test_the_interquartile_mean_is_the_mean_of_the_middle_half():
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, -50.0])) == 1.5
    assert interquartile_mean(np.array([7.0])) == 7.0
    # of five values the central three count, the outer two of them with weight 3/4
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 4.0, 9.0])) == pytest.approx(5.75 / 2.5)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=40), st.floats(-10.0, 10.0))
@settings(max_examples=50)
def test_the_interquartile_mean_is_shift_equivariant_and_within_the_range(x, shift):
    x = np.array(x)
    mean = interquartile_mean(x)
    assert x.min() - 1e-9 <= mean <= x.max() + 1e-9
    assert interquartile_mean(x + shift) == pytest.approx(mean + shift, abs=1e-6)


def test_bootstrap_intervals_have_their_nominal_coverage():
    rng = np.random.default_rng(0)
    inside = 0
    for k in range(200):
        roads = rng.standard_normal((30, 1, 1))  # equal for all seeds, which add no information
        drawn = bootstrap(roads + np.zeros((1, 1, 3)), seed=k)
        low, high = np.quantile(drawn, [0.025, 0.975])
        inside += low <= 0.0 <= high
    # 95 % of 200, three standard errors; a bootstrap of 30 roads is a little narrow
    assert 0.87 <= inside / 200 <= 0.99


OF_NEW_ROAD = [[0, 6], [1, 7], [2, 3, 8, 9], [4, 5, 10, 11]]
OF_FIELD = [[0, 2, 4], [1, 3, 5]]
IN_PAIRS = [[0, 1], [2, 3], [4, 5]]


@pytest.mark.costly
@pytest.mark.parametrize("strata", [OF_NEW_ROAD, OF_FIELD, IN_PAIRS])
def test_equal_entries_share_ranks_and_intervals_cover_in_families_of_a_few_roads(strata):
    """Of n roads, n draws have (n - 1) / n of the variance, and percentiles are those of a normal
    distribution of known width: 10 % and 87 % of the first of these boards by the usual bootstrap.
    """
    rng = np.random.default_rng(14)
    level = np.zeros(sum(map(len, strata)))
    for k, family in enumerate(strata):
        level[family] = 0.3 * k  # log of the score

    def scores(road):
        noise = 0.15 * rng.standard_normal(road.shape)
        return np.exp(level + road + noise)[..., None, None]

    many = scores(0.3 * rng.standard_normal((50_000, len(level))))
    expected = interquartile_mean(many[..., 0, 0]).mean()
    ranked, inside = [], []
    for road in 0.3 * rng.standard_normal((500, len(level))):
        one, other = scores(road), scores(road)
        ranks = rank_entries({"one": one, "other": other}, strata=strata)
        ranked.append(ranks["one"] != ranks["other"])
        mean, low, high = iqm_interval(one, strata)
        assert low <= mean <= high  # families keep their shares of a replicate
        inside.append(low <= expected <= high)
    assert np.mean(ranked) < 0.055
    assert np.mean(inside) > 0.92


def test_the_interval_of_positive_scores_is_positive_and_that_of_others_is_symmetric():
    scores = np.random.default_rng(15).lognormal(sigma=1.5, size=(6, 1, 1))
    mean, low, high = iqm_interval(scores)
    assert low > 0.0 and low * high == pytest.approx(mean**2)
    mean, low, high = iqm_interval(np.where(scores == scores.max(), 0.0, scores))
    assert low < 0.0 and 0.5 * (low + high) == pytest.approx(mean)


def test_replicates_vary_as_the_mean_of_few_roads_and_of_few_trainings_does():
    """The standard error of a mean is s / sqrt(n), with s² over n - 1; the middle half of two
    values is both of them.
    """
    pair = np.array([1.0, 2.0])
    for scores in (pair[:, None, None], pair[None, None, :]):
        assert np.std(bootstrap(scores, 0)) == pytest.approx(0.5, rel=0.01)
    families = np.array([1.0, 2.0, 10.0, 10.0, 20.0, 20.0, 20.0, 20.0])[:, None, None]
    # the quartiles cut the families as those of all roads do: they keep their weights
    strata = [[0, 1], [2, 3], [4, 5, 6, 7]]
    assert bootstrap(families, 0, strata=strata) == pytest.approx(15.0)
    for share in performance_profile(families, np.array([5.0, 15.0]), strata=strata):
        assert share == pytest.approx([0.25, 0.5])


def test_the_mean_of_families_of_other_sizes_weighs_each_road_alike():
    scores = np.array([1.0, 2.0, *[4.0] * 6])[:, None, None]
    made = resample([scores], strata=[[0, 1], range(2, 8)], mean=np.average)
    mean, low, high = made.interval()
    error = 2 / 8 * 0.5  # of the mean of two roads, which are a quarter of all
    assert mean == scores.mean()
    assert high - low == pytest.approx(2.0 * error * stats.t.ppf(0.975, 6), rel=0.02)


def test_roads_are_one_stratum_where_a_family_has_a_single_road_that_is_not_level():
    scores = np.random.default_rng(10).lognormal(size=(10, 1, 1))
    scores[1::2] = np.nan
    pairs = [[k, k + 1] for k in range(0, 10, 2)]
    assert iqm_interval(scores, pairs) == iqm_interval(scores)
    assert np.ptp(iqm_interval(scores, pairs)) > 0.1
    assert iqm_interval(scores, [[0, 2], [4], [6, 8]]) == iqm_interval(scores)
    assert iqm_interval(scores, [[0, 2], [1, 3], [4, 6, 8]]) != iqm_interval(scores)


def test_more_seeds_do_not_replace_more_roads():
    road = np.random.default_rng(1).standard_normal((10, 1, 1))
    few, many = (np.std(bootstrap(road + np.zeros((1, 1, S)), 0)) for S in (1, 50))
    assert many == pytest.approx(few, rel=0.05)


def test_intervals_include_the_spread_over_seeds():
    seeds = np.random.default_rng(2).standard_normal((1, 1, 8))
    assert np.std(bootstrap(seeds + np.zeros((10, 4, 1)), 0)) > 0.15


def test_entries_without_a_significant_difference_share_a_rank():
    rng = np.random.default_rng(3)
    road = rng.standard_normal((20, 2, 1))
    scores = {
        "worst": 3.0 + road + 0.01 * rng.standard_normal((20, 2, 3)),
        "equal": road + 0.01 * rng.standard_normal((20, 2, 3)),
        "same": road + 0.01 * rng.standard_normal((20, 2, 3)),
        "undefined": np.full((20, 2, 3), np.nan),
        "not either": np.full((20, 2, 3), np.nan),
    }
    found = rank_entries(scores)
    assert found == {
        "equal": 1,
        "same": 1,
        "worst": 3,
        "undefined": 4,
        "not either": 4,
    }
    assert list(found)[-2:] == ["undefined", "not either"]


def test_a_small_difference_on_every_road_is_significant_since_roads_are_paired():
    road = np.random.default_rng(4).standard_normal((20, 1, 1))
    found = rank_entries({"better": road, "worse": road + 0.1})
    assert list(found.values()) == [1, 2]
    assert iqm_interval(road + 0.1).low < iqm_interval(road).high


def test_an_entry_that_errs_much_and_unevenly_is_behind_one_that_is_better_on_every_road():
    """Where few scores are eight times the others, a difference is as uncertain as it is large."""
    good = 0.05 + 0.01 * np.random.default_rng(16).random((6, 1, 1))
    bad = np.array([1.2, 1.1, 9.0, 1.3, 8.0, 1.2]).reshape(6, 1, 1)
    assert rank_entries({"bad": bad, "good": good}) == {"good": 1, "bad": 2}


def test_an_exact_drive_of_one_entry_moves_no_rank_of_the_others():
    good = 0.05 + 0.01 * np.random.default_rng(16).random((6, 1, 1))
    bad = np.array([1.2, 1.1, 9.0, 1.3, 8.0, 1.2]).reshape(6, 1, 1)
    behind = np.array([0.0, 91.0, 95.0, 99.0, 92.0, 94.0]).reshape(6, 1, 1)
    ranks = {"good": 1, "bad": 2, "behind": 3}
    assert rank_entries({"bad": bad, "good": good, "behind": behind}) == ranks
    ranks = {"exact": 1, "good": 2, "bad": 3}
    assert rank_entries({"bad": bad, "good": good, "exact": 0.0 * good}) == ranks


def test_an_entry_of_uncertain_scores_has_no_better_rank_than_those_ahead_of_it():
    road = 1.0 + 0.05 * np.random.default_rng(17).random((6, 1, 1))
    uncertain = np.array([0.05, 1.0, 0.06, 1.1, 0.9, 0.05]).reshape(6, 1, 1)
    entries = {"third": 0.2 * road, "best": 0.1 * road, "next": 0.15 * road}
    assert list(rank_entries({"best": entries["best"], "uncertain": uncertain}).values()) == [1, 1]
    expected = {"best": 1, "next": 2, "third": 3, "uncertain": 3}
    assert rank_entries({"uncertain": uncertain, **entries}) == expected


def test_one_lucky_training_of_three_is_not_the_rank_of_an_entry():
    """All draws of three seeds are that one in 1 of 27 replicates: more than the 2.5 % allowed."""
    rng = np.random.default_rng(8)
    road = 0.1 * rng.standard_normal((24, 1, 1))
    steady = {f"at {x}": x + road + 0.01 * rng.standard_normal((24, 1, 1)) for x in (0.3, 0.5)}
    lottery = road + np.array([0.2, 1.0, 1.0])
    assert rank_entries({**steady, "lottery": lottery}) == {"at 0.3": 1, "at 0.5": 2, "lottery": 3}


@pytest.mark.parametrize("apart", [1e-15, 1e-9, 1e-3])
def test_a_copy_that_errs_less_by_rounding_shares_the_rank(apart):
    """Of two such copies one is ahead on every road; a third below both would push a rival down."""
    rng = np.random.default_rng(9)
    road = 0.5 + 0.1 * rng.random((20, 2, 1))
    rival = road + 0.02 * rng.standard_normal((20, 2, 1))
    scores = {"first": road, "copy": (1.0 - apart) * road, "rival": rival, "worse": 1.1 * road}
    assert rank_entries(scores) == {"first": 1, "copy": 1, "rival": 1, "worse": 4}
