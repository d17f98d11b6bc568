"""Training with Stable-Baselines3 on the native vector environment; the result is a
`PolicyNetwork`.

Every case of the scenarios has its own vector environment, all are stepped as one, and their roads
are drawn from training seeds without end. What the learner holds is kept as tensors and numbers
(`torch.load` with `weights_only`), never as pickled objects, so a run can be taken up again from a
file that somebody else made. The replay buffer of DQN is not kept: it is filled anew.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np

from road_envs._atomic_io import atomic_write
from road_envs._extras import optional_import
from road_envs.config import STRICT, ConfigError
from road_envs.envs.sb3 import RoadReconVecEnv
from road_envs.policies.api import PolicyContext
from road_envs.policies.features import MAX_FEATURE, FeatureExtractor, n_features
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork
from road_envs.policies.rollout import roll_out

with optional_import("training a policy"):
    from stable_baselines3.common.vec_env import VecEnv

RIDE = ("ride", "ride")
"""What the twins do."""

Progress = Callable[[str, float], None]


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """How a policy is learnt: `algorithm` with its `hyperparameters` as Stable-Baselines3 names
    them, choices `steps` in all, cars side by side for each case, layers of the network,
    evaluation every `eval_interval` steps on roads of the training seeds, weight of
    `unresolved_variance`. An action is held for `action_repeat` intervals: what is tried at random
    must last to make a difference. A step of the learner is one choice of an action. With
    `paired_baseline` the reward is what is gained over a car in ride on the same road: the road's
    share of it falls out, the best policy stays. With `preview` the features tell of the road ahead
    of the rear axle. PPO begins with ride more likely by exp(`ride_logit_bias`) than any other
    pair: whether another pair pays is seen only when it is an exception, not amid random ones.
    """

    __pydantic_config__ = STRICT

    algorithm: Literal["ppo", "dqn"] = "ppo"
    steps: int = 300_000
    n_envs: int = 16
    layers: tuple[int, ...] = (64, 64)
    eval_interval: int = 50_000
    unresolved_variance: float = 0.0
    action_repeat: int = 5
    paired_baseline: bool = False
    preview: bool = False
    ride_logit_bias: float = 0.0
    reward_scale: float = 10.0
    hyperparameters: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        if min(self.steps, self.n_envs, self.eval_interval, self.action_repeat, *self.layers) < 1:
            raise ValueError(
                "steps, n_envs, eval_interval, action_repeat and layers must be at least 1"
            )


@dataclass(frozen=True)
class TrainingResult:
    """The best network by its own evaluations, and the evaluations: steps, return per second."""

    network: PolicyNetwork
    curve: tuple[tuple[int, float], ...]


class MultiScenarioVecEnv(VecEnv):
    """`n_envs` environments of each case as one, observed through Features; an action is held for
    `action_repeat` intervals, and their rewards are added and scaled. With `paired_baseline`, less
    the rewards of cars that stay in ride on the same roads (once one of a pair turns over, on
    others of the kind).
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
        self.envs, self.baselines = (
            [RoadReconVecEnv(n_envs, **options) for options in some]
            for some in (cases, cases if paired_baseline else [])
        )
        self.n_envs, self.reward_scale, self.action_repeat = n_envs, reward_scale, action_repeat
        for envs in (self.envs, self.baselines):
            for i, env in enumerate(envs):
                env.seed(seed + 1_000_000 * (i + 1))
        setups = [env.env.setup for env in self.envs]
        if len({setup.action_space.n for setup in setups}) > 1:
            raise ConfigError("all cases must have one control")
        self.features = [
            FeatureExtractor(PolicyContext.from_setup(setup, n_envs, seed), preview)
            for setup in setups
        ]
        space = gymnasium.spaces.Box(
            -MAX_FEATURE, MAX_FEATURE, (n_features(preview),), dtype=np.float32
        )
        super().__init__(n_envs * len(self.envs), space, setups[0].action_space)

    def reset(self) -> np.ndarray:
        """Features (N, K) at the beginning."""
        everyone = np.ones(self.n_envs, dtype=bool)
        for features in self.features:
            features.reset(everyone)
        observations = [env.reset() for env in self.envs]
        for baseline in self.baselines:
            baseline.reset()
        return np.concatenate(
            [f.update(o) for f, o in zip(self.features, observations, strict=True)]
        )

    def step_async(self, actions: np.ndarray) -> None:
        """Note the actions (N,)."""
        self.chosen = np.split(np.asarray(actions), len(self.envs))

    def step_wait(self):
        """Features, rewards, dones (N, ...) and infos."""
        baselines: list[RoadReconVecEnv | None] = [*self.baselines] or [None] * len(self.envs)
        parts = [
            self._repeat_action(*each)
            for each in zip(self.envs, baselines, self.features, self.chosen, strict=True)
        ]
        observations, rewards, dones, part_infos = zip(*parts, strict=True)
        infos = [info for part in part_infos for info in part]
        return np.concatenate(observations), np.concatenate(rewards), np.concatenate(dones), infos

    def _repeat_action(
        self,
        env: RoadReconVecEnv,
        baseline: RoadReconVecEnv | None,
        features: FeatureExtractor,
        actions: np.ndarray,
    ):
        """One case: what comes after an episode's end within the hold counts for nobody."""
        total, ended = np.zeros(self.n_envs, dtype=np.float32), np.zeros(self.n_envs, dtype=bool)
        infos: list[dict[str, Any]] = [{} for _ in range(self.n_envs)]
        for _ in range(self.action_repeat):
            env.step_async(actions)
            observations, rewards, dones, part_infos = env.step_wait()
            if baseline is not None:
                ride = np.full(self.n_envs, features.context.action_index(*RIDE))
                rewards = rewards - baseline.step(ride)[1]
            total += np.where(ended, 0.0, self.reward_scale * rewards).astype(np.float32)
            fresh = np.flatnonzero(dones & ~ended)
            if fresh.size:  # an end is only cut off, so the last view matters
                for i, view in zip(
                    fresh, self._terminal_features(features, part_infos, fresh), strict=True
                ):
                    infos[i] = {**part_infos[i], "terminal_observation": view}
            features.reset(dones)
            observations = features.update(observations)
            ended |= dones
        return observations, total, ended, infos

    def close(self) -> None:
        """Nothing is held that needs closing."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the first case, once for each environment."""
        return self.envs[0].get_attr(attr_name) * len(self.envs)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refused, as by the cases themselves."""
        self.envs[0].set_attr(attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any):
        """Refused, as by the cases themselves."""
        self.envs[0].env_method(method_name)

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No environment is wrapped by itself."""
        return [False] * self.num_envs

    def _terminal_features(
        self, features: FeatureExtractor, part_infos: list[dict[str, Any]], ended: np.ndarray
    ):
        """Features (E, K) of the last observations of cars `ended` (E,), as if they had no past."""
        views = np.stack([part_infos[i]["terminal_observation"] for i in ended])
        observations = np.zeros((self.n_envs, views.shape[1]), dtype=views.dtype)
        observations[ended] = views
        return FeatureExtractor(features.context, features.preview is not None).update(
            observations
        )[ended]


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
    """Learn on `cases` (options of the environment), judged on the roads of `seeds`.

    A `checkpoint` is taken up if it is there, and written after every evaluation; `log` is a folder
    for TensorBoard, where that is installed. Raises ConfigError.
    """
    with optional_import("a neural network"):
        import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # layers this small only lose by being split
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
    metadata = {
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
        part = min(config.eval_interval, config.steps - state["steps"])
        done = state["steps"]
        model.learn(
            part,
            callback=_progress_callback(progress, done, config.steps),
            reset_num_timesteps=False,
        )
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
    """Mean return per second over `cases` and roads of `seeds`."""
    policy = NetworkPolicy.from_network(network)
    rates = []
    for options in cases:
        driven = roll_out(policy, options, seeds, store_observations=False)
        rates.append(driven.returns / (driven.intervals / options["control_rate"]))
    return float(np.mean(rates))


def _with_information_weight(options: dict[str, Any], weight: float) -> dict[str, Any]:
    return {**options, "weights": {**options.get("weights", {}), "unresolved_variance": weight}}


def _model(config: TrainingConfig, envs: MultiScenarioVecEnv, seed: int, log: Path | None):
    with optional_import("a neural network"):
        import torch
        from stable_baselines3 import DQN, PPO

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
        raise ConfigError(f"hyper parameters of {config.algorithm}: {error}") from None
    if config.algorithm == "ppo":
        model.policy.action_net.bias.data[envs.features[0].context.action_index(*RIDE)] += (
            config.ride_logit_bias
        )
    return model


def _has_tensorboard() -> bool:
    from importlib.util import find_spec

    return find_spec("tensorboard") is not None


def _progress_callback(progress: Progress, done: int, total: int):
    with optional_import("training a policy"):
        from stable_baselines3.common.callbacks import BaseCallback

    class Bar(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls % 32 == 0:
                progress(f"{self.num_timesteps} of {total} steps", self.num_timesteps / total)
            return True

    return Bar()


def _actor_layers(model: Any, algorithm: str) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """The acting network of a model as plain arrays."""
    with optional_import("a neural network"):
        import torch

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
    """Write what is needed to go on; the old file stays until the new one is whole."""
    with optional_import("a neural network"):
        import torch

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
    """Go on from a checkpoint. Raises ConfigError if it is damaged or of another recipe."""
    import pickle

    with optional_import("a neural network"):
        import torch

    try:
        stored = torch.load(path, weights_only=True)
        if stored["config"] != repr(config):
            raise ConfigError(f"{path}: belongs to another recipe; train into another file")
        model.policy.load_state_dict(stored["policy"])
        model.policy.optimizer.load_state_dict(stored["optimizer"])
        state |= json.loads(stored["state"])
        arrays, metadata = stored["network"], json.loads(stored["about"])
    except (
        pickle.UnpicklingError,
        RuntimeError,
        LookupError,
        ValueError,
        OSError,
        EOFError,
    ) as error:
        if isinstance(error, ConfigError):
            raise
        said = str(error).splitlines()[0]
        raise ConfigError(f"{path}: not a checkpoint that can be taken up: {said}") from None
    layers = [(arrays[f"W_{i}"], arrays[f"b_{i}"]) for i in range(len(arrays) // 2)]
    state["network"] = PolicyNetwork(tuple((W.numpy(), b.numpy()) for W, b in layers), metadata)
    model.num_timesteps = state["steps"]
