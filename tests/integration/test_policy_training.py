"""Training of policies: cases as one vector environment, resumed runs, stored networks."""

import numpy as np
import pytest
from scipy.stats import trim_mean

from leaderboard.policies import grid_search
from leaderboard.policies.grid_search import return_rates
from leaderboard.policies.scenarios import Scenarios
from leaderboard.policies.training_study import evaluate_study, study_lines, train_seeds
from road_envs.core.config import ConfigError, build
from road_envs.envs.vector import RoadReconVectorEnv
from road_envs.policies import PolicyContext
from road_envs.policies.features import (
    FEATURE_SCALES,
    N_FEATURES,
    PREVIEW_DISTANCES,
    FeatureExtractor,
    n_features,
)
from road_envs.policies.network_policy import NetworkPolicy
from road_envs.policies.training import MultiScenarioVecEnv, TrainingConfig, evaluate, train
from road_envs.policies.wheelbase_preview import WheelbasePreview
from road_envs.roads.iso8608 import Iso8608

CASE = {
    "road": "iso_d",
    "length": 8.0,
    "speed_kmh": 54.0,
    "control": "axle",
    "control_rate": 50.0,
    "observe": ["accelerations", "planar", "struts"],
    "truth": False,
}
TURN = {**CASE, "manoeuvre": {"kind": "slalom", "begin": 0.0, "period": 0.8}}
SMALL = TrainingConfig(
    steps=256,
    n_envs=2,
    layers=(8,),
    eval_interval=128,
    hyperparameters={"n_steps": 16, "batch_size": 32, "n_epochs": 2},
)


def scenarios(**changes) -> Scenarios:
    """Return scenarios of two cases of 8 m."""
    settings = {
        "name": "small",
        "title": "Two short cases",
        "cases": [
            {"road": "iso_d", "speed_kmh": 54.0},
            {"road": "iso_d", "speed_kmh": 54.0, "manoeuvre": TURN["manoeuvre"]},
        ],
        "length": 8.0,
        "test": {"first": 101, "number": 3},
        "training": {"first": 1, "number": 2},
    }
    return build(Scenarios, {**settings, **changes}, "small")


def test_actions_are_repeated_and_rewards_are_summed_and_scaled():
    cases = MultiScenarioVecEnv([CASE, TURN], n_envs=2, seed=7, reward_scale=3.0, action_repeat=4)
    first = cases.reset()
    envs = [RoadReconVectorEnv(2, **options) for options in (CASE, TURN)]
    observations = [env.reset(seed=7 + 1_000_000 * (i + 1))[0] for i, env in enumerate(envs)]
    features = [FeatureExtractor(PolicyContext.from_setup(env.setup, 2, 0)) for env in envs]
    expected = [f.update(o) for f, o in zip(features, observations, strict=True)]
    np.testing.assert_array_equal(first, np.concatenate(expected))
    assert first.shape == (4, N_FEATURES) and FEATURE_SCALES.shape == (N_FEATURES,)
    actions = np.array([0, 3, 1, 2])
    after, rewards, dones, _ = cases.step(actions)
    for i, (env, one) in enumerate(zip(envs, features, strict=True)):
        total = np.zeros(2)
        for _ in range(4):
            observations, reward, *_ = env.step(actions[2 * i : 2 * i + 2])
            last, total = one.update(observations), total + reward
        np.testing.assert_array_equal(after[2 * i : 2 * i + 2], last)
        np.testing.assert_allclose(rewards[2 * i : 2 * i + 2], 3.0 * total, rtol=1e-5)
    assert not dones.any()


def test_the_paired_baseline_removes_the_road_from_the_reward():
    """Vehicles in ride get a reward of exactly 0; the others get the difference to ride."""
    cases = MultiScenarioVecEnv(
        [CASE, TURN], n_envs=2, seed=5, reward_scale=10.0, action_repeat=3, paired_baseline=True
    )
    plain = MultiScenarioVecEnv([CASE, TURN], n_envs=2, seed=5, reward_scale=10.0, action_repeat=3)
    alone = MultiScenarioVecEnv([CASE, TURN], n_envs=2, seed=5, reward_scale=10.0, action_repeat=3)
    for envs in (cases, plain, alone):
        envs.reset()
    actions = np.array([0, 3, 0, 1])
    over = False
    for _ in range(30):
        gained, dones = cases.step(actions)[1:3]
        expected = plain.step(actions)[1] - alone.step(np.zeros(4, dtype=int))[1]
        assert not gained[[0, 2]].any()
        np.testing.assert_allclose(gained, expected, atol=1e-5)
        over |= dones.any()
    assert over


def test_the_vehicles_of_a_pair_share_one_road(monkeypatch):
    drawn, realise = [], Iso8608.realise
    monkeypatch.setattr(Iso8608, "realise", lambda *args: drawn.append(args) or realise(*args))
    cases = MultiScenarioVecEnv([CASE], n_envs=3, seed=5, reward_scale=1.0, paired_baseline=True)
    cases.reset()
    assert len(drawn) == 3


