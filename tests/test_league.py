"""Policies are compared on the same roads; what one does wrong is its own row."""

import gymnasium as gym
import numpy as np
import pytest

from leaderboard import league
from road_envs.config import ConfigError
from road_envs.policies import REGISTRY, Learner

SCENARIO = {"road": "iso_d", "speed_kmh": 54.0, "length": 20.0}
SEEDS = (1001, 1002, 1003)


class Recorder:
    """Ride, noting what it is shown."""

    def __init__(self):
        self.seen = []

    def reset(self, actions, seed):
        self.seen.append([])

    def act(self, observation):
        self.seen[-1].append(observation)
        return 0


def test_the_metrics_are_those_of_the_drive():
    env = gym.make("RoadRecon-v0", **SCENARIO)
    policy = Recorder()
    metrics = league.episode(policy, env, 1001)
    env.reset(seed=1001)
    over, comfort, total = False, [], 0.0
    while not over:
        _, reward, terminated, truncated, info = env.step(0)
        over = terminated or truncated
        comfort.append(info["comfort"])
        total += reward
    assert metrics["comfort"] == pytest.approx(np.sqrt(np.mean(np.square(comfort))), rel=1e-12)
    assert metrics["episode_return"] == pytest.approx(total, rel=1e-12)
    assert metrics["switches_per_km"] == 0.0
    assert len(policy.seen[0]) == len(comfort)


def test_switches_are_counted_per_kilometre():
    env = gym.make("RoadRecon-v0", **SCENARIO, control_rate=10.0)

    class Toggle(Recorder):
        def act(self, observation):
            super().act(observation)
            return len(self.seen[-1]) % 2

    policy = Toggle()
    metrics = league.episode(policy, env, 1)
    metres = 15.0 * 0.1 * len(policy.seen[0])
    assert metrics["switches_per_km"] == pytest.approx(1000.0 * (len(policy.seen[0]) - 1) / metres)


def test_handling_is_harsher_and_uses_less_rattle_space_than_ride():
    ride, handling = league.compare(
        ["fixed_ride", "fixed_handling"], scenario=SCENARIO, seeds=SEEDS
    )
    assert (handling.drives["comfort"] > ride.drives["comfort"]).all()
    assert (handling.drives["rattle"] < ride.drives["rattle"]).all()


def test_a_policy_that_fails_is_a_row_and_the_others_stand(monkeypatch):
    class Broken(Recorder):
        def act(self, observation):
            raise RuntimeError("no idea")

    class Outside(Recorder):
        def act(self, observation):
            return 7

    monkeypatch.setitem(REGISTRY, "broken", Broken)
    monkeypatch.setitem(REGISTRY, "outside", Outside)
    alone = league.compare(["fixed_ride"], scenario=SCENARIO, seeds=SEEDS)[0]
    broken, outside, ride = league.compare(
        ["broken", "outside", "fixed_ride"], scenario=SCENARIO, seeds=SEEDS
    )
    assert broken.failure == "RuntimeError: no idea"
    assert "one of 0 to 1, got 7" in outside.failure
    assert ride.failure is None
    for name, values in alone.drives.items():
        np.testing.assert_array_equal(ride.drives[name], values)


def test_training_never_meets_the_test_roads():
    with pytest.raises(ConfigError, match="seed 1 is for training"):
        league.compare(["fixed_ride"], scenario=SCENARIO, seeds=[1, 2])


def test_a_learner_learns_by_seed_and_never_sees_the_truth():
    rows = [
        league.compare(["ppo"], scenario=SCENARIO, seeds=SEEDS, learning_steps=1024)[0]
        for _ in range(2)
    ]
    assert rows[0].failure is None
    for name in league.METRICS:
        np.testing.assert_array_equal(rows[0].drives[name], rows[1].drives[name])
    assert isinstance(REGISTRY["ppo"](), Learner)
    assert not isinstance(REGISTRY["random"](), Learner)
