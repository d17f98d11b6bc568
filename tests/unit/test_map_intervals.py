"""Intervals of the maximum a posteriori road where wheels lift off."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.fft import rfftfreq
from vehicle_fixtures import DEFENDER

from estimators import create
from estimators.map_smoother import wheel_liftoff
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.posterior_sampling import _add_liftoff_errors, band_pass
from estimators.map_smoother.tuning import TUNING
from estimators.map_smoother.wheel_liftoff import LiftoffError, road_below_light_wheels
from leaderboard.metrics.heights import band_pass as in_band
from leaderboard.metrics.heights import error_over_truth, uncertainty
from road_envs.drives.recording import simulate_record
from road_envs.records.record import PROFILE_SPACING, scored_band
from road_envs.roads import realise_road

DS, SIZE = 0.05, 1200
MIXED = {"front": "ride", "rear": "handling"}


@pytest.fixture
def below(monkeypatch):
    """Return what is known of the road `c` (2, K) below lifted wheels."""

    def evaluate(c, unloaded, is_level=True, step_std=1.0, may_be_uneven=True):
        size = c.shape[1]
        amplitude = np.full((2, size // 2 + 1), step_std * np.sqrt(0.5))
        road = SimpleNamespace(
            size=size, ds=DS, is_level_between_obstacles=is_level,
            local=np.ones((2, size)), amplitude=amplitude, may_be_uneven=may_be_uneven,
        )  # fmt: skip
        objective = SimpleNamespace(road=road, coefficients=lambda x: c)
        lin = SimpleNamespace(x=None, objective=objective)
        monkeypatch.setattr(wheel_liftoff, "unloaded_nodes", lambda lin, share=0.1: unloaded)
        return road_below_light_wheels(lin)

    return evaluate


def test_a_wheel_that_has_landed_on_the_floor_knows_its_depth_and_not_its_edge(below):
    c, unloaded = np.zeros((2, 100)), np.zeros((2, 100), dtype=bool)
    c[1, 40:52] = [-0.01, -0.03, -0.05, *np.full(9, -0.06)]
    unloaded[1, 41:44] = True  # the wheel falls from node 40 to node 44
    lower, (error, floor) = below(c, unloaded)
    assert error.path == 1 and not floor.height.any()
    expected = [0.0, 0.05, 0.03, 0.01, 0.0, 0.0]
    np.testing.assert_allclose(
        error.height[39:45], TUNING.edge_std * np.array(expected), atol=1e-12
    )
    np.testing.assert_allclose(lower[1, 39:45], [0.0, 0.0, 0.015, 0.005, 0.0, 0.0], atol=1e-12)
    assert not lower[0].any()


def test_floors_that_no_wheel_reached_are_as_deep_as_is_told_of_them_and_as_uncertain(below):
    rng, deepest, count = np.random.default_rng(1), 0.08, 6
    errors, variances = [], []
    for _ in range(400):
        fallen = rng.uniform(0.2, 0.6) * deepest  # when the wheel hits the far edge
        depth, others = rng.uniform(fallen, deepest), rng.uniform(0.01, deepest, count - 1)
        c, unloaded = np.zeros((2, 40 * count)), np.zeros((2, 40 * count), dtype=bool)
        for k, fall in enumerate([fallen, *others]):
            at = 40 * k + 10
            c[0, at : at + (15 if k else 4)] = -fall
            unloaded[0, at : at + 3] = True
        lower, (_, floor, *_) = below(c, unloaded)
        assert not lower[0, 40:].any()  # on the other floors the wheel has landed
        errors.append(depth - fallen - lower[0, 11])
        variances.append(floor.height[11] ** 2)
    std = np.sqrt(np.mean(variances))
    assert abs(np.mean(errors)) < 0.15 * std
    assert np.std(errors) == pytest.approx(std, rel=0.2)


def test_a_straight_road_across_a_gap_errs_as_a_random_walk_does_between_known_ends(below):
    unloaded = np.zeros((2, 100), dtype=bool)
    unloaded[0, 40:56] = True
    lower, [error] = below(np.zeros((2, 100)), unloaded, is_level=False, step_std=0.002)
    nodes = np.flatnonzero(error.height)
    walk = np.random.default_rng(2).normal(0.0, 0.002, (4000, nodes.size + 1)).cumsum(axis=1)
    share = np.arange(1, nodes.size + 2) / (nodes.size + 1)
    bridge = (walk - share * walk[:, -1:])[:, :-1]
    assert not lower.any()
    assert error.height[nodes[0]] == pytest.approx(bridge.mean(axis=1).std(), rel=0.1)


@pytest.mark.parametrize(
    ("fall", "may_be_uneven", "is_flown"),
    [(0.05, False, True), (0.05, True, False), (0.01, False, False)],
)
def test_where_no_even_road_falls_so_far_it_is_a_line_or_the_height_of_landing(
    below, fall, may_be_uneven, is_flown
):
    """A walk of 17 steps of 2 mm changes by 8 mm."""
    c, unloaded = np.zeros((2, 100)), np.zeros((2, 100), dtype=bool)
    c[0, :40], c[0, 40:56] = fall, fall * (1.0 - np.arange(1, 17) / 17.0)
    unloaded[0, 40:56] = True
    lower, errors = below(c, unloaded, is_level=False, step_std=0.002, may_be_uneven=may_be_uneven)
    assert lower.any() == is_flown
    if is_flown:
        np.testing.assert_allclose(lower[0, 40:56], 0.5 * c[0, 40:56])
        np.testing.assert_allclose(errors[0].height[40:56], 0.5 * c[0, 40:56])


def test_an_error_below_a_wheel_counts_by_its_envelope_in_the_band():
    n = rfftfreq(SIZE, DS)
    lines, height, before = (n > 1.0) & (n < 1.6), np.zeros(SIZE), np.full((2, SIZE), 1e-8)
    height[400:406] = 0.01
    variance = _add_liftoff_errors(before, [LiftoffError(0, height)], lines)
    np.testing.assert_array_equal(variance[1], before[1])
    error = band_pass(height[None], lines)[0]
    tops = [k for k in range(390, 416) if abs(error[k]) >= abs(error[k - 3 : k + 4]).max()]
    assert len(tops) >= 2
    np.testing.assert_allclose(np.sqrt(variance[0, tops]), abs(error[tops]), rtol=0.15)


@pytest.mark.parametrize(("road", "seed"), [("random_bumps", 211), ("potholes", 212)])
@pytest.mark.costly
def test_intervals_are_wide_where_wheels_fly_and_cover_what_they_say(road, seed):
    record, truth = simulate_record(
        road, speed_kmh=54.0, mode="ride", seed=seed, length=60.0, step=5e-4
    )
    estimate = create("map_smoother").estimate(record, DEFENDER)
    assert any("in the air" in note for note in estimate.notes)
    y, a = in_band(np.stack([truth.z, estimate.z]), PROFILE_SPACING, scored_band(15.0))
    scores = uncertainty(y, a, estimate.z_std)
    assert 0.35 < scores.coverage_50 < 0.75
    assert scores.coverage_90 > 0.75  # rounding alone moves it by some hundredths
    assert estimate.z_std.max() > 10.0 * np.median(estimate.z_std)
    assert error_over_truth(y, a).pooled < 0.3


@pytest.mark.parametrize(
    ("road", "mode"),
    [("washboard", {"front": "ride", "rear": "handling"}), ("bump_large_small", "handling")],
)
@pytest.mark.costly
def test_no_estimate_rises_beyond_three_times_the_range_of_the_road(road, mode):
    record, truth = simulate_record(road, speed_kmh=54.0, mode=mode, seed=3)
    estimate = create("map_smoother").estimate(record, DEFENDER)
    assert np.ptp(estimate.z, axis=1).max() < 3.0 * np.ptp(truth.z)


def test_a_prior_under_which_its_road_is_most_improbable_is_not_taken():
    """Of a single wave it would allow hardly any other road: the error would be 0.21."""
    record, truth = simulate_record("washboard_oblique", speed_kmh=90.0, mode=MIXED, seed=3)
    estimate = create("map_smoother").estimate(record, DEFENDER)
    error = estimate.z - [np.interp(estimate.s, truth.s, z) for z in truth.z]
    error -= error.mean(axis=1, keepdims=True)
    assert error.std() < 0.18 * truth.z.std()


def test_draws_have_the_error_of_the_estimate_octave_by_octave_and_agree_with_the_deviation():
    surface = realise_road("iso_c", 73, 150.0)
    record, truth = simulate_record(surface, vehicle=DEFENDER, speed_kmh=54.0, mode=MIXED, seed=73)
    found = MapSmoother(adapt=False).estimate(record, DEFENDER)
    error, deviations = found.z - truth.z, found.draws - found.z
    for low in (0.1, 0.2, 0.4, 0.8, 1.6):
        band = (low, 2.0 * low)
        ours = np.sqrt(np.mean([np.var(in_band(x, found.ds, band)) for x in deviations]))
        assert 0.6 < np.std(in_band(error, found.ds, band)) / ours < 1.7, low
    inside = [in_band(x, found.ds, scored_band(15.0)) for x in deviations]
    assert np.sqrt(np.mean(np.square(inside))) == pytest.approx(found.z_std.mean(), rel=0.15)


def test_draws_go_on_from_window_to_window():
    surface = realise_road("iso_c", 73, 60.0)
    record, _ = simulate_record(surface, vehicle=DEFENDER, speed_kmh=54.0, mode=MIXED, seed=73)
    found = MapSmoother(adapt=False, window=2.0, overlap=0.8).estimate(record, DEFENDER)
    steps = np.abs(np.diff(found.draws - found.z, axis=2)).max(axis=(0, 1))
    assert steps.max() < 6.0 * np.median(steps)
    growth = np.std(found.draws - found.z, axis=0).mean(axis=0)
    assert growth[-1] > growth[200]