def test_preview_features_are_the_heights_ahead_of_the_rear_axle():
    cases = MultiScenarioVecEnv([CASE], n_envs=2, seed=7, reward_scale=1.0, preview=True)
    cases.reset()
    env = RoadReconVectorEnv(2, **CASE)
    observations = env.reset(seed=1_000_007)[0]
    context = PolicyContext.from_setup(env.setup, 2, 0)
    road = WheelbasePreview(context)
    road.update(observations)
    for _ in range(25):
        features = cases.step(np.zeros(2, dtype=int))[0]
        road.update(env.step(np.zeros(2, dtype=int))[0])
    z = road.heights_at(PREVIEW_DISTANCES)
    rise = 20.0 * (z[:, 1:] - z[:, :1])
    assert features.shape == (2, n_features(True)) and np.abs(rise).max() > 0.1
    np.testing.assert_allclose(
        features[:, N_FEATURES : N_FEATURES + 6], rise.mean(axis=2), atol=1e-5
    )
    np.testing.assert_allclose(
        features[:, N_FEATURES + 6 :], 0.5 * (rise[..., 0] - rise[..., 1]), atol=1e-5
    )


def test_a_study_evaluates_all_seeds_and_keeps_the_best_network(monkeypatch):
    some = scenarios(test={"first": 101, "number": 4})
    learning = train_seeds(SMALL, some, [3, 4])
    assert learning.scores == [max(v for _, v in curve) for curve in learning.curves]
    best = learning.networks[int(np.argmax(learning.scores))]
    assert learning.best is best
    study = evaluate_study(learning, some)
    each = [
        return_rates(NetworkPolicy.from_network(n), some, some.test.seeds)
        for n in learning.networks
    ]
    assert study["seeds"] == [3, 4] and study["roads"] == 4
    assert study["spread"] == pytest.approx(np.std([x.mean() for x in each], ddof=1))
    middle = [trim_mean(np.stack(each, axis=2)[:, c].ravel(), 0.25) for c in range(2)]
    assert study["held_out"]["mean"] == pytest.approx(np.mean(middle))
    more = study["more_than"]["fixed_ride"]
    assert more["low"] <= more["mean"] <= more["high"]
    assert any("rrms" in line for line in study_lines("ppo", study))


def test_an_episode_that_ends_during_a_repeat_is_reported_as_ended():
    cases = MultiScenarioVecEnv([CASE], n_envs=2, seed=1, reward_scale=1.0, action_repeat=7)
    cases.reset()
    for _ in range(40):
        _, _, dones, infos = cases.step(np.zeros(2, dtype=int))
        if dones.any():
            break
    assert dones.all()
    for info in infos:
        assert info["TimeLimit.truncated"] and info["terminal_observation"].shape == (N_FEATURES,)


def test_training_is_reproducible_and_its_network_can_drive(tmp_path):
    result = [train(SMALL, [CASE, TURN], [1, 2], seed=3) for _ in range(2)]
    for (W, b), (W_2, b_2) in zip(*(x.network.layers for x in result), strict=True):
        np.testing.assert_array_equal(W, W_2)
        np.testing.assert_array_equal(b, b_2)
    assert [steps for steps, _ in result[0].curve] == [128, 256]
    assert max(value for _, value in result[0].curve) == pytest.approx(
        evaluate(result[0].network, [CASE, TURN], [1, 2])
    )
    path = tmp_path / "n.npz"
    grid_search.write_bytes(path, result[0].network.to_bytes())
    assert NetworkPolicy(file=str(path)).network.metadata["held"] == 5


def test_an_interrupted_training_resumes_from_its_checkpoint(tmp_path):
    checkpoint = tmp_path / "run.pt"
    calls = []

    def stop(text, share):
        calls.append(share)
        if share > 0.5:
            raise KeyboardInterrupt

    config = TrainingConfig(**{**vars(SMALL), "steps": 1024, "eval_interval": 256})
    with pytest.raises(KeyboardInterrupt):
        train(config, [CASE], [1], 3, checkpoint=checkpoint, progress=stop)
    before = checkpoint.read_bytes()
    resumed = train(config, [CASE], [1], 3, checkpoint=checkpoint)
    assert [steps for steps, _ in resumed.curve] == [256, 512, 768, 1024]
    other = TrainingConfig(**{**vars(config), "steps": 2048})
    with pytest.raises(ConfigError, match=r"run\.pt: belongs to other settings"):
        train(other, [CASE], [1], 3, checkpoint=checkpoint)
    checkpoint.write_bytes(before[: len(before) // 2])
    with pytest.raises(ConfigError, match=r"run\.pt: not a checkpoint"):
        train(config, [CASE], [1], 3, checkpoint=checkpoint)


def test_deep_q_learning_trains_a_network():
    hyper = {"learning_starts": 32, "batch_size": 16, "train_freq": 4, "buffer_size": 500}
    config = TrainingConfig(
        algorithm="dqn", steps=128, n_envs=2, layers=(8,), eval_interval=128, hyperparameters=hyper
    )
    result = train(config, [CASE], [1], seed=1)
    assert result.network.layers[-1][0].shape == (4, 8)
    assert result.network.metadata["activation"] == "relu"


@pytest.mark.parametrize("name", ["ppo", "ppo_preview", "ppo_sensing", "dqn"])
def test_shipped_training_settings_are_complete(name):
    assert grid_search.load_training_config(name, steps=5).steps == 5


def test_invalid_training_settings_are_named():
    with pytest.raises(ConfigError, match=r"hyperparameters of ppo: .*learning_rat"):
        train(TrainingConfig(hyperparameters={"learning_rat": 1.0}), [CASE], [1], seed=1)
    with pytest.raises(ConfigError, match="rrms has no training section"):
        grid_search.load_training_config("rrms")
    with pytest.raises(ValueError, match="must be at least 1"):
        TrainingConfig(steps=0)
