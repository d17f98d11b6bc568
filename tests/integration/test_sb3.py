"""The Stable-Baselines3 adapter against the vector environment, and a training with PPO."""

import numpy as np
import pytest

from road_envs.core.config import ConfigError
from road_envs.envs.sb3 import RoadReconVecEnv
from road_envs.envs.vector import RoadReconVectorEnv

SHORT = {"road": "iso_d", "length": 6.0, "speed_kmh": [40.0, 70.0], "truth": False}


def test_it_equals_the_vector_environment_with_same_step_autoreset():
    ours, theirs = (
        RoadReconVecEnv(3, **SHORT),
        RoadReconVectorEnv(3, autoreset_mode="SameStep", **SHORT),
    )
    ours.seed(4)
    np.testing.assert_array_equal(ours.reset(), theirs.reset(seed=4)[0])
    ended = 0
    for _ in range(60):
        observation, reward, done, infos = ours.step(np.array([0, 1, 1]))
        expected = theirs.step(np.array([0, 1, 1]))
        _, _, terminated, truncated, expected_infos = expected
        np.testing.assert_array_equal(observation, expected[0])
        np.testing.assert_array_equal(reward, expected[1].astype(np.float32))
        np.testing.assert_array_equal(done, terminated | truncated)
        for i in np.flatnonzero(done):
            final_obs = expected_infos["final_obs"][i]
            np.testing.assert_array_equal(infos[i]["terminal_observation"], final_obs)
            assert infos[i]["TimeLimit.truncated"] is bool(truncated[i] and not terminated[i])
            ended += 1
        assert all("terminal_observation" not in infos[i] for i in np.flatnonzero(~done))
    assert ended >= 6


def test_a_failed_vehicle_is_not_reported_as_truncated():
    envs = RoadReconVecEnv(2, info_keys=["comfort"], **SHORT)
    envs.seed(0)
    envs.reset()
    envs.env.fleet.state.q[0, 0, 1] = np.nan
    _, _, done, infos = envs.step(np.array([0, 0]))
    assert done.tolist() == [False, True]
    assert infos[1]["TimeLimit.truncated"] is False and "no longer finite" in infos[1]["reason"]
    assert infos[0]["comfort"] >= 0.0


@pytest.mark.slow
def test_ppo_learns_to_prefer_ride_on_a_rough_road():
    """On a rough straight road ride is the better mode, which PPO must learn."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    road = {"road": "iso_e", "length": 30.0, "speed_kmh": 36.0, "truth": False}
    envs = VecNormalize(VecMonitor(RoadReconVecEnv(16, **road)), norm_reward=True)
    model = PPO(
        "MlpPolicy", envs, n_steps=64, batch_size=256, gamma=0.9, learning_rate=1e-3, seed=0
    )
    envs.training, observation = False, envs.reset()
    before = np.mean([model.predict(observation)[0].mean() for _ in range(20)])
    envs.training = True
    model.learn(16 * 64 * 12)
    actions, observation = [], envs.reset()
    for _ in range(60):
        action, _ = model.predict(observation, deterministic=True)
        observation, *_ = envs.step(action)
        actions.append(action)
    assert np.mean(actions) < 0.15 < before


def test_unsupported_operations_are_rejected():
    envs = RoadReconVecEnv(2, **SHORT)
    assert envs.env_is_wrapped(object) == [False, False]
    assert envs.get_attr("num_envs", indices=[0]) == [2]
    with pytest.raises(ConfigError, match="cannot be set"):
        envs.set_attr("road", "iso_a")
    with pytest.raises(ConfigError, match="cannot be called"):
        envs.env_method("reset")
    with pytest.raises(ConfigError, match="must be omitted"):
        RoadReconVecEnv(2, autoreset_mode="NextStep", **SHORT)
