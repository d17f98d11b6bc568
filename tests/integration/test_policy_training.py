"""Training of policies: environments as features, policy iteration, stored networks."""

import io
import json
import re
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from leaderboard.commands import policies as policies_command
from leaderboard.policies import comparison
from road_envs.core.config import ConfigError
from road_envs.core.reading import read_zip
from road_envs.envs.safe4s4 import Safe4S4Setup, Safe4S4VectorEnv
from road_envs.envs.sb3 import RoadReconVecEnv
from road_envs.envs.vector import RoadReconVectorEnv
from road_envs.policies import PolicyContext, create, make_policy, policy_iteration
from road_envs.policies.feature_env import FeatureVecEnv
from road_envs.policies.features import N_FEATURES, NAMES, FeatureExtractor
from road_envs.policies.network_policy import NetworkPolicy, sb3_layers
from road_envs.policies.policy_iteration import (
    DEVELOPMENT_SEED,
    IterationConfig,
    _examples,
    _fit,
    _pair_costs,
    iterate,
)
from road_envs.policies.rollout import VIOLATION_PRICE, Drives, drive_all
from studies.trained_networks import TrainingConfig, train
from studies.tuned_policies import training_drives

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
    steps=128,
    n_envs=2,
    layers=(8,),
    eval_interval=64,
    drives=1,
    hyperparameters={"n_steps": 16, "batch_size": 32, "n_epochs": 2},
)


def features_of(case, n, seed, **options) -> FeatureVecEnv:
    """Return `n` environments of a case as features."""
    rows = n * (2 if options.get("paired_baseline") else 1)
    return FeatureVecEnv(RoadReconVecEnv(rows, **case), seed, **options)


def test_actions_are_repeated_and_rewards_are_summed():
    envs = features_of(TURN, 2, 7, action_repeat=4)
    plain = RoadReconVectorEnv(2, **TURN)
    features = FeatureExtractor(PolicyContext.from_setup(plain.setup, 2, 0))
    np.testing.assert_array_equal(envs.reset(), features.update(plain.reset(seed=7)[0]))
    actions, total = np.array([1, 2]), np.zeros(2)
    after, rewards, dones, _ = envs.step(actions)
    for _ in range(4):
        observations, reward, *_ = plain.step(actions)
        last, total = features.update(observations), total + reward
    np.testing.assert_array_equal(after, last)
    np.testing.assert_allclose(rewards, total, rtol=1e-5)
    assert after.shape == (2, N_FEATURES) and not dones.any()


def test_the_paired_baseline_removes_the_road_from_the_reward():
    """Vehicles in ride get a reward of exactly 0; the others get the difference to ride."""
    paired = features_of(TURN, 2, 5, action_repeat=3, paired_baseline=True)
    plain, alone = (features_of(TURN, 2, 5, action_repeat=3) for _ in range(2))
    for envs in (paired, plain, alone):
        envs.reset()
    over = False
    for _ in range(30):
        gained, dones = paired.step(np.array([0, 3]))[1:3]
        expected = plain.step(np.array([0, 3]))[1] - alone.step(np.zeros(2, dtype=int))[1]
        assert gained[0] == 0.0
        np.testing.assert_allclose(gained, expected, atol=1e-5)
        over |= dones.any()
    assert over


def test_a_violation_has_its_price_in_the_reward():
    plain = Safe4S4VectorEnv(2)
    priced = RoadReconVecEnv(2, vector_class=Safe4S4VectorEnv, cost_price=VIOLATION_PRICE)
    fixed = {"speed_kmh": 50.0, "begin": 0.5, "severe": "fishhook"}
    priced.seed(3)
    priced.set_options(fixed)
    priced.reset()
    plain.reset(seed=3, options=fixed)
    cost = np.zeros(2)
    for _ in range(60):
        _, rewards, _, _, infos = plain.step(np.zeros(2, dtype=int))
        expected = rewards - VIOLATION_PRICE * infos["cost"]
        np.testing.assert_allclose(priced.step(np.zeros(2, dtype=int))[1], expected, rtol=1e-6)
        cost += infos["cost"]
    assert cost.max() > 0.0


