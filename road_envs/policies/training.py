"""Training of a `PolicyNetwork` with Stable-Baselines3 on the drives of `RoadRecon/Safe4S4-v1`.

Every episode draws a new training drive. Checkpoints hold tensors and numbers only (`torch.load`
with `weights_only`), never pickled objects, so that an untrusted checkpoint cannot execute code.
The replay buffer of DQN and QR-DQN is not stored; it is filled again.
"""

import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np

from road_envs.core.atomic_io import atomic_write
from road_envs.core.config import ConfigError, Count, Settings
from road_envs.core.extras import optional_import
from road_envs.core.reading import parsing
from road_envs.envs.safe4s4 import Safe4S4VectorEnv
from road_envs.envs.sb3 import ArrayVecEnv, RoadReconVecEnv
from road_envs.policies.api import PolicyContext
from road_envs.policies.features import MAX_FEATURE, FeatureExtractor, n_features
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork
from road_envs.policies.rollout import VIOLATION_PRICE, drive_all, training_drives

with optional_import("training a policy"):
    import torch
    from stable_baselines3 import DQN, PPO
    from stable_baselines3.common.callbacks import BaseCallback

RIDE = ("ride", "ride")
"""States of the paired baseline."""

Progress = Callable[[str, float], None]
"""Called with a description and the share done."""


@dataclass(frozen=True, kw_only=True)
class TrainingConfig(Settings):
    """Settings of a training; a step is one choice of an action in one environment."""

    algorithm: Literal["ppo", "dqn", "qrdqn"] = "ppo"
    steps: Count = 300_000
    n_envs: Count = 32
    layers: tuple[Count, ...] = (64, 64)
    eval_interval: Count = 50_000  # steps between evaluations on training drives
    drives: Count = 8  # of an evaluation, each to both sides
    # an exploratory action has to last for several control intervals to have an effect
    action_repeat: Count = 2
    # the reward relative to a vehicle in ride on the same drive: removes the road's contribution
    # to its variance and keeps the optimal policy
    paired_baseline: bool = False
    preview: bool = False  # adds features of the road ahead of the rear axle
    # makes ride exp(bias) times likelier at the start of PPO: the gain of another pair shows
    # only against constant ride, not against random switching
    ride_logit_bias: float = 0.0
    reward_scale: float = 1.0
    hyperparameters: dict[str, Any] = field(default_factory=dict)  # of Stable-Baselines3


class TrainingResult(NamedTuple):
    """Network of the best evaluation, and all evaluations as (steps, mean score)."""

    network: PolicyNetwork
    curve: tuple[tuple[int, float], ...]


class FeatureVecEnv(ArrayVecEnv):
    """Vector environment `env` observed as features, with actions that last for several intervals.

    An action is repeated for `action_repeat` intervals, whose rewards are summed and scaled. With
    `paired_baseline` the rewards of vehicles that stay in ride on the same roads are subtracted:
    of each pair of rows of `env` the second one, so that there are half as many environments. After
    one vehicle of a pair has rolled over, the two drive different roads of the same kind.
    """

    def __init__(
        self,
        env: RoadReconVecEnv,
        seed: int,
        *,
        reward_scale: float = 1.0,
        action_repeat: int = 1,
        paired_baseline: bool = False,
        preview: bool = False,
    ):
        self.rows = 2 if paired_baseline else 1
        self.env, self.n_envs = env, env.num_envs // self.rows
        self.reward_scale, self.action_repeat = reward_scale, action_repeat
        env.seed(seed, alike=self.rows)
        setup = env.env.setup
        context = PolicyContext.from_setup(setup, self.n_envs, seed)
        self.features = FeatureExtractor(context, preview)
        shape = (n_features(preview),)
        space = gymnasium.spaces.Box(-MAX_FEATURE, MAX_FEATURE, shape, dtype=np.float32)
        super().__init__(self.n_envs, space, setup.action_space)

    def reset(self) -> np.ndarray:
        """Start episodes in all environments, and return the features (N, K)."""
        self.features.reset(np.ones(self.n_envs, dtype=bool))
        return self.features.update(self.env.reset()[:: self.rows])

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions (N,) for `step_wait`."""
        self._actions = np.asarray(actions)

    def step_wait(self):
        """Return features, rewards, dones (N, ...) and infos.

        Rewards after the end of an episode are discarded.
        """
        env, features = self.env, self.features
        total, ended = np.zeros(self.n_envs, dtype=np.float32), np.zeros(self.n_envs, dtype=bool)
        infos: list[dict[str, Any]] = [{} for _ in range(self.n_envs)]
        row_actions = np.full(env.num_envs, features.context.action_index(*RIDE))
        row_actions[:: self.rows] = self._actions
        for _ in range(self.action_repeat):
            every_row: Any = env.step(row_actions)
            observations, rewards, dones, part_infos = (x[:: self.rows] for x in every_row)
            if self.rows > 1:
                rewards = rewards - every_row[1][1::2]
            total += np.where(ended, 0.0, self.reward_scale * rewards).astype(np.float32)
            newly_ended = np.flatnonzero(dones & ~ended)
            if newly_ended.size:  # the learner bootstraps from the last features if truncated
                last = self._terminal_features(part_infos, newly_ended)
                for i, terminal in zip(newly_ended, last, strict=True):
                    infos[i] = {**part_infos[i], "terminal_observation": terminal}
            features.reset(dones)
            observations = features.update(observations)
            ended |= dones
        return observations, total, ended, infos

    def close(self) -> None:
        """Do nothing; there are no resources to release."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute once for each environment; all environments share it."""
        return self.env.get_attr(attr_name)[: self.n_envs]

    def _terminal_features(self, part_infos: list[dict[str, Any]], ended: np.ndarray):
        """Return features (E, K) of the last observations of the environments `ended` (E,).

        The states of filtered features are taken as zero.
        """
        last = np.stack([part_infos[i]["terminal_observation"] for i in ended])
        observations = np.zeros((self.n_envs, last.shape[1]), dtype=last.dtype)
        observations[ended] = last
        extractor = FeatureExtractor(self.features.context, self.features.preview is not None)
        return extractor.update(observations)[ended]


