"""Training of a `PolicyNetwork` with Stable-Baselines3 on the native vector environment.

Every case has its own vector environment; all are stepped as one, and every episode draws a new
training road. Checkpoints hold tensors and numbers only (`torch.load` with `weights_only`), never
pickled objects, so that an untrusted checkpoint cannot execute code. The replay buffer of DQN is
not stored; it is filled again.
"""

import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np

from road_envs.core.atomic_io import atomic_write
from road_envs.core.config import ConfigError, Count, Settings
from road_envs.core.extras import optional_import
from road_envs.core.reading import parsing
from road_envs.envs.sb3 import ArrayVecEnv, RoadReconVecEnv
from road_envs.policies.api import PolicyContext
from road_envs.policies.features import MAX_FEATURE, FeatureExtractor, n_features
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork
from road_envs.policies.rollout import roll_out

with optional_import("training a policy"):
    import torch
    from stable_baselines3 import DQN, PPO
    from stable_baselines3.common.callbacks import BaseCallback

RIDE = ("ride", "ride")
"""States of the paired baseline."""

SEEDS_APART = 1_000_000
"""Between the seeds of one case's environments and those of the next."""

Progress = Callable[[str, float], None]
"""Called with a description and the share done."""


@dataclass(frozen=True, kw_only=True)
class TrainingConfig(Settings):
    """Settings of a training; a step is one choice of an action in one environment."""

    algorithm: Literal["ppo", "dqn"] = "ppo"
    steps: Count = 300_000
    n_envs: Count = 16  # per case
    layers: tuple[Count, ...] = (64, 64)
    eval_interval: Count = 50_000  # steps between evaluations on the roads of the training seeds
    unresolved_variance: float = 0.0  # weight of this cost in the reward
    # an exploratory action has to last for several control intervals to have an effect
    action_repeat: Count = 5
    # the reward relative to a vehicle in ride on the same road: removes the road's contribution
    # to its variance and keeps the optimal policy
    paired_baseline: bool = False
    preview: bool = False  # adds features of the road ahead of the rear axle
    # makes ride exp(bias) times likelier at the start of PPO: the gain of another pair shows
    # only against constant ride, not against random switching
    ride_logit_bias: float = 0.0
    reward_scale: float = 10.0
    hyperparameters: dict[str, Any] = field(default_factory=dict)  # of Stable-Baselines3


@dataclass(frozen=True)
class TrainingResult:
    """Network of the best evaluation, and all evaluations as (steps, return per second)."""

    network: PolicyNetwork
    curve: tuple[tuple[int, float], ...]


