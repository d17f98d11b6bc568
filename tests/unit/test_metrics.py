"""Scores of profiles and obstacles against closed forms, on roads drawn in this file."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal
from scipy.fft import next_fast_len

from leaderboard.metrics import heights, roughness
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.obstacles import detect_obstacles
from leaderboard.metrics.registry import SCORES, compute_scores
from road_envs.records.record import PROFILE_SPACING, Estimate, Profile, profile_stations
from road_envs.records.roughness import displacement_psd

DS = PROFILE_SPACING
BAND = (0.2, 1.8)
S = profile_stations(100.0)
CLASS_D = 1024e-6


@cache
def road(seed, length=100.0, n_lo=0.01, n_hi=10.0):
    """Return two independent wheel paths of density CLASS_D (n / 0.1)^-2, n_lo to n_hi, mean 0."""
    rng = np.random.default_rng(seed)
    size = next_fast_len(round(1000.0 / DS), real=True)
    n = np.fft.rfftfreq(size, DS)[1:]
    a = np.sqrt(2.0 * CLASS_D * (n / 0.1) ** -2.0 * n[0]) * ((n >= n_lo) & (n <= n_hi))
    phase = np.exp(2j * np.pi * rng.uniform(size=(2, n.size)))
    spectrum = np.concatenate([np.zeros((2, 1)), 0.5 * size * a * phase], axis=1)
    z = np.fft.irfft(spectrum, size)[:, : profile_stations(length).size]
    return z - z.mean(axis=1, keepdims=True)


def sine(n, phase=0.3):
    return np.sin(2.0 * np.pi * n * S + phase)


def correlation(y, a):
    return heights.correlation(*heights.band_pass(np.stack([y, a]), DS, BAND), DS)


def scores(y, a):
    """Return all scores of heights at 4 m/s."""
    s = DS * np.arange(y.shape[1])
    return compute_scores(ScoredEstimate(Profile(s, y), Estimate(s, a), 4.0, bumps=False))


def obstacle_scores(y, a):
    s = DS * np.arange(y.shape[1])
    scored = ScoredEstimate(Profile(s, y), Estimate(s, a), 4.0, bumps=True)
    return {key: x.compute(scored) for key, x in SCORES.items() if key.startswith("bump_")}


def rms(z):
    return np.sqrt(np.mean(z**2))


def plate(*bumps):
    """Return a level wheel path with blocks (start, end, height)."""
    z = np.zeros(S.size)
    for start, end, height in bumps:
        z[(start <= S) & (end >= S)] = height
    return z


@pytest.mark.parametrize("n", [0.25, 0.4, 0.7, 1.1, 1.6])
def test_a_sine_inside_the_band_keeps_its_level(n):
    assert rms(heights.band_pass(sine(n), DS, BAND)) == pytest.approx(0.5**0.5, rel=0.01)


@pytest.mark.parametrize("n", [0.02, 0.05, 0.1, 2.2, 4.0])
def test_a_sine_outside_the_band_is_removed(n):
    assert rms(heights.band_pass(sine(n), DS, BAND)) < 0.03 * 0.5**0.5


def test_the_band_pass_has_no_phase_shift():
    z = sine(0.6)
    out = heights.band_pass(z, DS, BAND)
    trim = (z.size - out.size) // 2
    assert np.allclose(out, z[trim : trim + out.size], atol=0.05)


def test_long_waves_do_not_leak_into_the_band():
    slow = [rms(heights.band_pass(road(k, n_hi=0.15), DS, BAND)) for k in range(20)]
    whole = [rms(heights.band_pass(road(k), DS, BAND)) for k in range(20)]
    assert rms(np.array(slow)) < 0.03 * rms(np.array(whole))


def test_the_level_inside_the_band_is_the_integral_of_the_density():
    found = [rms(heights.band_pass(road(k), DS, BAND)) for k in range(40)]
    expected = np.sqrt(CLASS_D * 0.1**2 * (1 / 0.2 - 1 / 1.8))
    assert rms(np.array(found)) == pytest.approx(expected, rel=0.05)


@given(drift=st.floats(-10.0, 10.0), slope=st.floats(-0.1, 0.1))
@settings(max_examples=20)
def test_the_band_pass_ignores_datum_and_slope(drift, slope):
    z = road(1)
    moved = heights.band_pass(z + drift + slope * S, DS, BAND)
    np.testing.assert_allclose(moved, heights.band_pass(z, DS, BAND), atol=1e-9)


def test_the_scored_band_ends_at_the_low_pass():
    assert heights.scored_band(14.5 / 3.6) == (0.2, 1.8)
    assert heights.scored_band(15.0) == pytest.approx((0.2, 1.5))
    with pytest.raises(ValueError, match="25 Hz"):
        heights.scored_band(200.0)


def test_the_truth_has_no_error_and_a_flat_road_has_one():
    y = road(1)
    assert heights.nrmse(y, y, DS, BAND) == (0.0, 0.0, 0.0)
    assert heights.nrmse(y, 0.0 * y, DS, BAND) == pytest.approx((1.0, 1.0, 1.0))


def test_an_unrelated_road_has_an_error_of_root_two():
    error = [heights.nrmse(road(k), road(k + 1), DS, BAND).pooled for k in range(0, 60, 2)]
    standard_error = np.std(error) / np.sqrt(len(error))
    assert np.mean(error) == pytest.approx(2.0**0.5, abs=3.0 * standard_error + 0.01)


@given(share=st.floats(0.0, 3.0), sign=st.sampled_from([-1.0, 1.0]))
@settings(max_examples=20)
def test_the_error_of_a_scaled_truth_is_the_deviation_of_the_scale_from_one(share, sign):
    y = road(2)
    assert heights.nrmse(y, sign * share * y, DS, BAND).pooled == pytest.approx(
        abs(sign * share - 1.0), abs=1e-9
    )
    assert heights.nrmse(10.0 * y, 10.0 * share * y, DS, BAND).left == pytest.approx(
        abs(share - 1.0), abs=1e-9
    )


def test_wheel_paths_are_scored_separately_and_pooled_by_energy():
    y = np.stack([road(1)[0], 0.1 * road(2)[0]])
    error = heights.nrmse(y, np.stack([y[0], 0.0 * y[1]]), DS, BAND)
    assert (error.left, error.right) == (0.0, pytest.approx(1.0))
    assert error.pooled < 0.15


def test_a_flat_truth_leaves_the_error_undefined():
    y = np.stack([road(1)[0], 0.0 * S])
    error = heights.nrmse(y, road(2), DS, BAND)
    assert np.isnan(error.right) and np.isfinite([error.left, error.pooled]).all()
    assert np.isnan(correlation(0.0 * y, y).r)
    assert np.isnan(heights.coherence(0.0 * y, y, DS, BAND))


@pytest.mark.parametrize("slope", [1e-6, 0.03])
def test_a_slope_is_flat_inside_the_band(slope):
    y = slope * np.stack([S, S])
    scored = ScoredEstimate(Profile(S, y), Estimate(S, road(2)), 15.0, bumps=False)
    assert np.isnan(compute_scores(scored)["nrmse"])
    assert np.isnan(heights.nrmse(y, road(2), DS, BAND)).all()


def test_a_sign_flip_is_perfect_by_equation_12_and_wrong_by_other_scores():
    y = road(3)
    assert heights.level_error(y, -y) == (0.0, 0.0, 0.0)
    assert heights.nrmse(y, -y, DS, BAND).pooled == pytest.approx(2.0)
    assert correlation(y, -y).r == pytest.approx(-1.0)


def test_equation_12_is_the_signed_relative_level_difference():
    y = road(3)
    assert heights.level_error(y, 0.8 * y) == pytest.approx((-0.2, -0.2, -0.2))
    assert heights.level_error(y, np.stack([2.0 * y[0], y[1]])).left == pytest.approx(1.0)


def test_equation_12_of_unrelated_roads_of_one_class_has_a_median_of_9_percent():
    """Reference values: median 9 %, 10th to 90th percentile 2 to 22 %, 72 % below 15 %."""
    high_pass = signal.butter(2, 0.05, "high", fs=1.0 / DS, output="sos")
    roads = [signal.sosfiltfilt(high_pass, road(k)) for k in range(400)]
    pairs = zip(roads[::2], roads[1::2], strict=True)
    error = np.abs([heights.level_error(y, a)[:2] for y, a in pairs]).ravel()
    low, median, high = 100.0 * np.quantile(error, [0.1, 0.5, 0.9])
    assert median == pytest.approx(9.0, abs=1.5)
    assert low == pytest.approx(2.0, abs=1.0) and high == pytest.approx(22.0, abs=3.0)
    assert np.mean(error < 0.15) == pytest.approx(0.72, abs=0.06)


def test_the_lag_of_a_delayed_estimate_is_positive():
    y = road(4)
    delayed = np.stack([np.interp(S - 0.3, S, z) for z in y])
    found = correlation(y, delayed)
    assert found.lag == pytest.approx(0.3, abs=DS)
    assert found.r < 0.9 < 0.99 < found.r_at_lag
    assert correlation(y, y) == pytest.approx((1.0, 0.0, 1.0))


@pytest.mark.parametrize("shift", [0.3, -0.45])
def test_a_truth_that_is_only_shifted_has_no_error_at_the_best_lag(shift):
    z = road(14, length=400.0)
    y, a = z[:, 200:-200], np.roll(z, round(shift / DS), axis=1)[:, 200:-200]
    found = scores(y, a)
    assert found["nrmse"] > 0.9 and found["lag"] == pytest.approx(shift, abs=DS)
    assert found["nrmse_at_lag"] < 0.04  # the taper of the band-pass changes the ends
    beyond = scores(y, np.roll(z, round(0.9 / DS), axis=1)[:, 200:-200])
    assert beyond["nrmse_at_lag"] > 1.0


def test_unrelated_roads_have_no_correlation_and_no_coherence():
    r = [correlation(road(k), road(k + 1)).r for k in range(0, 40, 2)]
    assert abs(np.mean(r)) < 3.0 * np.std(r) / np.sqrt(len(r))
    assert heights.coherence(road(1, 300.0), road(2, 300.0), DS, BAND) < 0.06


def test_coherence_is_invariant_to_scaling_and_reduced_by_noise():
    y, noise = road(5, 300.0), road(6, 300.0)
    assert heights.coherence(y, -3.0 * y, DS, BAND) == pytest.approx(1.0)
    # gamma2 = S / (S + N) for noise of the truth's own density
    assert heights.coherence(y, y + noise, DS, BAND) == pytest.approx(0.5, abs=0.05)


def test_a_flat_estimate_has_zero_correlation_and_coherence():
    y = road(7)
    assert correlation(y, 0.0 * y) == (0.0, 0.0, 0.0)
    assert heights.coherence(y, 0.0 * y, DS, BAND) == 0.0


@given(decibels=st.floats(-20.0, 20.0))
@settings(max_examples=10)
def test_the_dsd_distance_of_a_scaled_road_is_its_scale_in_decibels(decibels):
    y = road(8)
    found = scores(y, 10.0 ** (decibels / 20.0) * y)
    assert found["dsd_bias_db"] == pytest.approx(decibels, abs=1e-6)
    assert found["dsd_distance_db"] == pytest.approx(abs(decibels), abs=1e-6)
    assert found["G_d0_error_db"] == pytest.approx(abs(decibels), abs=1e-6)


def test_doubled_heights_are_the_next_class():
    y = road(9, 300.0)
    found = {k: scores(y, 10.0 ** (k / 20.0) * y) for k in (0.0, 6.02, 12.04)}
    assert found[0.0]["class_exact"] == found[0.0]["fitted_class"] == 1.0
    # a class is 6 dB wide, so twice the height is the next class, four times the one after it
    assert found[6.02]["class_exact"] == 0.0 and found[6.02]["class_within_one"] == 1.0
    assert found[12.04]["class_within_one"] == 0.0 and found[12.04]["fitted_class"] == 0.0


def test_octaves_above_the_low_pass_are_not_scored():
    y = road(10, 300.0)
    n, G = displacement_psd(y, DS)
    wrong = G * np.where(n > 1.5, 100.0, 1.0)

    def steps(G_a, v):
        return roughness._class_steps(SimpleNamespace(densities=(n, (G, G_a, G)), v=v))

    assert not steps(wrong, v=15.0).any()
    assert (steps(wrong, v=4.0) == [0, 0, 0, 3]).all()
    # at 18 m/s the low-pass ends at 1.25 cycles/m, inside the octave from 0.71 to 1.41
    cut = steps(G * np.where(n > 0.71, 100.0, 1.0), v=18.0)
    assert cut.shape == (2, 2) and not cut.any()
    assert steps(G, v=80.0).shape == (2, 0)


def test_the_iri_error_is_averaged_over_segments_of_100_m():
    y = road(11, 300.0)
    part = S.size
    a = y * np.repeat([2.0, 0.0, 1.0], part)[: y.shape[1]]  # too rough and too smooth do not cancel
    error, relative = (scores(y, a)[name] for name in ("iri_error", "iri_error_relative"))
    truth = 2.173 * np.sqrt(CLASS_D / 16e-6)  # closed form for w = 2, with the 250 mm filter
    assert relative == pytest.approx(2.0 / 3.0, abs=0.1)
    assert error == pytest.approx(truth * 2.0 / 3.0, rel=0.2)


def test_a_bump_is_detected_at_its_middle_with_its_height():
    (bump,) = detect_obstacles(plate((20.0, 20.8, 0.15)), DS, 0.05)
    assert bump.s == pytest.approx(20.4, abs=DS) and bump.height == 0.15


def test_bumps_are_matched_on_their_own_wheel_path():
    y = np.stack([plate((20.0, 20.8, 0.15)), plate((30.4, 31.2, 0.10))])
    a = np.stack([plate((20.2, 21.0, 0.12)), plate((20.0, 20.8, 0.08))])
    found = obstacle_scores(y, a)
    assert [found[f"bump_{name}"] for name in ("precision", "recall", "f1")] == [0.5, 0.5, 0.5]
    assert found["bump_location_error"] == pytest.approx(0.2, abs=DS)
    assert found["bump_height_error"] == pytest.approx(0.03)
    assert found["bump_height_error_relative"] == pytest.approx(0.2)
    assert found["bump_wrong_side"] == 1  # right, where only the left wheel path has a bump


def test_a_bump_beyond_the_match_distance_is_a_miss_and_a_false_alarm():
    y = np.stack([plate((20.0, 20.8, 0.1))] * 2)
    a = np.stack([plate((20.35, 21.15, 0.1)), plate((20.0, 20.8, 0.1))])
    found = obstacle_scores(y, a)
    assert (found["bump_precision"], found["bump_recall"]) == (0.5, 0.5)
    assert found["bump_wrong_side"] == 0


def test_an_estimated_bump_matches_at_most_one_true_bump():
    y = np.stack([plate((20.0, 20.05, 0.1), (20.57, 20.62, 0.1))] * 2)
    a = np.stack([plate((20.28, 20.34, 0.1))] * 2)
    assert obstacle_scores(y, a)["bump_recall"] == 0.5


def test_a_flat_estimate_has_no_detections_and_a_flat_truth_no_obstacle_scores():
    y = np.stack([plate((20.0, 20.8, 0.1))] * 2)
    found = obstacle_scores(y, 0.0 * y)
    assert found["bump_f1"] == 0.0 and np.isnan(found["bump_location_error"])
    assert np.isnan(list(obstacle_scores(0.0 * y, y).values())).all()


def test_every_score_of_the_truth_is_perfect_and_in_the_table_of_scores():
    y = np.stack([plate((20.0, 20.8, 0.15)), plate((30.4, 31.2, 0.10))]) + 0.1 * road(12)
    y[:, 1000:2000] = 0.0  # level enough for obstacles
    found = compute_scores(
        ScoredEstimate(Profile(S, y), Estimate(S, y, np.zeros_like(y)), 4.0, bumps=True)
    )
    assert found.keys() == SCORES.keys() - {"attainable_nrmse", "attainable_efficiency"}
    undefined = ("bound_nrmse", "bound_efficiency", "nrmse_aligned", "coverage_90_aligned")
    assert np.isnan([found.pop(name) for name in undefined]).all()
    for name, value in found.items():
        expected = 1.0 if SCORES[name].better == "high" or "coverage" in name else 0.0
        assert value == pytest.approx(expected, abs=1e-12), name


def test_the_level_error_of_the_board_ignores_the_datum():
    y = road(13)
    found = compute_scores(ScoredEstimate(Profile(S, y + 5.0), Estimate(S, y), 4.0, bumps=False))
    assert found["level_error"] == pytest.approx(0.0, abs=1e-9)
    assert found["level_error_raw"] > 0.9