def test_features_are_equal_for_a_drive_and_its_mirror_image():
    pair = []
    for a_y in (2.0, -2.0):
        manoeuvre = TURN["manoeuvre"] | {"a_y": a_y}
        env = RoadReconVectorEnv(
            1, **TURN | {"road": "flat", "sensors": "ideal", "manoeuvre": manoeuvre}
        )
        pair.append((env, FeatureExtractor(PolicyContext.from_setup(env.setup, 1, 0))))
    rows = [features.update(env.reset(seed=0)[0]) for env, features in pair]
    for _ in range(20):
        rows = [features.update(env.step(np.zeros(1, dtype=int))[0]) for env, features in pair]
        np.testing.assert_allclose(rows[0], rows[1], atol=2e-3)
    assert np.abs(rows[0][0, NAMES.index("roll_rate")]) > 0.01


def test_an_episode_that_ends_during_a_repeat_is_reported_as_ended():
    envs = features_of(CASE, 2, 1, action_repeat=7)
    envs.reset()
    for _ in range(40):
        _, _, dones, infos = envs.step(np.zeros(2, dtype=int))
        if dones.any():
            break
    assert dones.all()
    for info in infos:
        assert info["TimeLimit.truncated"] and info["terminal_observation"].shape == (N_FEATURES,)


TINY = IterationConfig(steps=3, drives=1, compared=1, every=40, width=8)


@pytest.fixture(scope="module")
def trained():
    return iterate(TINY, 3, lambda text, share: None)


@pytest.mark.costly
def test_policy_iteration_is_reproducible_and_returns_a_round_of_its_curve(trained):
    network, curve = iterate(TINY, 3, lambda text, share: None)
    for (W, b), (W_2, b_2) in zip(network.layers, trained[0].layers, strict=True):
        np.testing.assert_array_equal(W, W_2)
        np.testing.assert_array_equal(b, b_2)
    assert curve == trained[1] != iterate(TINY, 4, lambda text, share: None)[1]
    compared = range(DEVELOPMENT_SEED, DEVELOPMENT_SEED + 1)
    drives = Drives.mirrored(Safe4S4Setup({"split": "train"}), compared)
    own = drive_all(NetworkPolicy.from_network(network), drives).score.mean()
    assert own == pytest.approx(trained[1][network.metadata["steps"] - 1][1], rel=1e-12)


@pytest.mark.parametrize(("allowed", "chosen"), [(4, 1), (2, 2), (1, 3), (0, 3)])
@pytest.mark.costly
def test_the_best_round_is_one_that_violates_no_more_than_allowed(allowed, chosen, monkeypatch):
    """Three rounds that violate in ever fewer drives, with ever lower scores."""
    driven = iter(
        SimpleNamespace(score=np.full(4, score), violated=np.arange(4) < violated)
        for score, violated in [(-9.0, allowed), (-1.0, 3), (-2.0, 2), (-3.0, 1)]
    )
    seen = np.zeros((600, N_FEATURES), dtype=np.float32), np.eye(600, 16)
    monkeypatch.setattr(policy_iteration, "drive_all", lambda *arguments: next(driven))
    monkeypatch.setattr(policy_iteration, "_examples", lambda *arguments: seen)
    network, curve = iterate(TINY, 1, lambda text, share: None)
    assert network.metadata["steps"] == chosen and curve == ((1, -1.0), (2, -2.0), (3, -3.0))


def test_the_cost_of_a_pair_is_that_of_the_drive_in_which_it_is_held():
    """Whole drives with other actions over `hold` intervals are the oracle."""
    config, drives = IterationConfig(every=100, price=50.0), training_drives(1)
    actions = np.full((600, len(drives)), 4)  # ride in front, handling at the rear
    costs = _pair_costs(config, drives, actions, first=120)
    for pair in (0, 5, 14):
        other = actions.copy()
        other[220:223] = pair
        sums = np.zeros(len(drives))
        fleet = drives.start()
        fleet.advance(drives.first_bytes())
        for k, row in enumerate(other[:236]):
            values = fleet.advance(drives.setup.command_bytes[row]).values.T
            by_name = dict(zip(fleet.columns, values, strict=True))
            sums += (k >= 220) * (by_name["comfort"] + 50.0 * by_name["cost"])
        np.testing.assert_allclose(costs[1, :, pair], sums, rtol=1e-9)
    assert np.ptp(costs[1], axis=1).min() > 0.0


