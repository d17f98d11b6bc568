"""Contract that every estimator fulfils.

The drives do not come from the simulator: each sensor follows the road under its own wheel through
one resonance, the rear ones a wheelbase later.
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
    uses_seed,
    validate_weights,
)
from estimators.weights_io import load, save
from road_envs.records.record import Estimate, Profile, Record, profile_stations
from road_envs.vehicle.parameters import load_vehicle

CAR = load_vehicle("land_rover_defender_110")
QUICK = {"shipped": False, "steps": 6, "channels": 8}
SMALL = {
    "static_lm": {"hidden": 6, "max_epochs": 8},
    "narx": {"hidden": 4, "max_epochs": 8},
    "fir_ridge": {"reach": 3.0, "shipped": False},
    **dict.fromkeys(("tcn", "tcn_causal", "gru", "gru_causal"), QUICK),
    "iterated_wiener": {"passes": 3},
    "map_smoother": {"adapt": False},  # these records come from no vehicle
}
"""Settings that make the contract tests fast."""
SPEED, RATE, APRON = 8.0, 200.0, 6.0
SEEDS = (1, 2, 3)
"""Of the drives for training."""
TRAINABLE = [name for name, cls in REGISTRY.items() if hasattr(cls, "fit")]
PRETRAINED = [name for name, cls in REGISTRY.items() if hasattr(cls, "pretrain")]
"""Estimators with shipped weights."""


def drive(seed: int, length: float = 20.0, noise: float = 0.02) -> tuple[Record, Profile]:
    """A record and its truth; the road has waves of 0.1 to 2 cycles/m."""
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
    sensed = signal.lfilter(b, a, roads, axis=1) + noise * rng.standard_normal(roads.shape)
    state = np.zeros((t.size, 4), dtype=bool)
    record = Record(t, sensed, np.full(t.size, SPEED), odometer, state, state, length)
    stations = profile_stations(length)
    return record, Profile(stations, np.array([np.interp(stations, s, path) for path in z]))


@cache
def fit(name: str, seeds=SEEDS, seed: int = 0, **settings):
    """An estimator ready for use, fitted once for all tests."""
    estimator = create(name, **{**SMALL.get(name, {}), **settings})
    records, truths = zip(*(drive(s) for s in seeds), strict=True)
    return estimator.fit(records, truths, CAR, seed) if hasattr(estimator, "fit") else estimator


@pytest.fixture(scope="module", params=REGISTRY)
def estimator(request):
    """Each estimator of the registry, fitted if trainable."""
    return fit(request.param)


RECORD, _ = drive(100)


@pytest.fixture(scope="module")
def expected(estimator):
    """The estimate of RECORD."""
    return estimator.estimate(RECORD, CAR)


def error(estimate: Estimate, truth: Profile) -> float:
    """RMS error over RMS truth."""
    return float(np.sqrt(np.mean((estimate.z - truth.z) ** 2) / np.mean(truth.z**2)))


def copy_arrays(holder: Record | Profile) -> dict:
    """A deep copy of the arrays of a record or profile."""
    return {key: np.copy(value) for key, value in vars(holder).items()}


@pytest.mark.costly
def test_an_estimate_is_valid(expected):
    check_estimate(expected, RECORD)


@pytest.mark.costly
def test_roads_of_other_lengths_than_in_training_are_estimated(estimator):
    for length in (7.0, 33.0):
        record, _ = drive(101, length)
        check_estimate(estimator.estimate(record, CAR), record)


@pytest.mark.costly
def test_equal_records_give_equal_estimates_and_are_not_modified(estimator, expected):
    record, _ = drive(100)
    before = copy_arrays(record)
    again = estimator.estimate(record, CAR)
    np.testing.assert_array_equal(again.z, expected.z)
    assert again.notes == expected.notes
    for key, value in before.items():
        np.testing.assert_array_equal(getattr(record, key), value)


@pytest.mark.costly
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


@pytest.mark.costly
def test_a_stored_estimator_gives_the_same_estimate(estimator, expected, tmp_path):
    save(estimator, tmp_path / "kept.npz")
    kept = load(tmp_path / "kept.npz")
    assert kept == estimator
    found = kept.estimate(RECORD, CAR)
    np.testing.assert_array_equal(found.z, expected.z)
    assert found.notes == expected.notes


def test_the_fitted_state_is_excluded_from_equality_hash_and_repr(estimator):
    fresh = replace(estimator)
    assert fresh == estimator
    assert hash(fresh) == hash(estimator)
    assert "array" not in repr(estimator)


@pytest.mark.parametrize("name", TRAINABLE)
@pytest.mark.costly
def test_fitting_again_gives_the_same_and_modifies_neither_estimator_nor_drives(name):
    fresh = create(name, **SMALL.get(name, {}))
    records, truths = zip(*(drive(seed) for seed in SEEDS), strict=True)
    before = [copy_arrays(holder) for holder in (*records, *truths)]
    seed = 0 if uses_seed(fresh) else 1
    one, same = fit(name).weights(), fresh.fit(records, truths, CAR, seed).weights()
    assert one.keys() == same.keys()
    for key in one:
        np.testing.assert_array_equal(one[key], same[key])
    for holder, kept in zip((*records, *truths), before, strict=True):
        for key, value in kept.items():
            np.testing.assert_array_equal(getattr(holder, key), value)
    with pytest.raises(NotFittedError):
        fresh.weights()


@pytest.mark.parametrize("name", TRAINABLE)
def test_an_unfitted_estimator_raises_not_fitted_error(name):
    record, _ = drive(107)
    fresh = create(name, **({"shipped": False} if name in PRETRAINED else {}))
    assert isinstance(fresh, Trainable)
    with pytest.raises(NotFittedError, match=r"must be fitted before it can estimate: call fit\("):
        fresh.estimate(record, CAR)


@pytest.mark.parametrize("name", TRAINABLE)
def test_invalid_weights_are_rejected(name):
    estimator = fit(name)
    weights = estimator.weights()
    first = next(iter(weights))
    with pytest.raises(ValueError, match="expected weights"):
        estimator.with_weights({key: weights[key] for key in weights if key != first})
    with pytest.raises(ValueError, match=rf"{first}: expected shape \(.*\)"):
        estimator.with_weights({**weights, first: np.zeros((1, 1, 1, 1))})
    with pytest.raises(ValueError, match=f"{first}: every value must be finite, got nan at index"):
        estimator.with_weights({**weights, first: np.full(weights[first].shape, np.nan)})


def test_weights_of_the_wrong_type_are_rejected():
    with pytest.raises(ValueError, match="w: expected an array of real numbers, got <U4"):
        validate_weights({"w": np.array("text")}, {"w": ()})
    with pytest.raises(ValueError, match="w: expected an array of real numbers, got list"):
        validate_weights({"w": [1.0]}, {"w": (1,)})


INVALID = {
    "expected an Estimate, got tuple": lambda e: (e.s, e.z),
    r"heights z: expected shape \(2, 792\), got \(1, 792\)": lambda e: replace(e, z=e.z[:1]),
    r"heights z: expected shape \(2, 792\), got \(2, 791\)": lambda e: replace(e, z=e.z[:, 1:]),
    r"stations s: expected shape \(792\)": lambda e: replace(e, s=e.s[1:]),
    "heights z: expected an array of real numbers, got complex128": lambda e: replace(
        e, z=e.z + 1j
    ),
    "heights z: expected an array of real numbers, got NoneType": lambda e: replace(e, z=None),
    r"heights z: every value must be finite, got nan at index \(1, 3\)": lambda e: replace(
        e, z=with_value(e.z, np.nan)
    ),
    "heights z: every value must be finite, got inf": lambda e: replace(
        e, z=with_value(e.z, np.inf)
    ),
    "stations s must increase": lambda e: replace(e, s=e.s[::-1]),
    r"stations s must be profile_stations\(20\)": lambda e: replace(e, s=e.s + 0.01),
    r"standard deviations z_std: expected shape \(2, 792\)": lambda e: replace(e, z_std=e.s),
    "standard deviations z_std must not be negative": lambda e: replace(
        e, z_std=-np.ones_like(e.z)
    ),
}


def with_value(z: np.ndarray, value: float) -> np.ndarray:
    """`z` with one value replaced."""
    z = z.copy()
    z[1, 3] = value
    return z


@pytest.mark.parametrize("sentence", INVALID)
def test_an_invalid_estimate_is_rejected_with_the_reason(sentence):
    record, truth = drive(108)
    good = Estimate(truth.s, truth.z, z_std=np.ones_like(truth.z))
    check_estimate(good, record)
    with pytest.raises(EstimateError, match=sentence):
        check_estimate(INVALID[sentence](good), record)
