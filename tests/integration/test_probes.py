"""Probes: a valid estimator passes, each defect fails its own probe."""

import dataclasses
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np
import pytest
from fake_estimators import Learner

import estimators
from leaderboard.conformance.probes import PROBES, count_passed, perturbed_records, probe_estimator
from road_envs.drives.recording import simulate_record
from road_envs.kernels.filters import preprocess_accelerations
from road_envs.records.record import Estimate, profile_stations
from road_envs.roads import Surface, load_road
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle

CAR = load_vehicle("land_rover_defender_110")
PAPER = load_instruments("paper")
SILENT = dataclasses.replace(PAPER, noise_density=0.0)


def road(seed):
    drawn = load_road({"kind": "iso8608", "road_class": "D", "length": 60.0, "coherence": "none"})
    return drawn.realise(np.random.default_rng(seed))


@cache
def drive(seed=1):
    return simulate_record(
        road(seed), vehicle=CAR, speed_kmh=30.0, mode="handling", instruments=PAPER, seed=seed
    )


def probe_results(estimator, **options):
    return {p.name: p for p in probe_estimator(estimator, drive()[0], CAR, **options)}


def failed(estimator, **options):
    """Return the probes that an estimator fails."""
    return {name for name, p in probe_results(estimator, **options).items() if p.passed is False}


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Each wheel path is proportional to its rear acceleration; `how` adds a defect."""

    causal: ClassVar[bool] = False

    how: str = ""

    def estimate(self, record, car):
        a = preprocess_accelerations(record.a, record.fs)
        if self.how == "even":
            a = np.abs(a)
        if self.how == "normalised":
            a = a / a.std()
        z = -0.01 * record.interpolate(profile_stations(record.length), a[1:])
        if self.how == "left only":
            z[1] = 0.0
        if self.how == "crossed":
            z = np.stack([z[0], -z[0]])
        if self.how == "moody":
            z = z + 1e-6 * np.random.default_rng().standard_normal(z.shape)
        return Estimate(profile_stations(record.length), z)


@dataclass(frozen=True, kw_only=True)
class Online(Sums):
    """Claims to be causal, which is true only if `filtered`."""

    causal: ClassVar[bool] = True

    filtered: bool = True
    lag: float = 0.0

    def estimate(self, record, car):
        a = preprocess_accelerations(record.a, record.fs, causal=self.filtered)
        ahead = np.minimum(profile_stations(record.length) + self.lag, record.length)
        return Estimate(profile_stations(record.length), -0.01 * record.interpolate(ahead, a[1:]))


def test_a_valid_estimator_passes_all_applicable_probes():
    results = probe_results(Sums())
    assert tuple(results) == PROBES
    assert {name for name, p in results.items() if p.passed} == set(PROBES) - {"future"}
    assert (
        results["future"].passed is None
        and "offline: uses samples up to " in results["future"].message
    )
    assert count_passed(list(results.values())) == "5/5" and count_passed([]) == ""


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ("even", {"sign"}),
        ("normalised", {"scale"}),
        ("left only", {"swap"}),
        ("crossed", {"swap"}),
        ("moody", {"repeat"}),
    ],
)
def test_each_defect_fails_only_its_own_probe(how, expected):
    assert failed(Sums(how=how)) == expected


@pytest.mark.parametrize("name", ["flat", "mean", "unrelated_road"])
def test_estimators_that_ignore_the_record_fail_four_probes(name):
    results = failed(estimators.create(name), training=[drive(2), drive(3)])
    assert {"sign", "scale", "shuffle", "swap"} == results


def test_fir_ridge_passes_all_probes_and_is_trained_twice():
    results = probe_results(estimators.create("fir_ridge"), training=[drive(2), drive(3)])
    assert all(p.passed is not False for p in results.values())
    assert "trained twice with one seed: 0 mm apart" in results["repeat"].message


def test_a_training_that_ignores_the_seed_fails_the_repeat_probe():
    class Moody(Learner):
        def fit(self, records, truths, car, seed):
            return super().fit(records, truths, car, np.random.SeedSequence())

    results = probe_results(Moody(), training=[drive(2)])["repeat"]
    assert results.passed is False and results.message.startswith("estimated twice: 0 mm apart")


def test_a_non_causal_estimator_that_claims_causality_fails():
    assert "future" not in failed(Online())
    cheat = probe_results(Online(filtered=False))["future"]
    assert cheat.passed is False and "later samples change the estimate" in cheat.message


def test_an_estimator_may_use_its_declared_lag_and_not_more():
    assert probe_results(Online(lag=2.0))["future"].passed
    assert "2 m behind the front axle" in probe_results(Online(lag=2.0))["future"].message

    class Hasty(Online):
        def estimate(self, record, car):
            return Online(lag=3.0).estimate(record, car)

    assert probe_results(Hasty(lag=2.0))["future"].passed is False


@pytest.mark.parametrize("mode", ["handling", {"front": "ride", "rear": "handling"}])
def test_the_swapped_record_is_that_of_the_mirrored_road(mode):
    """Compared with a drive on the mirrored road, without noise."""
    record, mirrored = (record_on(mirror, mode) for mirror in (False, True))
    swapped = perturbed_records(record, SILENT)["swap"]
    np.testing.assert_allclose(swapped.a, mirrored.a, atol=0.02 * mirrored.a.std())
    np.testing.assert_array_equal(swapped.spring_stiff, mirrored.spring_stiff)
    assert np.abs(record.a - mirrored.a).max() > mirrored.a.std()


def record_on(mirror, mode):
    surface = road(5)
    z = np.ascontiguousarray(surface.z[::-1] if mirror else surface.z)
    one = Surface(z, surface.ds, surface.start)
    return simulate_record(one, vehicle=CAR, speed_kmh=30.0, mode=mode, instruments=SILENT, seed=1)[
        0
    ]


def test_strut_states_are_swapped_with_the_accelerometers():
    record, _ = drive()
    stiff = record.spring_stiff.copy()
    stiff[:, [0, 3]] = False  # front left and rear right soft, the others stiff
    stiff[:, [1, 2]] = True
    swapped = perturbed_records(dataclasses.replace(record, spring_stiff=stiff), PAPER)["swap"]
    np.testing.assert_array_equal(swapped.spring_stiff, ~stiff)


def test_the_future_probe_changes_only_the_second_half():
    record, _ = drive()
    changed = perturbed_records(record, PAPER)["future"].a != record.a
    assert not changed[:, record.s < 0.5 * record.length].any()
    assert changed[:, record.s >= 0.5 * record.length].all()