@pytest.mark.costly
def test_the_network_learns_better_choices_than_any_constant_pair():
    import torch

    torch.manual_seed(0)
    drives = Drives.mirrored(Safe4S4Setup({"split": "train"}), range(7, 10))
    features, costs = _examples(IterationConfig(horizon=8), drives, create("rrms"), 0)
    model = torch.nn.Sequential(
        torch.nn.Linear(N_FEATURES, 16), torch.nn.Tanh(), torch.nn.Linear(16, 16)
    )
    _fit(model, features, costs, 80, 0.01, np.random.default_rng(0))
    chosen = model(torch.from_numpy(features)).argmax(dim=1).numpy()
    worse = np.minimum(costs - costs.min(axis=1, keepdims=True), 10.0)
    assert worse[np.arange(len(worse)), chosen].mean() < 0.8 * worse.mean(axis=0).min()


@pytest.mark.costly
def test_a_trained_policy_stands_beside_the_laws_on_public_drives(
    trained, monkeypatch, tmp_path, capsys
):
    drives = comparison.public_drives(2)
    monkeypatch.setattr(comparison, "public_drives", lambda: drives)
    monkeypatch.setattr(policies_command, "iterate", lambda *arguments: trained)
    policies_command.train_policy(out=tmp_path / "mine.npz", seed=3)
    found = json.loads((tmp_path / "mine.json").read_text())
    score = drive_all(make_policy(str(tmp_path / "mine.npz")), drives).score.mean()
    means = {row["policy"]: row["score"]["mean"] for row in found["rows"]}
    assert set(means) == {"seed 3", *policies_command.RIVALS}
    assert means["seed 3"] == pytest.approx(score, rel=1e-4)
    printed, curve = capsys.readouterr().out, " ".join(f"{value:.3f}" for _, value in trained[1])
    assert printed.startswith(f"seed 3, score by round: {curve}\n") and "\nrrms " in printed


@pytest.mark.slow
def test_the_training_of_the_tutorial_beats_ride_in_ten_minutes(road_recon, tmp_path):
    """By processor time, which does not depend on what runs beside it."""
    pytest.importorskip("torch")
    page = Path(__file__).parents[2] / "docs/tutorials/own_policy.md"
    (command,) = re.findall(r"^road-recon (train-policy .*)$", page.read_text("utf-8"), re.M)
    begin = time.process_time()
    code, printed, error = road_recon(*command.split())
    assert code == 0, printed + error
    assert time.process_time() - begin < 600.0
    drives = comparison.public_drives()
    own, ride, rrms = (
        drive_all(make_policy(name), drives).score
        for name in (str(tmp_path / "mine.npz"), "fixed_ride", "rrms")
    )
    assert own.mean() > ride.mean() + 2.0
    assert own.mean() > rrms.mean()


@pytest.mark.costly
def test_training_is_reproducible_and_its_network_can_drive(tmp_path):
    result = train(SMALL, 3)
    for (W, b), (W_2, b_2) in zip(
        result.policy.network.layers, train(SMALL, 3).policy.network.layers, strict=True
    ):
        np.testing.assert_array_equal(W, W_2)
        np.testing.assert_array_equal(b, b_2)
    assert [steps for steps, _ in result.curve] == [64, 128]
    path = tmp_path / "n.npz"
    path.write_bytes(result.policy.network.to_bytes())
    assert NetworkPolicy(file=str(path)).network.metadata["held"] == 2


def sb3_library(algorithm):
    own = algorithm in ("PPO", "A2C", "DQN")
    return pytest.importorskip("stable_baselines3" if own else "sb3_contrib")


