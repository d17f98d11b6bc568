"""Training of a network by Stable-Baselines3 on the training drives of `RoadRecon/Safe4S4-v1`.

    python -m studies.trained_networks {ppo,dqn,qrdqn} --out mine.npz [--seed 1] [--steps N]

Every episode draws a new training drive. The network with the best score on some of them is
written; `road-recon policies --policy mine.npz` gives it a row and a page. `studies.agents` trains
these and a recurrent one from several seeds and compares them.
"""

import argparse
import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from road_envs.core.atomic_io import atomic_write
from road_envs.core.config import ConfigError, Count, Settings
from road_envs.core.extras import optional_import
from road_envs.envs.safe4s4 import Safe4S4VectorEnv
from road_envs.envs.sb3 import RoadReconVecEnv
from road_envs.policies.api import PolicyContext
from road_envs.policies.feature_env import RIDE, FeatureVecEnv
from road_envs.policies.features import FeatureExtractor
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork, sb3_layers
from road_envs.policies.rollout import VIOLATION_PRICE, drive_all
from studies.tuned_policies import training_drives

with optional_import("training a policy"):
    import torch
    from stable_baselines3 import DQN, PPO

Progress = Callable[[str, float], None]
"""Called with a description and the share done."""


@dataclass(frozen=True, kw_only=True)
class TrainingConfig(Settings):
    """Settings of a training; a step is one choice of an action in one environment."""

    algorithm: Literal["ppo", "dqn", "qrdqn", "recurrent_ppo"] = "ppo"
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
    # makes ride exp(bias) times likelier at the start of PPO: the gain of another pair shows
    # only against constant ride, not against random switching
    ride_logit_bias: float = 0.0
    hyperparameters: dict[str, Any] = field(default_factory=dict)  # of Stable-Baselines3


class TrainingResult(NamedTuple):
    """Policy of the best evaluation, and all evaluations as (steps, mean score).

    The policy is a `NetworkPolicy`, of recurrent networks a `RecurrentPolicy`.
    """

    policy: Any
    curve: tuple[tuple[int, float], ...]


class RecurrentPolicy:
    """Policy of a recurrent network of sb3-contrib on features, with a new action every `held`."""

    def __init__(self, network: Any, held: int):
        self.network, self.held = network, held

    def reset(self, context: PolicyContext) -> None:
        """Forget the drives so far."""
        self.features, self.state, self.n_intervals = FeatureExtractor(context), None, 0

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,)."""
        features = self.features.update(observations)
        if self.n_intervals % self.held == 0:
            self.actions, self.state = self.network.predict(
                features, self.state, np.full(len(features), self.n_intervals == 0), True
            )
        self.n_intervals += 1
        return self.actions


VALUE_LEARNING: dict[str, Any] = {
    "steps": 100_000,
    "layers": (128, 128),
    "eval_interval": 12_500,
    "paired_baseline": True,
    "hyperparameters": {
        "learning_rate": 0.0005,
        "buffer_size": 100_000,
        "learning_starts": 2000,
        "batch_size": 256,
        "gamma": 0.95,
        "train_freq": 1,
        "gradient_steps": 8,
        "target_update_interval": 2000,
        "exploration_fraction": 0.3,
        "exploration_final_eps": 0.05,
    },
}
POLICY_GRADIENT: dict[str, Any] = {
    "steps": 76_800,
    "eval_interval": 15_360,
    "action_repeat": 4,
    "paired_baseline": True,
    "ride_logit_bias": 2.0,
    "hyperparameters": {
        "n_steps": 60,
        "batch_size": 480,
        "n_epochs": 10,
        "learning_rate": 0.001,
        "gamma": 0.97,
        "gae_lambda": 0.95,
        "ent_coef": 0.03,
    },
}
GRADIENT = ("ppo", "recurrent_ppo")
"""Algorithms whose networks give probabilities."""

QUANTILES = 25
"""Quantiles of QR-DQN: its loss compares all pairs, and 200, the default, take 80 times as long."""

CONFIGS = {
    "ppo": TrainingConfig(**POLICY_GRADIENT),
    "recurrent_ppo": TrainingConfig(algorithm="recurrent_ppo", **POLICY_GRADIENT),
    "dqn": TrainingConfig(algorithm="dqn", **VALUE_LEARNING),
    "qrdqn": TrainingConfig(algorithm="qrdqn", **VALUE_LEARNING),
}
"""Settings by algorithm, by development runs on training drives."""


def train(
    config: TrainingConfig, seed: int, progress: Progress = lambda text, share: None
) -> TrainingResult:
    """Train on the drives of the split "train", with evaluations on some of them.

    Raises ConfigError.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # several threads are slower for layers this small
    try:
        return _train(config, seed, progress)
    finally:
        torch.set_num_threads(threads)


