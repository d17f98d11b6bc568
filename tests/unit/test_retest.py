"""What a second guest is asked: drives that go on in another way from a secret point on."""

import random
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.signal import butter, sosfiltfilt

from leaderboard.entries.entry import TrainingRun
from leaderboard.sandbox.retest import (
    REMEMBERS,
    UNTESTABLE,
    compare_answers,
    draw_questions,
    largest_change,
    with_other_future,
)
from road_envs import simulate_record
from road_envs.records.record import Estimate, profile_stations


@pytest.fixture(scope="module")
def record():
    return simulate_record("iso_d", speed_kmh=54, length=100.0, seed=3)[0]


@pytest.mark.parametrize("seed", range(4))
def test_no_level_of_what_follows_is_left_and_what_came_before_is(record, seed):
    """Of a level in steps of 6 dB, or of the slow waves, an entry would know without being seen."""
    start = 45.0
    other = with_other_future(record, start, np.random.default_rng(seed))
    before = record.s < start
    for name in ("a", "v", "s"):
        ours, theirs = (np.asarray(getattr(x, name)) for x in (record, other))
        np.testing.assert_array_equal(ours[..., before], theirs[..., before])
    slow = butter(4, (1.0, 15.0), "bandpass", fs=record.fs, output="sos")
    levels = [
        20.0 * np.log10(np.std(sosfiltfilt(slow, x.a[:, ~before], axis=1), axis=1))
        for x in (record, other)
    ]
    assert (np.abs(levels[1] - levels[0]) > 3.0).all()
    waves = [sosfiltfilt(slow, x.a[:, ~before], axis=1).ravel() for x in (record, other)]
    assert abs(np.corrcoef(*waves)[0, 1]) < 0.3


def test_no_replaced_odometer_ends_before_the_rear_axle_is_at_the_end_of_the_road(record):
    """Who interpolates over the stations there must not fail: that counts as looking ahead."""
    long = replace(record, s=3.0 * record.s, v=3.0 * record.v, length=300.0)
    for seed in range(40):
        other = with_other_future(long, 20.0, np.random.default_rng(seed))
        assert 0.5 < abs(other.s[-1] - long.s[-1]) < 3.0 + 1e-9


@pytest.mark.parametrize("kmh", [14.5, 54.0, 100.0])
def test_a_replaced_speed_is_that_of_a_car_and_of_its_odometer(record, kmh):
    constant = replace(record, v=np.full_like(record.v, kmh / 3.6), t=record.t * 54.0 / kmh)
    for seed in range(10):
        other = with_other_future(constant, 45.0, np.random.default_rng(seed))
        assert 1.0 < np.abs(np.diff(other.v)).max() / np.diff(constant.t).min() < 9.0
        assert 0.009 < abs(other.v[-1] / constant.v[-1] - 1.0) < 0.031
        way = cumulative_trapezoid(other.v, constant.t, initial=0.0)
        assert np.abs(way - other.s + other.s[0]).max() < 0.2


def test_of_one_drive_what_is_replaced_first_is_asked_first(record):
    """Else the second guest would know how it goes on when it is asked what comes before."""
    for seed in range(5):
        asked = draw_questions([record], [0], True, random.Random(seed))
        starts = [question.start for question in asked]
        assert len(starts) == 4 and starts == sorted(starts) and np.isinf(starts[-1])


class _Adaptive:
    """Causal in time: its gain is a mean over all samples so far, those of drives before included.
    The other is random.
    """

    def __init__(self, is_random):
        self._rng, self._sum, self._random = np.random.default_rng(), 1.0, is_random

    def estimate(self, record):
        gain = self._sum + np.cumsum(record.a[0] ** 2)
        if self._random:
            gain = self._rng.random(gain.size)
        stations = profile_stations(record.length)
        last = np.searchsorted(record.s, stations, side="right") - 1
        self._sum = gain[-1]
        return Estimate(stations, np.tile((record.a[0] / gain)[last.clip(0)], (2, 1)))


@pytest.mark.parametrize("is_random", [False, True])
def test_who_remembers_is_not_said_to_look_ahead(record, is_random):
    """Its second guest has seen other drives before those that are replaced, too."""
    records = [replace(record, a=(1.0 + k) * record.a) for k in range(4)]
    for seed in range(10):
        questions = draw_questions(records, range(4), True, random.Random(seed))
        first, second = _Adaptive(is_random), _Adaptive(is_random)
        run = TrainingRun([first.estimate(x) for x in records], 0.0, 0.0, 0)
        again = [second.estimate(question.record) for question in questions]
        assert compare_answers(questions, run, again, 0.0) == [REMEMBERS, UNTESTABLE]


@pytest.mark.parametrize("ahead", [0.3, 2.0])
def test_who_corrects_an_odometer_that_wanders_does_not_look_ahead(record, ahead):
    """Where the odometer says 45 m, who knows better is at 45.3 m, whose height may depend on all
    that follows; at 47 m nobody is, by odometer or speed.
    """
    wander = 0.4 * np.sin(2.0 * np.pi * record.s / 30.0)
    wanders = replace(record, s=record.s + wander)
    s = np.arange(0.0, 100.0, 0.05)
    first = Estimate(s, np.zeros((2, s.size)))
    changed = replace(first, z=np.where(s > 45.0 - ahead, 1e-3, 0.0) * np.ones((2, 1)))
    found = largest_change(first, changed, 45.0, 0.0, wanders)
    assert found == (0.0 if ahead < 0.8 else 1e-3)
    assert largest_change(first, changed, 45.0, 0.0, record) == 1e-3