@pytest.mark.parametrize("features", [True, False])
@pytest.mark.parametrize("algorithm", ["PPO", "A2C", "TRPO", "MaskablePPO", "DQN", "QRDQN"])
def test_a_model_saved_by_stable_baselines_acts_as_it_predicts(algorithm, features, tmp_path):
    """Its own `predict` is the oracle, on observations of a drive; its activation is the default
    or given.
    """
    import torch

    library = sb3_library(algorithm)
    envs = RoadReconVecEnv(3, vector_class=Safe4S4VectorEnv)
    context = PolicyContext.from_setup(envs.env.setup, 3, 0)
    seen = FeatureVecEnv(envs, 5) if features else envs
    kwargs = {"net_arch": [8]} | ({"activation_fn": torch.nn.ReLU} if features else {})
    model = getattr(library, algorithm)("MlpPolicy", seen, seed=1, policy_kwargs=kwargs)
    model.save(tmp_path / "model")
    policy = make_policy(str(tmp_path / "model.zip"))
    policy.reset(context)
    envs.seed(5)
    observations, extractor = envs.reset(), FeatureExtractor(context)
    for _ in range(20):
        shown = extractor.update(observations) if features else observations
        expected = model.predict(shown, deterministic=True)[0]
        actions = policy.act(observations)
        np.testing.assert_array_equal(actions, expected)
        observations = envs.step(actions)[0]


def test_a_model_whose_observations_pass_through_layers_of_its_own_is_refused(tmp_path):
    library = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.torch_layers import FlattenExtractor
    from torch import nn

    class Bare(FlattenExtractor):
        """Extractor without parameters."""

    class Scaled(FlattenExtractor):
        def __init__(self, space):
            super().__init__(space)
            self.scale = nn.Linear(self.features_dim, self.features_dim)

    envs, path = RoadReconVecEnv(1, vector_class=Safe4S4VectorEnv), str(tmp_path / "model.zip")
    for algorithm in (library.PPO, library.DQN):
        for extractor in (FlattenExtractor, Bare, Scaled):
            kwargs = {"features_extractor_class": extractor}
            model = algorithm("MlpPolicy", envs, policy_kwargs=kwargs, device="cpu")
            model.save(path)
            if extractor is FlattenExtractor:
                make_policy(path)
                continue
            with pytest.raises(ConfigError, match=r"l\.zip: unknown features extractor .*known"):
                make_policy(path)
        with pytest.raises(ValueError, match=r"features_extractor\.scale\.weight' is no parameter"):
            sb3_layers(model.policy.state_dict(), 16)


@pytest.mark.parametrize(
    "name", ["LeakyReLU", "PReLU", "RReLU", "ReLU6", "Hardtanh", "Tanhshrink", "ARS"]
)
def test_a_model_that_cannot_be_run_as_it_predicts_is_refused(name, tmp_path):
    from torch import nn

    learner = getattr(sb3_library(name), name) if name == "ARS" else sb3_library("PPO").PPO
    kwargs = {} if name == "ARS" else {"activation_fn": getattr(nn, name)}
    envs, path = RoadReconVecEnv(1, vector_class=Safe4S4VectorEnv), tmp_path / "model.zip"
    learner("MlpPolicy", envs, policy_kwargs=kwargs, device="cpu").save(path)
    with pytest.raises(ConfigError, match=rf"unknown (activation|module) .*(ars|{name}).*known:"):
        make_policy(str(path))


def test_a_saved_model_gets_its_row_and_its_place_on_the_page(tmp_path):
    library = pytest.importorskip("stable_baselines3")
    envs = RoadReconVecEnv(1, vector_class=Safe4S4VectorEnv)
    library.PPO("MlpPolicy", envs, n_steps=8, batch_size=8, seed=1).save(tmp_path / "model")
    out = tmp_path / "out"
    policies_command.policies(policy=[str(tmp_path / "model.zip")], drives=2, sweeps=0, out=out)
    rows = [row["policy"] for row in json.loads((out / "benchmark.json").read_text())["rows"]]
    assert sorted(rows) == ["model", "rrms"]
    assert 'id="policy-model"' in (out / "policies.html").read_text()


def test_a_zip_that_is_no_saved_model_is_refused(tmp_path):
    path = tmp_path / "other.zip"
    with path.open("wb") as file:
        np.savez(file, data=np.zeros(3))
    with pytest.raises(ConfigError, match=r"other\.zip: not a saved model of Stable-Baselines3"):
        make_policy(str(path))


