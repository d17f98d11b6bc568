"""What every estimator keeps, and what each of them is for.

The drives come from no simulator: each sensor hears its own wheel's road through one resonance,
the rear ones a wheelbase later.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import signal

from estimators import REGISTRY, create
from estimators.api import (
    EstimateError,
    NotFittedError,
    Trainable,
    check_estimate,
    validate_weights,
)
from estimators.baselines.mean import mean_profile
from estimators.baselines.random_road import FittedRoad, draw_road, fit_spectrum
from estimators.linear import fir_ridge
from estimators.preprocessing import spatial_accelerations
from estimators.weights_io import load, save
from road_envs.analysis.roughness import displacement_psd
from road_envs.data.record import PROFILE_SPACING, Estimate, Profile, Record, profile_stations
from road_envs.vehicle.parameters import load_vehicle

CAR = load_vehicle("land_rover_defender_110")
QUICK = {"shipped": False, "steps": 6, "channels": 8}
SMALL = {
    "static_lm": {"hidden": 6, "max_epochs": 8},
    "narx": {"hidden": 4, "max_epochs": 8},
    "fir_ridge": {"reach": 3.0, "shipped": False},
    **dict.fromkeys(("tcn", "tcn_causal", "gru", "gru_causal"), QUICK),
    "iterated_wiener": {"passes": 3},
}
"""Settings under which the contract is tested quickly."""
SPEED, RATE, APRON = 4.0, 200.0, 6.0
LEARNING = [name for name, cls in REGISTRY.items() if hasattr(cls, "fit")]
READY = [name for name, cls in REGISTRY.items() if hasattr(cls, "pretrain")]
"""These come with weights."""


def drive(seed: int, length: float = 20.0, noise: float = 0.02) -> tuple[Record, Profile]:
    """A record and its truth; waves of the road from 0.1 to 2 cycles/m."""
    rng = np.random.default_rng(seed)
    ds = 0.01
    s = ds * np.arange(round((length + 4.0 * APRON) / ds)) - 2.0 * APRON
    sos = signal.butter(2, [0.1, 2.0], "band", fs=1.0 / ds, output="sos")
    z = 0.2 * signal.sosfiltfilt(sos, rng.standard_normal((2, s.size)), axis=1)
    z[:, (s < 0.0) | (s > length)] = 0.0
    t = np.arange(int((length + 2.0 * APRON) / SPEED * RATE)) / RATE
    odometer = SPEED * t - APRON
    under = [(1, 0.0), (0, CAR.wheelbase), (1, CAR.wheelbase)]
    roads = np.array([np.interp(odometer - behind, s, z[side]) for side, behind in under])
    w, damping = 2.0 * np.pi * 3.0, 0.5
    b, a = signal.bilinear([w**2, 0.0, 0.0], [1.0, 2.0 * damping * w, w**2], RATE)
    felt = signal.lfilter(b, a, roads, axis=1) + noise * rng.standard_normal(roads.shape)
    state = np.zeros((t.size, 4), dtype=bool)
    record = Record(t, felt, np.full(t.size, SPEED), odometer, state, state, length)
    stations = profile_stations(length)
    return record, Profile(stations, np.array([np.interp(stations, s, path) for path in z]))


@cache
def fit(name: str, seeds=(1, 2, 3), seed: int = 0, **settings):
    """An estimator ready to be asked; fitted once for all tests."""
    estimator = create(name, **{**SMALL.get(name, {}), **settings})
    records, truths = zip(*(drive(s) for s in seeds), strict=True)
    return estimator.fit(records, truths, CAR, seed) if hasattr(estimator, "fit") else estimator


@pytest.fixture(scope="module", params=REGISTRY)
def estimator(request):
    """Each estimator of the registry, trained if it learns."""
    return fit(request.param)


def error(estimate: Estimate, truth: Profile) -> float:
    """RMS error over RMS truth."""
    return float(np.sqrt(np.mean((estimate.z - truth.z) ** 2) / np.mean(truth.z**2)))


def copied(holder: Record | Profile) -> dict:
    """A deep copy of the arrays of a record or profile."""
    return {key: np.copy(value) for key, value in vars(holder).items()}


def test_an_estimate_is_valid(estimator):
    record, _ = drive(100)
    check_estimate(estimator.estimate(record, CAR), record)


def test_roads_of_other_lengths_than_in_training_are_estimated(estimator):
    for length in (7.0, 33.0):
        record, _ = drive(101, length)
        check_estimate(estimator.estimate(record, CAR), record)


def test_equal_records_give_equal_estimates(estimator):
    record, _ = drive(102)
    once, again = estimator.estimate(record, CAR), estimator.estimate(record, CAR)
    np.testing.assert_array_equal(once.z, again.z)
    assert once.notes == again.notes


def test_the_record_is_not_modified(estimator):
    record, _ = drive(103)
    before = copied(record)
    estimator.estimate(record, CAR)
    for key, value in before.items():
        np.testing.assert_array_equal(getattr(record, key), value)


def test_a_record_shorter_than_the_road_gives_a_complete_estimate(estimator):
    record, _ = drive(104)
    on_road = (record.s >= 0.3) & (record.s <= record.length - 0.3)
    cut = {
        key: getattr(record, key)[on_road] for key in ("t", "v", "s", "spring_stiff", "damper_high")
    }
    short = replace(record, a=record.a[:, on_road], **cut)
    check_estimate(estimator.estimate(short, CAR), short)


@pytest.mark.parametrize("name", [name for name, cls in REGISTRY.items() if cls.causal])
def test_a_causal_estimator_does_not_use_the_future(name):
    estimator = fit(name)
    record, _ = drive(105)
    later = record.s > 10.0
    changed = replace(record, a=np.where(later, -3.0 * record.a, record.a))
    before, after = estimator.estimate(record, CAR), estimator.estimate(changed, CAR)
    past = before.s <= 10.0 - (getattr(estimator, "lag", None) or 0.0)
    assert past.any()
    np.testing.assert_array_equal(before.z[:, past], after.z[:, past])
    if before.z_std is not None:
        np.testing.assert_array_equal(before.z_std[:, past], after.z_std[:, past])


def test_a_stored_estimator_gives_the_same_estimate(estimator, tmp_path):
    record, _ = drive(106)
    save(estimator, tmp_path / "kept.npz")
    kept = load(tmp_path / "kept.npz")
    assert kept == estimator
    before, after = estimator.estimate(record, CAR), kept.estimate(record, CAR)
    np.testing.assert_array_equal(before.z, after.z)
    assert before.notes == after.notes


def test_the_fitted_state_is_excluded_from_equality_hash_and_repr(estimator):
    fresh = replace(estimator)
    assert fresh == estimator
    assert hash(fresh) == hash(estimator)
    assert "array" not in repr(estimator)


@pytest.mark.parametrize("name", LEARNING)
def test_fitting_twice_with_one_seed_gives_the_same(name):
    one, same = fit(name).weights(), fit.__wrapped__(name).weights()
    assert one.keys() == same.keys()
    for key in one:
        np.testing.assert_array_equal(one[key], same[key])


@pytest.mark.parametrize("name", LEARNING)
def test_fitting_does_not_modify_the_estimator_or_the_drives(name):
    fresh = create(name, **SMALL.get(name, {}))
    record, truth = drive(1)
    before = copied(record), copied(truth)
    fresh.fit([record], [truth], CAR, 0)
    for holder, kept in zip((record, truth), before, strict=True):
        for key, value in kept.items():
            np.testing.assert_array_equal(getattr(holder, key), value)
    with pytest.raises(NotFittedError):
        fresh.weights()


@pytest.mark.parametrize("name", LEARNING)
def test_an_unfitted_estimator_raises_not_fitted_error(name):
    record, _ = drive(107)
    fresh = create(name, **({"shipped": False} if name in READY else {}))
    assert isinstance(fresh, Trainable)
    with pytest.raises(NotFittedError, match=r"must be fitted before it can estimate: call fit\("):
        fresh.estimate(record, CAR)


@pytest.mark.parametrize("name", LEARNING)
def test_invalid_weights_are_rejected(name):
    estimator = fit(name)
    weights = estimator.weights()
    first = next(iter(weights))
    with pytest.raises(ValueError, match="are wanted, got"):
        estimator.with_weights({key: weights[key] for key in weights if key != first})
    with pytest.raises(ValueError, match=rf"{first}: shape \(.*\) is wanted"):
        estimator.with_weights({**weights, first: np.zeros((1, 1, 1, 1))})
    with pytest.raises(ValueError, match=f"{first}: every value must be finite, nan stands at"):
        estimator.with_weights({**weights, first: np.full(weights[first].shape, np.nan)})


def test_weights_of_the_wrong_type_are_rejected():
    with pytest.raises(ValueError, match="w: an array of real numbers is wanted, got <U4"):
        validate_weights({"w": np.array("text")}, {"w": ()})
    with pytest.raises(ValueError, match="w: an array of real numbers is wanted, got list"):
        validate_weights({"w": [1.0]}, {"w": (1,)})


FAULTS = {
    "an Estimate is wanted, got tuple": lambda e: (e.s, e.z),
    r"heights z: shape \(2, 792\) is wanted, got \(1, 792\)": lambda e: replace(e, z=e.z[:1]),
    r"heights z: shape \(2, 792\) is wanted, got \(2, 791\)": lambda e: replace(e, z=e.z[:, 1:]),
    r"stations s: shape \(792\) is wanted": lambda e: replace(e, s=e.s[1:]),
    "heights z: an array of real numbers is wanted, got complex128": lambda e: replace(
        e, z=e.z + 1j
    ),
    "heights z: an array of real numbers is wanted, got NoneType": lambda e: replace(e, z=None),
    r"heights z: every value must be finite, nan stands at \(1, 3\)": lambda e: replace(
        e, z=with_value(e.z, np.nan)
    ),
    "heights z: every value must be finite, inf stands": lambda e: replace(
        e, z=with_value(e.z, np.inf)
    ),
    "stations s must increase": lambda e: replace(e, s=e.s[::-1]),
    r"stations s must be grid\(20\)": lambda e: replace(e, s=e.s + 0.01),
    r"standard deviations z_std: shape \(2, 792\) is wanted": lambda e: replace(e, z_std=e.s),
    "standard deviations z_std must not be negative": lambda e: replace(
        e, z_std=-np.ones_like(e.z)
    ),
}


def with_value(z: np.ndarray, value: float) -> np.ndarray:
    """`z` with one value put in."""
    z = z.copy()
    z[1, 3] = value
    return z


@pytest.mark.parametrize("sentence", FAULTS)
def test_an_invalid_estimate_is_rejected_with_the_reason(sentence):
    record, truth = drive(108)
    good = Estimate(truth.s, truth.z, z_std=np.ones_like(truth.z))
    check_estimate(good, record)
    with pytest.raises(EstimateError, match=sentence):
        check_estimate(FAULTS[sentence](good), record)


def test_flat_is_flat():
    record, _ = drive(109)
    assert not fit("flat").estimate(record, CAR).z.any()


def test_the_mean_is_taken_over_the_roads_that_reach_a_station():
    short, long = profile_stations(1.0), profile_stations(2.0)
    truths = [
        Profile(short, np.array([np.full(short.size, 1.0), np.full(short.size, 4.0)])),
        Profile(long, np.array([np.full(long.size, 3.0), np.full(long.size, 8.0)])),
    ]
    z = mean_profile(truths)
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
    """Two independent class-D paths: integrated white noise, shaped to the waviness `w`."""
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
    G_d0, fitted_w = fit_spectrum(truths)
    assert fitted_w == pytest.approx(w, abs=0.1)
    assert 10.0 * np.log10(G_d0 / 1024e-6) == pytest.approx(0.0, abs=1.0)


def test_the_unrelated_road_has_the_density_it_was_given():
    z = np.concatenate([draw_road(FittedRoad(1024e-6, 2.0, seed), 20_000) for seed in range(8)])
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
        guess = create("unrelated_road").fit([record], truths, CAR, seed).estimate(record, CAR)
        truth = class_d(100 + seed)
        sos = signal.butter(4, [0.2, 1.8], "band", fs=1.0 / PROFILE_SPACING, output="sos")
        a, b = (signal.sosfiltfilt(sos, z, axis=1) for z in (guess.z, truth.z))
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


def test_the_network_learns_heights_that_depend_on_one_sample():
    """Heights that are a function of the accelerations there and then."""

    def told(seed):
        record, _ = drive(seed)
        a = spatial_accelerations(record)
        return record, Profile(
            profile_stations(record.length), 0.01 * np.array([np.tanh(a[0]), a[1] * a[2]])
        )

    records, truths = zip(*(told(seed) for seed in (1, 2, 3)), strict=True)
    network = create("static_lm", hidden=10).fit(records, truths, CAR, 0)
    record, truth = told(113)
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
    assert "fitted at 4.0 m/s, driven at 8.0 m/s" in window.estimate(faster, CAR).notes


def test_the_tap_spacing_is_that_of_the_band_limit():
    """At 4 m/s nothing above 6.25 cycles/m is left: 80 mm apart, three steps of the grid."""
    fitted_state = fit("fir_ridge").fitted_state
    assert fitted_state.stride == 3
    assert fitted_state.taps.shape == (2, 3, 2 * int(3.0 / (3 * PROFILE_SPACING)) + 1)


def test_known_taps_are_recovered():
    """Heights made by known taps from the accelerations come back when there is enough to see."""
    rng = np.random.default_rng(0)
    stride, half = 3, int(0.5 / (3 * PROFILE_SPACING))
    coefficients = rng.standard_normal((3 * (2 * half + 1), 2))
    sums = fir_ridge.LeastSquaresSums.zeros(len(coefficients))
    for seed in range(4):
        X = fir_ridge.sliding_windows(drive(seed, noise=1.0)[0], stride, half)
        sums = sums.plus(fir_ridge.LeastSquaresSums.from_samples(X, X @ coefficients))
    np.testing.assert_allclose(sums.solve(1e-12), coefficients, rtol=1e-4)


def test_estimating_tap_by_tap_equals_the_windows_of_training():
    window = fit("fir_ridge")
    record, _ = drive(120)
    taps, stride, _, _ = window.fitted_state
    X = fir_ridge.sliding_windows(record, stride, taps.shape[2] // 2)
    z = window.estimate(record, CAR).z[:, ::stride]
    np.testing.assert_allclose(taps.reshape(2, -1) @ X.T, z, atol=1e-12)


def test_the_ridge_is_the_least_squares_problem_with_a_penalty_row_for_each_tap():
    rng = np.random.default_rng(1)
    X, Z = rng.standard_normal((60, 9)), rng.standard_normal((60, 2))
    ridge = 0.3
    level = np.mean(np.sum(X**2, axis=0))
    penalty = np.sqrt(ridge * level) * np.eye(9)
    wanted, *_ = np.linalg.lstsq(np.vstack([X, penalty]), np.vstack([Z, np.zeros((9, 2))]))
    sums = fir_ridge.LeastSquaresSums.from_samples(X[:20], Z[:20]).plus(
        fir_ridge.LeastSquaresSums.from_samples(X[20:], Z[20:])
    )
    found = sums.solve(ridge)
    np.testing.assert_allclose(found, wanted, rtol=1e-10, atol=1e-12)
    assert sums.squared_error(found) == pytest.approx(np.sum((Z - X @ found) ** 2), rel=1e-10)


def test_cross_validation_selects_a_strong_ridge_for_noise_only():
    rng = np.random.default_rng(2)
    X = rng.standard_normal((100, 40))
    noise, clear = rng.standard_normal((100, 2)), X @ rng.standard_normal((40, 2))

    def chosen(Z):
        parts = zip(np.split(X, 5), np.split(Z, 5), strict=True)
        return fir_ridge.cross_validate(
            [fir_ridge.LeastSquaresSums.from_samples(*part) for part in parts]
        )[0]

    assert chosen(noise) == fir_ridge.RIDGES[-1]
    assert chosen(clear) == fir_ridge.RIDGES[0]


def test_the_target_keeps_the_band_and_removes_long_waves():
    stations = profile_stations(200.0)
    middle = slice(stations.size // 4, -stations.size // 4)

    def passed(n):
        wave = np.sin(2.0 * np.pi * n * stations)
        kept = fir_ridge.highpass_profile(Profile(stations, np.array([wave, wave])), stations)
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
