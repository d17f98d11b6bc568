"""Environments in the loops of other libraries; each test runs where its library is installed."""

import gymnasium
import numpy as np
import pytest

import road_envs  # noqa: F401 - registers the environments

SHORT = {"road": "iso_d", "speed_kmh": 54.0, "length": 20.0, "control": "axle"}
SAFE = "RoadRecon/Safe4S4-v1"
LANES = {"num_envs": 4, "vectorization_mode": "vector_entry_point"}
IDS = pytest.mark.parametrize(("name", "options"), [("RoadRecon-v0", SHORT), (SAFE, {})])


def library(name: str):
    """Import a library; its test is skipped where it is not installed."""
    return pytest.importorskip(name, reason=f"{name} is not installed")


@IDS
@pytest.mark.costly
def test_torchrl_makes_an_environment_by_its_id(name, options):
    envs = library("torchrl.envs")
    env, plain = envs.GymEnv(name, **options), gymnasium.make(name, **options)
    env.set_seed(5)
    plain.reset(seed=5)
    plain.reset()
    data = env.rollout(6)
    for action, observation, reward in zip(
        data["action"].argmax(-1).tolist(),
        data["next", "observation"].numpy(),
        data["next", "reward"].numpy(),
        strict=True,
    ):
        expected = plain.step(action)
        np.testing.assert_array_equal(observation, expected[0])
        assert reward == np.float32(expected[1])


def test_torchrl_restarts_the_lanes_of_a_vector_environment():
    envs = library("torchrl.envs")
    lanes = gymnasium.make_vec("RoadRecon-v0", **LANES, autoreset_mode="SameStep", **SHORT)
    data = envs.GymWrapper(lanes).rollout(60, break_when_any_done=False)
    assert data.shape == (4, 60)
    ended = data["next", "truncated"].sum(dim=1).flatten().tolist()
    assert min(ended) >= 1
    after = data["next", "observation"][:, -1]
    assert bool(after.isfinite().all()) and bool((after != 0.0).any(dim=-1).all())


def test_mo_gymnasium_weighs_the_vector_reward():
    mo = library("mo_gymnasium")
    weights = np.array([1.0, 0.5, 10.0])
    env = mo.wrappers.LinearReward(mo.make(SAFE, vector_reward=True), weight=weights)
    plain = gymnasium.make(SAFE, vector_reward=True, disable_env_checker=True)
    env.reset(seed=1)
    plain.reset(seed=1)
    for _ in range(40):
        _, reward, _, _, info = env.step(5)
        _, vector, *_ = plain.step(5)
        np.testing.assert_array_equal(info["vector_reward"], vector)
        assert reward == pytest.approx(weights @ vector)
    assert reward < 0.0


def test_mo_gymnasium_records_the_returns_of_an_episode():
    mo = library("mo_gymnasium")
    env = mo.wrappers.MORecordEpisodeStatistics(mo.make(SAFE, vector_reward=True))
    env.reset(seed=1)
    total, ended = np.zeros(3), False
    while not ended:
        _, reward, terminated, truncated, info = env.step(0)
        total, ended = total + reward, terminated or truncated
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)


@pytest.mark.parametrize(
    ("algorithm", "policy", "settings"),
    [
        ("QRDQN", "MlpPolicy", {"learning_starts": 8, "buffer_size": 500}),
        ("RecurrentPPO", "MlpLstmPolicy", {"n_steps": 8, "batch_size": 16}),
    ],
)
def test_the_learners_of_sb3_contrib_train(algorithm, policy, settings):
    contrib = library("sb3_contrib")
    from road_envs.envs.sb3 import RoadReconVecEnv

    envs = RoadReconVecEnv(4, **SHORT)
    model = getattr(contrib, algorithm)(policy, envs, seed=1, **settings).learn(64)
    assert model.num_timesteps >= 64
    actions, _ = model.predict(envs.reset(), deterministic=True)
    assert actions.shape == (4,) and set(actions.tolist()) <= {0, 1, 2, 3}


@pytest.mark.parametrize("mode", ["sync", "vector_entry_point"])
def test_a_loop_in_the_manner_of_cleanrl_sees_the_returns_of_its_episodes(mode):
    envs = gymnasium.make_vec("RoadRecon-v0", **{**LANES, "vectorization_mode": mode}, **SHORT)
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    envs.reset(seed=1)
    returns: list[float] = []
    sums = np.zeros(4)
    for _ in range(120):
        _, rewards, terminated, truncated, infos = envs.step(np.full(4, 3))
        sums += rewards
        for i in np.flatnonzero(terminated | truncated):
            returns.append(float(infos["episode"]["r"][i]))
            assert returns[-1] == pytest.approx(sums[i], rel=1e-5)
            sums[i] = 0.0
    assert len(returns) >= 8