def _train(config: TrainingConfig, seed: int, progress: Progress) -> TrainingResult:
    rows = (1 + config.paired_baseline) * config.n_envs
    envs = FeatureVecEnv(
        RoadReconVecEnv(rows, vector_class=Safe4S4VectorEnv, cost_price=VIOLATION_PRICE),
        seed,
        action_repeat=config.action_repeat,
        paired_baseline=config.paired_baseline,
    )
    drives = training_drives(config.drives)
    model = _model(config, envs, seed)
    metadata = {  # the keys are those of the file format of `network_policy`
        "activation": "tanh" if config.algorithm in GRADIENT else "relu",
        "control": drives.setup.options.control,
        "held": config.action_repeat,
        "algorithm": config.algorithm,
        "seed": seed,
        "steps": config.steps,
    }

    def report(local: Any, _: Any) -> bool:
        steps = local["self"].num_timesteps
        progress(f"{steps} of {config.steps} steps", steps / config.steps)
        return True

    best: tuple[float, Any, Any] = (-np.inf, None, None)
    curve = []
    while model.num_timesteps < config.steps:
        steps = min(config.eval_interval, config.steps - model.num_timesteps)
        model.learn(steps, callback=report, reset_num_timesteps=False)
        policy: Any
        if config.algorithm == "recurrent_ppo":
            policy = RecurrentPolicy(model.policy, config.action_repeat)
        else:
            layers = sb3_layers(model.policy.state_dict(), int(model.action_space.n))
            policy = NetworkPolicy.from_network(PolicyNetwork(layers, metadata))
        score = float(drive_all(policy, drives).score.mean())
        curve.append((int(model.num_timesteps), score))
        if score > best[0]:
            best = score, policy, copy.deepcopy(model.policy.state_dict())
    if config.algorithm == "recurrent_ppo":  # its policy has gone on learning
        model.policy.load_state_dict(best[2])
    return TrainingResult(best[1], tuple(curve))


def _model(config: TrainingConfig, envs: FeatureVecEnv, seed: int) -> Any:
    """Return the learner. Raises ConfigError on hyperparameters that it does not know."""
    layers, gradient = list(config.layers), config.algorithm in GRADIENT
    kwargs: dict[str, Any] = {
        "net_arch": {"pi": layers, "vf": layers} if gradient else layers,
        "activation_fn": torch.nn.Tanh if gradient else torch.nn.ReLU,
    }
    cls: Any = {"ppo": PPO, "dqn": DQN}.get(config.algorithm)
    if cls is None:
        with optional_import(f"training by {config.algorithm}"):
            import sb3_contrib

        cls = {"qrdqn": sb3_contrib.QRDQN}.get(config.algorithm, sb3_contrib.RecurrentPPO)
    if config.algorithm == "qrdqn":
        kwargs["n_quantiles"] = QUANTILES
    recurrent = config.algorithm == "recurrent_ppo"
    if recurrent:
        kwargs["lstm_hidden_size"] = layers[0]
    try:
        model = cls(
            "MlpLstmPolicy" if recurrent else "MlpPolicy",
            envs,
            seed=seed,
            device="cpu",
            policy_kwargs=kwargs,
            **config.hyperparameters,
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(f"hyperparameters of {config.algorithm}: {error}") from None
    if gradient:
        ride = envs.features.context.action_index(*RIDE)
        model.policy.action_net.bias.data[ride] += config.ride_logit_bias
    return model


def main() -> None:
    """Train a network, print its learning curve and write it."""
    parser = argparse.ArgumentParser(description="Train a switching policy on training drives.")
    parser.add_argument("algorithm", choices=[name for name in CONFIGS if "recurrent" not in name])
    parser.add_argument("--out", type=Path, required=True, help="file of the network (.npz)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, help="actions in all environments")
    arguments = parser.parse_args()
    config = CONFIGS[arguments.algorithm]
    if arguments.steps:
        config = replace(config, steps=arguments.steps)
    policy, curve = train(config, arguments.seed)
    for steps, score in curve:
        print(f"{steps:8d} steps  score {score:.4f} on training drives")
    with atomic_write(arguments.out) as partial:
        partial.write_bytes(policy.network.to_bytes())


if __name__ == "__main__":
    main()