def train(
    config: TrainingConfig,
    seed: int,
    *,
    checkpoint: Path | None = None,
    log: Path | None = None,
    progress: Progress = lambda text, share: None,
) -> TrainingResult:
    """Train on the drives of the split "train", with evaluations on some of them.

    An existing `checkpoint` is resumed; it is written after every evaluation. `log` is a folder for
    TensorBoard, if that is installed. Raises ConfigError.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # several threads are slower for layers this small
    try:
        return _train(config, seed, checkpoint, log, progress)
    finally:
        torch.set_num_threads(threads)


def _train(config, seed, checkpoint, log, progress) -> TrainingResult:
    rows = (1 + config.paired_baseline) * config.n_envs
    envs = FeatureVecEnv(
        RoadReconVecEnv(rows, vector_class=Safe4S4VectorEnv, cost_price=VIOLATION_PRICE),
        seed,
        reward_scale=config.reward_scale,
        action_repeat=config.action_repeat,
        paired_baseline=config.paired_baseline,
        preview=config.preview,
    )
    drives = training_drives(config.drives)
    model = _model(config, envs, seed, log)
    state: dict[str, Any] = {"steps": 0, "best": -np.inf, "curve": [], "network": None}
    if checkpoint is not None and checkpoint.exists():
        _resume(model, state, checkpoint, config)
    metadata = {  # the keys are those of the file format of `network_policy`
        "activation": "tanh" if config.algorithm == "ppo" else "relu",
        "control": drives.setup.options.control,
        "held": config.action_repeat,
        "ahead": config.preview,
        "algorithm": config.algorithm,
        "seed": seed,
        "steps": config.steps,
    }
    while state["steps"] < config.steps:
        steps = min(config.eval_interval, config.steps - state["steps"])
        callback = _progress_callback(progress, config.steps)
        model.learn(steps, callback=callback, reset_num_timesteps=False)
        state["steps"] = int(model.num_timesteps)
        network = PolicyNetwork(_actor_layers(model, config.algorithm), metadata)
        score = float(drive_all(NetworkPolicy.from_network(network), drives).score.mean())
        state["curve"].append((state["steps"], score))
        if score > state["best"]:
            state["best"], state["network"] = score, network
        if checkpoint is not None:
            _save_checkpoint(model, state, checkpoint, config)
    return TrainingResult(state["network"], tuple(map(tuple, state["curve"])))


def _model(config: TrainingConfig, envs: FeatureVecEnv, seed: int, log: Path | None):
    layers = list(config.layers)
    activation = torch.nn.Tanh if config.algorithm == "ppo" else torch.nn.ReLU
    shape: Any = {"pi": layers, "vf": layers} if config.algorithm == "ppo" else layers
    cls: Any = {"ppo": PPO, "dqn": DQN}.get(config.algorithm) or _qrdqn()
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
        ride = envs.features.context.action_index(*RIDE)
        model.policy.action_net.bias.data[ride] += config.ride_logit_bias
    return model


def _qrdqn() -> Any:
    with optional_import("training by QR-DQN"):
        from sb3_contrib import QRDQN

    return QRDQN


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
        value = model.policy.quantile_net if algorithm == "qrdqn" else model.policy.q_net
        net = list(value.quantile_net if algorithm == "qrdqn" else value.q_net)
    layers = [
        (layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy())
        for layer in net
        if isinstance(layer, torch.nn.Linear)
    ]
    if algorithm == "qrdqn":
        # rows are quantiles of the actions in turn; the value of an action is their mean
        W, b = layers.pop()
        n = int(model.action_space.n)
        layers.append((W.reshape(-1, n, W.shape[1]).mean(axis=0), b.reshape(-1, n).mean(axis=0)))
    return tuple(layers)


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
