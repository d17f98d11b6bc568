"""Probes see what an estimator does with what was sensed, and let honest ones pass."""

import dataclasses
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import numpy as np
import pytest
from fakes import Learner

import estimators
from leaderboard.conformance.probes import PROBES, count_passed, perturbed_records, probe_estimator
from road_envs.data.record import Estimate, profile_stations
from road_envs.data.recording import simulate_record
from road_envs.roads import Surface, load_road
from road_envs.sensing.filters import preprocess_accelerations
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
        CAR, road(seed), speed_kmh=30.0, mode="handling", instruments=PAPER, seed=seed
    )


def verdicts(estimator, **options):
    return {p.name: p for p in probe_estimator(estimator, drive()[0], CAR, **options)}


def refused(estimator, **options):
    """The probes that an estimator does not pass."""
    return {name for name, p in verdicts(estimator, **options).items() if p.passed is False}


@dataclass(frozen=True, kw_only=True)
class Sums:
    """Left is made of one rear accelerometer, right of the other: odd, proportional, symmetric."""

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
    """Says that it is causal; `filtered` says whether it is."""

    causal: ClassVar[bool] = True

    filtered: bool = True
    lag: float = 0.0

    def estimate(self, record, car):
        a = preprocess_accelerations(record.a, record.fs, causal=self.filtered)
        ahead = np.minimum(profile_stations(record.length) + self.lag, record.length)
        return Estimate(profile_stations(record.length), -0.01 * record.interpolate(ahead, a[1:]))


def test_every_probe_is_answered_and_an_honest_estimator_passes():
    found = verdicts(Sums())
    assert tuple(found) == PROBES
    assert {name for name, p in found.items() if p.passed} == set(PROBES) - {"future"}
    assert found["future"].passed is None and "offline: looks " in found["future"].message
    assert count_passed(list(found.values())) == "5/5" and count_passed([]) == ""


@pytest.mark.parametrize(
    ("how", "wanted"),
    [
        ("even", {"sign"}),
        ("normalised", {"scale"}),
        ("left only", {"swap"}),
        ("crossed", {"swap"}),
        ("moody", {"repeat"}),
    ],
)
def test_each_vice_fails_its_probe_and_no_other(how, wanted):
    assert refused(Sums(how=how)) == wanted


@pytest.mark.parametrize("name", ["flat", "mean", "unrelated_road"])
def test_what_measures_nothing_fails_the_probes_of_measuring(name):
    found = refused(estimators.create(name), training=[drive(2), drive(3)])
    assert {"sign", "scale", "shuffle", "swap"} == found


def test_a_window_passes_and_is_trained_twice():
    found = verdicts(estimators.create("fir_ridge"), training=[drive(2), drive(3)])
    assert all(p.passed is not False for p in found.values())
    assert "run twice with one seed: 0 mm apart" in found["repeat"].message


def test_a_training_that_the_seed_does_not_decide_is_seen():
    class Moody(Learner):
        def fit(self, records, truths, car, seed):
            return super().fit(records, truths, car, np.random.SeedSequence())

    found = verdicts(Moody(), training=[drive(2)])["repeat"]
    assert found.passed is False and found.message.startswith("asked twice: 0 mm apart")


def test_who_looks_ahead_is_not_causal():
    assert "future" not in refused(Online())
    cheat = verdicts(Online(filtered=False))["future"]
    assert cheat.passed is False and "what comes later changes" in cheat.message


def test_a_fixed_lag_is_allowed_what_it_says_and_no_more():
    assert verdicts(Online(lag=2.0))["future"].passed
    assert "2 m behind the front axle" in verdicts(Online(lag=2.0))["future"].message

    class Hasty(Online):
        def estimate(self, record, car):
            return Online(lag=3.0).estimate(record, car)

    assert verdicts(Hasty(lag=2.0))["future"].passed is False


@pytest.mark.parametrize("mode", ["handling", {"front": "ride", "rear": "handling"}])
def test_the_swapped_record_is_the_one_of_the_mirrored_road(mode):
    """Driven on the mirrored road itself, without noise."""
    record, mirrored = (record_on(mirror, mode) for mirror in (False, True))
    swapped = perturbed_records(record, SILENT)["swap"]
    np.testing.assert_allclose(swapped.a, mirrored.a, atol=0.02 * mirrored.a.std())
    np.testing.assert_array_equal(swapped.spring_stiff, mirrored.spring_stiff)
    assert np.abs(record.a - mirrored.a).max() > mirrored.a.std()


def record_on(mirror, mode):
    surface = road(5)
    z = np.ascontiguousarray(surface.z[::-1] if mirror else surface.z)
    one = Surface(z, surface.ds, surface.start)
    return simulate_record(CAR, one, speed_kmh=30.0, mode=mode, instruments=SILENT, seed=1)[0]


def test_struts_change_sides_with_the_accelerometers():
    record, _ = drive()
    stiff = record.spring_stiff.copy()
    stiff[:, [0, 3]] = False  # front left and rear right soft, the others as they were
    stiff[:, [1, 2]] = True
    swapped = perturbed_records(dataclasses.replace(record, spring_stiff=stiff), PAPER)["swap"]
    np.testing.assert_array_equal(swapped.spring_stiff, ~stiff)


def test_the_future_begins_in_the_middle():
    record, _ = drive()
    changed = perturbed_records(record, PAPER)["future"].a != record.a
    assert not changed[:, record.s < 0.5 * record.length].any()
    assert changed[:, record.s >= 0.5 * record.length].all()
