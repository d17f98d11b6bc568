"""Learning on the native environments: cases side by side, resumed runs, stored networks."""

import numpy as np
import pytest
from scipy.stats import trim_mean

from leaderboard.policies import grid_search
from leaderboard.policies.grid_search import return_rates
from leaderboard.policies.scenarios import Scenarios
from leaderboard.policies.training_study import evaluate_study, study_lines, train_seeds
from road_envs.config import ConfigError, build
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
    """Two cases of 8 m."""
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


def test_cases_are_their_environments_with_held_actions_and_scaled_rewards():
    cases = MultiScenarioVecEnv([CASE, TURN], n_envs=2, seed=7, reward_scale=3.0, action_repeat=4)
    first = cases.reset()
    twins = [RoadReconVectorEnv(2, **options) for options in (CASE, TURN)]
    seen = [twin.reset(seed=7 + 1_000_000 * (i + 1))[0] for i, twin in enumerate(twins)]
    features = [FeatureExtractor(PolicyContext.from_setup(twin.setup, 2, 0)) for twin in twins]
    expected = [f.update(o) for f, o in zip(features, seen, strict=True)]
    np.testing.assert_array_equal(first, np.concatenate(expected))
    assert first.shape == (4, N_FEATURES) and FEATURE_SCALES.shape == (N_FEATURES,)
    actions = np.array([0, 3, 1, 2])
    after, rewards, dones, _ = cases.step(actions)
    for i, (twin, one) in enumerate(zip(twins, features, strict=True)):
        total = np.zeros(2)
        for _ in range(4):
            observations, reward, *_ = twin.step(actions[2 * i : 2 * i + 2])
            last, total = one.update(observations), total + reward
        np.testing.assert_array_equal(after[2 * i : 2 * i + 2], last)
        np.testing.assert_allclose(rewards[2 * i : 2 * i + 2], 3.0 * total, rtol=1e-5)
    assert not dones.any()


def test_twins_take_the_road_out_of_the_reward():
    """Who stays in ride gains nothing, to the bit, over many roads; the others what they gain."""
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


def test_a_network_that_looks_ahead_sees_what_lies_before_the_rear_axle():
    cases = MultiScenarioVecEnv([CASE], n_envs=2, seed=7, reward_scale=1.0, preview=True)
    cases.reset()
    twin = RoadReconVectorEnv(2, **CASE)
    seen = twin.reset(seed=1_000_007)[0]
    context = PolicyContext.from_setup(twin.setup, 2, 0)
    road = WheelbasePreview(context)
    road.update(seen)
    for _ in range(25):
        features = cases.step(np.zeros(2, dtype=int))[0]
        road.update(twin.step(np.zeros(2, dtype=int))[0])
    z = road.heights_at(PREVIEW_DISTANCES)
    rise = 20.0 * (z[:, 1:] - z[:, :1])
    assert features.shape == (2, n_features(True)) and np.abs(rise).max() > 0.1
    np.testing.assert_allclose(
        features[:, N_FEATURES : N_FEATURES + 6], rise.mean(axis=2), atol=1e-5
    )
    np.testing.assert_allclose(
        features[:, N_FEATURES + 6 :], 0.5 * (rise[..., 0] - rise[..., 1]), atol=1e-5
    )


def test_seeds_are_judged_together_on_held_out_roads_and_the_best_is_kept(monkeypatch):
    some = scenarios(test={"first": 101, "number": 4})
    learning = train_seeds(SMALL, some, [3, 4])
    assert learning.scores == [max(v for _, v in curve) for curve in learning.curves]
    kept = learning.networks[int(np.argmax(learning.scores))]
    assert learning.best is kept
    told = evaluate_study(learning, some)
    each = [
        return_rates(NetworkPolicy.from_network(n), some, some.test.seeds)
        for n in learning.networks
    ]
    assert told["seeds"] == [3, 4] and told["roads"] == 4
    assert told["spread"] == pytest.approx(np.std([x.mean() for x in each], ddof=1))
    middle = [trim_mean(np.stack(each, axis=2)[:, c].ravel(), 0.25) for c in range(2)]
    assert told["held_out"]["mean"] == pytest.approx(np.mean(middle))
    more = told["more_than"]["fixed_ride"]
    assert more["low"] <= more["mean"] <= more["high"]
    assert any("rrms" in line for line in study_lines("ppo", told))


def test_an_episode_that_ends_within_a_hold_ends_for_the_learner():
    cases = MultiScenarioVecEnv([CASE], n_envs=2, seed=1, reward_scale=1.0, action_repeat=7)
    cases.reset()
    for _ in range(40):
        _, _, dones, infos = cases.step(np.zeros(2, dtype=int))
        if dones.any():
            break
    assert dones.all()
    for info in infos:
        assert info["TimeLimit.truncated"] and info["terminal_observation"].shape == (N_FEATURES,)


def test_a_training_by_one_seed_gives_one_network_that_can_drive(tmp_path):
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


def test_an_interrupted_training_is_taken_up_again(tmp_path):
    kept = tmp_path / "run.pt"
    calls = []

    def stop(text, share):
        calls.append(share)
        if share > 0.5:
            raise KeyboardInterrupt

    config = TrainingConfig(**{**vars(SMALL), "steps": 1024, "eval_interval": 256})
    with pytest.raises(KeyboardInterrupt):
        train(config, [CASE], [1], 3, checkpoint=kept, progress=stop)
    before = kept.read_bytes()
    resumed = train(config, [CASE], [1], 3, checkpoint=kept)
    assert [steps for steps, _ in resumed.curve] == [256, 512, 768, 1024]
    other = TrainingConfig(**{**vars(config), "steps": 2048})
    with pytest.raises(ConfigError, match=r"run\.pt: belongs to another recipe"):
        train(other, [CASE], [1], 3, checkpoint=kept)
    kept.write_bytes(before[: len(before) // 2])
    with pytest.raises(ConfigError, match=r"run\.pt: not a checkpoint"):
        train(config, [CASE], [1], 3, checkpoint=kept)


def test_deep_q_learning_learns_too():
    hyper = {"learning_starts": 32, "batch_size": 16, "train_freq": 4, "buffer_size": 500}
    config = TrainingConfig(
        algorithm="dqn", steps=128, n_envs=2, layers=(8,), eval_interval=128, hyperparameters=hyper
    )
    result = train(config, [CASE], [1], seed=1)
    assert result.network.layers[-1][0].shape == (4, 8)
    assert result.network.metadata["activation"] == "relu"


@pytest.mark.parametrize("name", ["ppo", "ppo_preview", "ppo_sensing", "dqn"])
def test_shipped_recipes_are_complete(name):
    assert grid_search.load_training_config(name, steps=5).steps == 5


def test_a_wrong_recipe_is_named():
    with pytest.raises(ConfigError, match=r"hyper parameters of ppo: .*learning_rat"):
        train(TrainingConfig(hyperparameters={"learning_rat": 1.0}), [CASE], [1], seed=1)
    with pytest.raises(ConfigError, match="rrms is not learned"):
        grid_search.load_training_config("rrms")
    with pytest.raises(ValueError, match="must be at least 1"):
        TrainingConfig(steps=0)
