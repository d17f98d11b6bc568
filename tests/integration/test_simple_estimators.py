"""Properties of the baselines, the static network and the FIR filter, on the contract's drives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from test_estimator_contract import APRON, CAR, drive, error, fit

from estimators import create
from estimators.baselines.mean import _mean_profile
from estimators.baselines.random_road import _draw_road, _fit_spectrum
from estimators.common.least_squares import LeastSquaresSums, cross_validate
from estimators.common.spatial_signals import without_long_waves
from estimators.linear import fir_ridge
from estimators.preprocessing import spatial_accelerations
from road_envs.records.record import PROFILE_SPACING, Profile, profile_stations
from road_envs.records.roughness import displacement_psd


def test_flat_is_flat():
    record, _ = drive(109)
    assert not fit("flat").estimate(record, CAR).z.any()


def test_the_mean_is_taken_over_the_roads_that_reach_a_station():
    short, long = profile_stations(1.0), profile_stations(2.0)
    truths = [
        Profile(short, np.array([np.full(short.size, 1.0), np.full(short.size, 4.0)])),
        Profile(long, np.array([np.full(long.size, 3.0), np.full(long.size, 8.0)])),
    ]
    z = _mean_profile(truths)
    assert z.shape == (2, long.size)
    np.testing.assert_allclose(z[:, : short.size], [[2.0], [6.0]] * np.ones(short.size))
    np.testing.assert_allclose(
        z[:, short.size :], [[3.0], [8.0]] * np.ones(long[short.size :].size)
    )


def test_the_mean_is_zero_beyond_the_longest_training_road():
    record, _ = drive(110, length=25.0)
    z = fit("mean").estimate(record, CAR).z
    assert z[:, profile_stations(20.0).size - 100 : profile_stations(20.0).size].any()
    assert not z[:, profile_stations(20.0).size :].any()


def test_the_mean_of_one_road_is_that_road():
    record, truth = drive(1)
    np.testing.assert_array_equal(fit("mean", seeds=(1,)).estimate(record, CAR).z, truth.z)


def class_d(seed: int, w: float = 2.0, length: float = 300.0) -> Profile:
    """Two independent class-D paths: white noise shaped to the waviness `w`."""
    stations = profile_stations(length)
    n = np.fft.rfftfreq(4 * stations.size, PROFILE_SPACING)[1:]
    G = 1024e-6 * (n / 0.1) ** -w
    white = np.random.default_rng(seed).standard_normal((2, 2, n.size))
    lines = np.sqrt(G * n[0]) * (white[0] + 1j * white[1]) * 2 * stations.size
    z = np.fft.irfft(np.pad(lines, ((0, 0), (1, 0))))[:, : stations.size]
    return Profile(stations, z)


@pytest.mark.parametrize("w", [1.6, 2.0, 2.4])
def test_the_unrelated_road_has_level_and_waviness_of_the_training_roads(w):
    truths = [class_d(seed, w) for seed in range(4)]
    G_d0, fitted_w = _fit_spectrum(truths)
    assert fitted_w == pytest.approx(w, abs=0.1)
    assert 10.0 * np.log10(G_d0 / 1024e-6) == pytest.approx(0.0, abs=1.0)


def test_the_unrelated_road_has_the_density_it_was_given():
    z = np.concatenate([_draw_road((1024e-6, 2.0, seed), 20_000) for seed in range(8)])
    n, G = displacement_psd(z, PROFILE_SPACING)
    for low, high in ((0.05, 0.2), (0.2, 0.6), (0.6, 1.8)):
        inside = (n > low) & (n < high)
        level = np.mean(G[:, inside] * (n[inside] / 0.1) ** 2)
        lines = inside.sum() * len(z) * 4.0  # about as many independent values; 504 m, 100 m each
        assert level / 1024e-6 == pytest.approx(1.0, abs=4.0 / np.sqrt(lines))


def test_the_unrelated_road_is_as_rough_as_the_truth_and_uncorrelated():
    truths = [class_d(seed) for seed in range(3)]
    record, _ = drive(111, length=300.0)
    errors, correlations = [], []
    for seed in range(8):
        estimate = create("unrelated_road").fit([record], truths, CAR, seed).estimate(record, CAR)
        truth = class_d(100 + seed)
        sos = signal.butter(4, [0.2, 1.8], "band", fs=1.0 / PROFILE_SPACING, output="sos")
        a, b = (signal.sosfiltfilt(sos, z, axis=1) for z in (estimate.z, truth.z))
        errors.append(np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)))
        correlations.append(np.corrcoef(a.ravel(), b.ravel())[0, 1])
        assert abs(np.corrcoef(*a)[0, 1]) < 0.4
    assert np.mean(errors) == pytest.approx(np.sqrt(2.0), abs=0.1)
    assert abs(np.mean(correlations)) < 0.1


def test_unrelated_roads_of_two_seeds_differ():
    record, _ = drive(112)
    one, other = (fit("unrelated_road", seed=s).estimate(record, CAR).z for s in (0, 1))
    assert abs(np.corrcoef(one[0], other[0])[0, 1]) < 0.9


def test_the_network_keeps_its_training_history():
    training = fit("static_lm").training
    assert training.stop in ("epochs", "validation")
    assert training.train.size == training.epochs + 1 == training.mu.size
    assert training.train[-1] < training.train[0]


@pytest.mark.costly
def test_the_network_learns_heights_that_depend_on_one_sample():
    """Heights that are a function of the accelerations at the same station."""

    def memoryless_drive(seed):
        record, _ = drive(seed)
        a = spatial_accelerations(record)
        return record, Profile(
            profile_stations(record.length), 0.01 * np.array([np.tanh(a[0]), a[1] * a[2]])
        )

    records, truths = zip(*(memoryless_drive(seed) for seed in (1, 2, 3)), strict=True)
    network = create("static_lm", hidden=10).fit(records, truths, CAR, 0)
    record, truth = memoryless_drive(113)
    assert error(network.estimate(record, CAR), truth) < 0.1


def test_the_network_output_stays_in_the_range_of_the_training_heights():
    network = fit("static_lm")
    record, truth = drive(1)
    z = network.estimate(record, CAR).z
    assert np.abs(z).max() < 2.0 * np.abs(truth.z).max()


def test_the_training_limits_are_settings():
    assert fit("static_lm", max_epochs=2).training.epochs == 2
    patient, hasty = (fit("static_lm", max_epochs=300, max_fail=n).training for n in (20, 1))
    assert hasty.epochs < patient.epochs == patient.best_epoch + 20


def test_different_seeds_give_different_networks():
    one, other = (fit("static_lm", seed=s).weights()["hidden"] for s in (0, 1))
    assert not np.allclose(one, other)


def test_the_division_of_the_samples_can_be_chosen():
    drawn, blocks = (fit("static_lm", division=how).weights() for how in ("random", "block"))
    assert not np.allclose(drawn["hidden"], blocks["hidden"])


def test_the_fir_filter_estimates_a_new_road_and_the_static_network_does_not():
    record, truth = drive(114)
    assert error(fit("fir_ridge", seeds=tuple(range(6))).estimate(record, CAR), truth) < 0.3
    assert error(fit("static_lm", seeds=tuple(range(6))).estimate(record, CAR), truth) > 0.8


def test_a_mirrored_drive_gives_the_mirrored_road():
    window = fit("fir_ridge")
    record, _ = drive(115)
    upside_down = replace(record, a=-record.a)
    np.testing.assert_allclose(
        window.estimate(upside_down, CAR).z, -window.estimate(record, CAR).z, atol=1e-12
    )


def test_doubled_accelerations_give_a_doubled_road():
    window = fit("fir_ridge")
    record, _ = drive(116)
    np.testing.assert_allclose(
        window.estimate(replace(record, a=2.0 * record.a), CAR).z,
        2.0 * window.estimate(record, CAR).z,
        atol=1e-12,
    )


@pytest.mark.parametrize("name", ["static_lm", "fir_ridge"])
def test_left_and_right_swapped_at_the_rear_change_the_estimate(name):
    estimator = fit(name)
    record, truth = drive(117)
    swapped = replace(record, a=record.a[[0, 2, 1]])
    before, after = estimator.estimate(record, CAR), estimator.estimate(swapped, CAR)
    assert np.abs(after.z - before.z).mean() > 0.1 * np.abs(truth.z).mean()


@pytest.mark.parametrize("name", ["static_lm", "fir_ridge"])
def test_shuffled_samples_destroy_the_estimate(name):
    estimator = fit(name)
    record, _ = drive(118)
    order = np.random.default_rng(0).permutation(record.t.size)
    before = estimator.estimate(record, CAR).z
    after = estimator.estimate(replace(record, a=record.a[:, order]), CAR).z
    assert abs(np.corrcoef(before.ravel(), after.ravel())[0, 1]) < 0.3


def test_a_window_fitted_at_another_speed_adds_a_note():
    window = fit("fir_ridge")
    record, _ = drive(119)
    assert window.estimate(record, CAR).notes == ("waves longer than 20 m are not estimated",)
    faster = replace(record, t=record.t / 2.0, v=2.0 * record.v)
    assert "fitted at 8.0 m/s, driven at 16.0 m/s" in window.estimate(faster, CAR).notes


def test_the_tap_spacing_is_that_of_the_band_limit():
    """At 8 m/s the band ends at 3.1 cycles/m: taps 160 mm apart, six profile stations."""
    fitted_state = fit("fir_ridge").fitted_state
    assert fitted_state.stride == 6
    assert fitted_state.taps.shape == (2, 3, 2 * int(3.0 / (6 * PROFILE_SPACING)) + 1)


def test_known_taps_are_recovered():
    """Heights generated by known taps, from enough data."""
    rng = np.random.default_rng(0)
    stride, half = 3, int(0.5 / (3 * PROFILE_SPACING))
    coefficients = rng.standard_normal((3 * (2 * half + 1), 2))
    sums = LeastSquaresSums.zeros(len(coefficients))
    for seed in range(4):
        X = fir_ridge._sliding_windows(drive(seed, noise=1.0)[0], stride, half)
        sums = sums.plus(LeastSquaresSums.from_samples(X, X @ coefficients))
    np.testing.assert_allclose(sums.solve(1e-12), coefficients, rtol=1e-4)


def test_estimating_tap_by_tap_equals_the_windows_of_training():
    window = fit("fir_ridge")
    record, _ = drive(120)
    taps, stride, _, _ = window.fitted_state
    X = fir_ridge._sliding_windows(record, stride, taps.shape[2] // 2)
    z = window.estimate(record, CAR).z[:, ::stride]
    np.testing.assert_allclose(taps.reshape(2, -1) @ X.T, z, atol=1e-12)


def test_the_ridge_is_the_least_squares_problem_with_a_penalty_row_for_each_tap():
    rng = np.random.default_rng(1)
    X, Z = rng.standard_normal((60, 9)), rng.standard_normal((60, 2))
    ridge = 0.3
    level = np.mean(np.sum(X**2, axis=0))
    penalty = np.sqrt(ridge * level) * np.eye(9)
    expected, *_ = np.linalg.lstsq(np.vstack([X, penalty]), np.vstack([Z, np.zeros((9, 2))]))
    sums = LeastSquaresSums.from_samples(X[:20], Z[:20]).plus(
        LeastSquaresSums.from_samples(X[20:], Z[20:])
    )
    found = sums.solve(ridge)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    assert sums.squared_error(found) == pytest.approx(np.sum((Z - X @ found) ** 2), rel=1e-10)


def test_cross_validation_selects_a_strong_ridge_for_noise_only():
    rng = np.random.default_rng(2)
    X = rng.standard_normal((100, 40))
    noise, clear = rng.standard_normal((100, 2)), X @ rng.standard_normal((40, 2))

    def chosen(Z):
        parts = zip(np.split(X, 5), np.split(Z, 5), strict=True)
        folds = [LeastSquaresSums.from_samples(*part) for part in parts]
        return cross_validate(folds, fir_ridge.RIDGES)[0]

    assert chosen(noise) == fir_ridge.RIDGES[-1]
    assert chosen(clear) == fir_ridge.RIDGES[0]


def test_the_target_keeps_the_band_and_removes_long_waves():
    stations = profile_stations(200.0)
    middle = slice(stations.size // 4, -stations.size // 4)

    def passed(n):
        wave = np.sin(2.0 * np.pi * n * stations)
        kept = without_long_waves(np.array([wave, wave]))
        return np.std(kept[0, middle]) / np.std(wave[middle])

    assert passed(0.2) == pytest.approx(1.0, abs=0.01)
    assert passed(0.05) == pytest.approx(0.5, abs=0.03)  # two passes of a filter 3 dB down
    assert passed(0.01) < 0.01


def test_training_on_level_roads_gives_a_level_estimate():
    record, truth = drive(121)
    still = replace(record, a=np.zeros_like(record.a))
    window = create("fir_ridge", reach=1.0).fit([still], [Profile(truth.s, 0.0 * truth.z)], CAR, 0)
    assert not window.estimate(record, CAR).z.any()


def test_offset_and_high_frequency_noise_are_filtered_out():
    record, _ = drive(123)
    offset_and_hum = 3.0 + np.sin(2.0 * np.pi * 70.0 * record.t)
    dirty = replace(record, a=record.a + offset_and_hum)
    np.testing.assert_allclose(
        spatial_accelerations(dirty)[:, 100:-100],
        spatial_accelerations(record)[:, 100:-100],
        atol=1e-3,
    )


def test_accelerations_beyond_the_record_are_zero():
    record, _ = drive(122)
    a = spatial_accelerations(record, margin=1000)
    s = PROFILE_SPACING * np.arange(-1000, profile_stations(record.length).size + 1000)
    assert not a[:, s < -APRON].any()
    assert not a[:, s > record.length + APRON].any()
    assert a[:, (s > 0) & (s < 20)].all()