class MultiScenarioVecEnv(ArrayVecEnv):
    """Vector environment of `n_envs` environments of each case, observed as features.

    An action is repeated for `action_repeat` intervals, whose rewards are summed and scaled. With
    `paired_baseline` the rewards of vehicles that stay in ride on the same roads are subtracted:
    of each pair of rows of `envs` the second one. After one vehicle of a pair has rolled over, the
    two drive different roads of the same kind.
    """

    def __init__(
        self,
        cases: Sequence[dict[str, Any]],
        n_envs: int,
        seed: int,
        reward_scale: float,
        action_repeat: int = 1,
        paired_baseline: bool = False,
        preview: bool = False,
    ):
        self.rows = 2 if paired_baseline else 1
        self.envs = [RoadReconVecEnv(self.rows * n_envs, **options) for options in cases]
        self.n_envs, self.reward_scale, self.action_repeat = n_envs, reward_scale, action_repeat
        for i, env in enumerate(self.envs):
            env.seed(seed + SEEDS_APART * (i + 1), alike=self.rows)
        setups = [env.env.setup for env in self.envs]
        if len({setup.action_space.n for setup in setups}) > 1:
            raise ConfigError("all cases must have the same control")
        contexts = [PolicyContext.from_setup(setup, n_envs, seed) for setup in setups]
        self.features = [FeatureExtractor(context, preview) for context in contexts]
        shape = (n_features(preview),)
        space = gymnasium.spaces.Box(-MAX_FEATURE, MAX_FEATURE, shape, dtype=np.float32)
        super().__init__(n_envs * len(self.envs), space, setups[0].action_space)

    def reset(self) -> np.ndarray:
        """Start episodes in all environments, and return the features (N, K)."""
        for features in self.features:
            features.reset(np.ones(self.n_envs, dtype=bool))
        observations = [env.reset()[:: self.rows] for env in self.envs]
        pairs = zip(self.features, observations, strict=True)
        return np.concatenate([features.update(x) for features, x in pairs])

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (N,) for `step_wait`."""
        self.case_actions = np.split(np.asarray(actions), len(self.envs))

    def step_wait(self):
        """Return features, rewards, dones (N, ...) and infos."""
        parts = [
            self._repeat_action(*each)
            for each in zip(self.envs, self.features, self.case_actions, strict=True)
        ]
        observations, rewards, dones, part_infos = zip(*parts, strict=True)
        infos = [info for part in part_infos for info in part]
        return np.concatenate(observations), np.concatenate(rewards), np.concatenate(dones), infos

    def _repeat_action(self, env: RoadReconVecEnv, features: FeatureExtractor, actions: np.ndarray):
        """Repeat the actions of one case; rewards after the end of an episode are discarded."""
        total, ended = np.zeros(self.n_envs, dtype=np.float32), np.zeros(self.n_envs, dtype=bool)
        infos: list[dict[str, Any]] = [{} for _ in range(self.n_envs)]
        row_actions = np.full(env.num_envs, features.context.action_index(*RIDE))
        row_actions[:: self.rows] = actions
        for _ in range(self.action_repeat):
            every_row: Any = env.step(row_actions)
            observations, rewards, dones, part_infos = (x[:: self.rows] for x in every_row)
            if self.rows > 1:
                rewards = rewards - every_row[1][1::2]
            total += np.where(ended, 0.0, self.reward_scale * rewards).astype(np.float32)
            newly_ended = np.flatnonzero(dones & ~ended)
            if newly_ended.size:  # the learner bootstraps from the last features if truncated
                last = self._terminal_features(features, part_infos, newly_ended)
                for i, terminal in zip(newly_ended, last, strict=True):
                    infos[i] = {**part_infos[i], "terminal_observation": terminal}
            features.reset(dones)
            observations = features.update(observations)
            ended |= dones
        return observations, total, ended, infos

    def close(self) -> None:
        """Do nothing; there are no resources to release."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the first case, once for each environment."""
        return self.envs[0].get_attr(attr_name) * len(self.envs)

    def _terminal_features(
        self, features: FeatureExtractor, part_infos: list[dict[str, Any]], ended: np.ndarray
    ):
        """Return features (E, K) of the last observations of the environments `ended` (E,).

        The states of filtered features are taken as zero.
        """
        last = np.stack([part_infos[i]["terminal_observation"] for i in ended])
        observations = np.zeros((self.n_envs, last.shape[1]), dtype=last.dtype)
        observations[ended] = last
        extractor = FeatureExtractor(features.context, features.preview is not None)
        return extractor.update(observations)[ended]