@pytest.mark.parametrize("algorithm", ["PPO", "DQN"])
def test_a_model_of_named_observations_is_refused(algorithm, tmp_path):
    """Stable-Baselines3 puts them in the order of their names, which the file does not hold."""
    import gymnasium as gym

    class Named(gym.Env):
        observation_space = gym.spaces.Dict(
            {name: gym.spaces.Box(-1.0, 1.0, (1,)) for name in NAMES}
        )
        action_space = gym.spaces.Discrete(16)

    learner = getattr(sb3_library(algorithm), algorithm)
    learner("MultiInputPolicy", Named(), device="cpu").save(tmp_path / "model")
    with pytest.raises(ConfigError, match=r"model\.zip: unknown observation space .*dict\.Dict"):
        make_policy(str(tmp_path / "model.zip"))


def test_weights_that_were_compressed_are_refused_before_they_are_unpacked(tmp_path):
    envs, path = RoadReconVecEnv(1, vector_class=Safe4S4VectorEnv), tmp_path / "model.zip"
    sb3_library("PPO").PPO("MlpPolicy", envs, device="cpu").save(path)
    files = read_zip(path)
    with zipfile.ZipFile(io.BytesIO(files["policy.pth"])) as records:
        members = {x.filename: records.read(x) for x in records.infolist()}
    with zipfile.ZipFile(packed := io.BytesIO(), "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (files | {"policy.pth": packed.getvalue()}).items():
            archive.writestr(name, content)
    with pytest.raises(ConfigError, match=r"model\.zip: .*its weights are compressed"):
        make_policy(str(path))


def test_a_file_of_a_few_bytes_takes_no_memory_for_many_values():
    few = pytest.importorskip("torch").zeros(1).expand(500, 500)
    with pytest.raises(ValueError, match="more values than it stores"):
        sb3_layers({"action_net.weight": few, "action_net.bias": few[0]}, 500)


@pytest.mark.parametrize("algorithm", ["dqn", "qrdqn"])
def test_value_learning_trains_a_network(algorithm):
    if algorithm == "qrdqn":
        pytest.importorskip("sb3_contrib")
    hyper = {"learning_starts": 32, "batch_size": 16, "train_freq": 4, "buffer_size": 500}
    config = TrainingConfig(
        algorithm=algorithm, steps=64, n_envs=2, layers=(8,), eval_interval=64, drives=1,
        hyperparameters=hyper,
    )  # fmt: skip
    result = train(config, seed=1)
    assert result.policy.network.layers[-1][0].shape == (16, 8)
    assert result.policy.network.metadata["activation"] == "relu"


@pytest.mark.costly
def test_a_recurrent_policy_acts_as_its_library_predicts():
    """Its own `predict` in the steps of the features is the oracle."""
    pytest.importorskip("sb3_contrib")
    hyper = {"n_steps": 16, "batch_size": 32, "n_epochs": 1}
    config = TrainingConfig(
        algorithm="recurrent_ppo", steps=192, n_envs=2, layers=(8,), eval_interval=64, drives=1,
        hyperparameters=hyper,
    )  # fmt: skip
    policy, curve = train(config, seed=1)
    assert [steps for steps, _ in curve] == [64, 128, 192]
    drives = training_drives(1)
    driven = drive_all(policy, drives, store_observations=True)
    assert driven.score.mean() == pytest.approx(max(score for _, score in curve))
    extractor = FeatureExtractor(PolicyContext.from_setup(drives.setup, len(drives), 0))
    features = [extractor.update(x) for x in driven.observations][: 2 * (len(driven.actions) // 2)]
    state, start = None, np.ones(len(drives), dtype=bool)
    for k in range(0, len(features), 2):
        expected, state = policy.network.predict(features[k], state, start, deterministic=True)
        start = np.zeros_like(start)
        np.testing.assert_array_equal(driven.actions[k], expected)
        np.testing.assert_array_equal(driven.actions[k + 1], expected)


def test_invalid_training_settings_are_named():
    with pytest.raises(ConfigError, match=r"hyperparameters of ppo: .*learning_rat"):
        train(TrainingConfig(hyperparameters={"learning_rat": 1.0}, n_envs=1, drives=1), seed=1)
    with pytest.raises(ValueError, match="must be at least 1"):
        TrainingConfig(steps=0)
