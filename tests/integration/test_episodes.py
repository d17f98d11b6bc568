"""Episodes of a policy as a Minari data set: read back by Minari, repeated in the environment."""

import json

import gymnasium
import numpy as np
import pytest

minari = pytest.importorskip("minari", reason="the extra minari is not installed")


def test_episodes_are_loaded_by_minari_and_repeat_in_the_environment(
    road_recon, tmp_path, monkeypatch
):
    words = ("--episodes", "skyhook", "--drives", "10", "--seed", "3", "--out", "d", "--json")
    code, out, err = road_recon("dataset", *words)
    assert code == 0, err
    facts = json.loads(out)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "d"))
    data = minari.load_dataset(facts["data_set"])
    assert (data.total_episodes, data.total_steps) == (10, facts["steps"])
    episode = next(data.iterate_episodes([1]))
    assert episode.truncations[-1] != episode.terminations[-1]
    env = data.recover_environment()
    assert isinstance(env, gymnasium.Env) and env.observation_space == data.observation_space
    observation, _ = env.reset(seed=4)
    np.testing.assert_array_equal(observation, episode.observations[0])
    for k in range(20):
        observation, reward, *_ = env.step(episode.actions[k])
        np.testing.assert_array_equal(observation, episode.observations[k + 1])
        assert reward == episode.rewards[k]


def test_an_unknown_policy_is_refused_without_a_folder(road_recon, tmp_path):
    code, _, err = road_recon("dataset", "--episodes", "skyhok", "--drives", "10", "--out", "d")
    assert code == 2 and "skyhook" in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())