def train(
    config: TrainingConfig,
    cases: Sequence[dict[str, Any]],
    seeds: Sequence[int],
    seed: int,
    *,
    checkpoint: Path | None = None,
    log: Path | None = None,
    progress: Progress = lambda text, share: None,
) -> TrainingResult:
    """Train on `cases` (options of the environment), with evaluations on the roads of `seeds`.

    An existing `checkpoint` is resumed; it is written after every evaluation. `log` is a folder for
    TensorBoard, if that is installed. Raises ConfigError.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # several threads are slower for layers this small
    try:
        return _train(config, cases, seeds, seed, checkpoint, log, progress)
    finally:
        torch.set_num_threads(threads)


def _train(config, cases, seeds, seed, checkpoint, log, progress) -> TrainingResult:
    cases = [_with_information_weight(options, config.unresolved_variance) for options in cases]
    envs = MultiScenarioVecEnv(
        cases,
        config.n_envs,
        seed,
        config.reward_scale,
        config.action_repeat,
        config.paired_baseline,
        config.preview,
    )
    model = _model(config, envs, seed, log)
    state: dict[str, Any] = {"steps": 0, "best": -np.inf, "curve": [], "network": None}
    if checkpoint is not None and checkpoint.exists():
        _resume(model, state, checkpoint, config)
    metadata = {  # the keys are those of the file format of `network_policy`
        "activation": "tanh" if config.algorithm == "ppo" else "relu",
        "control": cases[0]["control"],
        "held": config.action_repeat,
        "ahead": config.preview,
        "algorithm": config.algorithm,
        "seed": seed,
        "steps": config.steps,
        "information": config.unresolved_variance,
    }
    while state["steps"] < config.steps:
        steps = min(config.eval_interval, config.steps - state["steps"])
        callback = _progress_callback(progress, config.steps)
        model.learn(steps, callback=callback, reset_num_timesteps=False)
        state["steps"] = int(model.num_timesteps)
        network = PolicyNetwork(_actor_layers(model, config.algorithm), metadata)
        score = evaluate(network, cases, seeds)
        state["curve"].append((state["steps"], score))
        if score > state["best"]:
            state["best"], state["network"] = score, network
        if checkpoint is not None:
            _save_checkpoint(model, state, checkpoint, config)
    return TrainingResult(state["network"], tuple(map(tuple, state["curve"])))


def evaluate(
    network: PolicyNetwork, cases: Sequence[dict[str, Any]], seeds: Sequence[int]
) -> float:
    """Return the mean return per second over `cases` and roads of `seeds`."""
    policy = NetworkPolicy.from_network(network)
    rates = []
    for options in cases:
        rollout = roll_out(policy, options, seeds, store_observations=False)
        rates.append(rollout.returns / (rollout.intervals / options["control_rate"]))
    return float(np.mean(rates))


def _with_information_weight(options: dict[str, Any], weight: float) -> dict[str, Any]:
    return {**options, "weights": {**options.get("weights", {}), "unresolved_variance": weight}}


def _model(config: TrainingConfig, envs: MultiScenarioVecEnv, seed: int, log: Path | None):
    layers = list(config.layers)
    activation = torch.nn.Tanh if config.algorithm == "ppo" else torch.nn.ReLU
    shape: Any = {"pi": layers, "vf": layers} if config.algorithm == "ppo" else layers
    cls: Any = PPO if config.algorithm == "ppo" else DQN
    try:
        model = cls(
            "MlpPolicy",
            envs,
            seed=seed,
            device="cpu",
            policy_kwargs={"net_arch": shape, "activation_fn": activation},
            tensorboard_log=str(log) if log is not None and _has_tensorboard() else None,
            **config.hyperparameters,
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(f"hyperparameters of {config.algorithm}: {error}") from None
    if config.algorithm == "ppo":
        ride = envs.features[0].context.action_index(*RIDE)
        model.policy.action_net.bias.data[ride] += config.ride_logit_bias
    return model


def _has_tensorboard() -> bool:
    from importlib.util import find_spec

    return find_spec("tensorboard") is not None


def _progress_callback(progress: Progress, total: int):
    class ProgressCallback(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls % 32 == 0:
                progress(f"{self.num_timesteps} of {total} steps", self.num_timesteps / total)
            return True

    return ProgressCallback()


def _actor_layers(model: Any, algorithm: str) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return the network of a model that selects actions, as plain arrays."""
    if algorithm == "ppo":
        net = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    else:
        net = list(model.policy.q_net.q_net)
    return tuple(
        (layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy())
        for layer in net
        if isinstance(layer, torch.nn.Linear)
    )


def _save_checkpoint(model: Any, state: dict[str, Any], path: Path, config: TrainingConfig) -> None:
    """Write a checkpoint atomically."""
    plain = {"steps": state["steps"], "best": state["best"], "curve": state["curve"]}
    network = {
        f"{kind}_{i}": torch.from_numpy(array)
        for i, layer in enumerate(state["network"].layers)
        for kind, array in zip("Wb", layer, strict=True)
    }
    with atomic_write(path) as partial:
        torch.save(
            {
                "policy": model.policy.state_dict(),
                "optimizer": model.policy.optimizer.state_dict(),
                "network": network,
                "state": json.dumps(plain),
                "config": repr(config),
                "about": json.dumps(state["network"].metadata),
            },
            partial,
        )


def _resume(model: Any, state: dict[str, Any], path: Path, config: TrainingConfig) -> None:
    """Restore a checkpoint. Raises ConfigError if it is damaged or of other settings."""
    with parsing(path, ConfigError, "not a checkpoint that can be resumed"):
        stored = torch.load(io.BytesIO(path.read_bytes()), weights_only=True)
        if stored["config"] != repr(config):
            raise ConfigError("belongs to other settings; choose another checkpoint file")
        model.policy.load_state_dict(stored["policy"])
        model.policy.optimizer.load_state_dict(stored["optimizer"])
        state |= json.loads(stored["state"])
        arrays, metadata = stored["network"], json.loads(stored["about"])
        layers = [(arrays[f"W_{i}"], arrays[f"b_{i}"]) for i in range(len(arrays) // 2)]
        state["network"] = PolicyNetwork(tuple((W.numpy(), b.numpy()) for W, b in layers), metadata)
    model.num_timesteps = state["steps"]
