"""Training of a `PolicyNetwork` with Stable-Baselines3 on the drives of `RoadRecon/Safe4S4-v1`.

Every episode draws a new training drive.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np

from road_envs.core.config import ConfigError, Count, Settings
from road_envs.core.extras import optional_import
from road_envs.envs.safe4s4 import Safe4S4VectorEnv
from road_envs.envs.sb3 import ArrayVecEnv, RoadReconVecEnv
from road_envs.policies.api import PolicyContext
from road_envs.policies.features import MAX_FEATURE, N_FEATURES, FeatureExtractor
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork, sb3_layers
from road_envs.policies.rollout import VIOLATION_PRICE, drive_all, training_drives

with optional_import("training a policy"):
    import torch
    from stable_baselines3 import DQN, PPO

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
    ):
        self.rows = 2 if paired_baseline else 1
        self.env, self.n_envs = env, env.num_envs // self.rows
        self.reward_scale, self.action_repeat = reward_scale, action_repeat
        env.seed(seed, alike=self.rows)
        setup = env.env.setup
        context = PolicyContext.from_setup(setup, self.n_envs, seed)
        self.features = FeatureExtractor(context)
        shape = (N_FEATURES,)
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
        return FeatureExtractor(self.features.context).update(observations)[ended]


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
        reward_scale=config.reward_scale,
        action_repeat=config.action_repeat,
        paired_baseline=config.paired_baseline,
    )
    drives = training_drives(config.drives)
    model = _model(config, envs, seed)
    metadata = {  # the keys are those of the file format of `network_policy`
        "activation": "tanh" if config.algorithm == "ppo" else "relu",
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

    best, curve = (-np.inf, PolicyNetwork((), metadata)), []
    while model.num_timesteps < config.steps:
        steps = min(config.eval_interval, config.steps - model.num_timesteps)
        model.learn(steps, callback=report, reset_num_timesteps=False)
        network = PolicyNetwork(
            sb3_layers(model.policy.state_dict(), int(model.action_space.n)), metadata
        )
        score = float(drive_all(NetworkPolicy.from_network(network), drives).score.mean())
        curve.append((int(model.num_timesteps), score))
        best = max(best, (score, network), key=lambda pair: pair[0])
    return TrainingResult(best[1], tuple(curve))


def _model(config: TrainingConfig, envs: FeatureVecEnv, seed: int) -> Any:
    """Return the learner. Raises ConfigError on hyperparameters that it does not know."""
    layers = list(config.layers)
    activation = torch.nn.Tanh if config.algorithm == "ppo" else torch.nn.ReLU
    shape: Any = {"pi": layers, "vf": layers} if config.algorithm == "ppo" else layers
    cls: Any = {"ppo": PPO, "dqn": DQN}.get(config.algorithm)
    if cls is None:
        with optional_import("training by QR-DQN"):
            import sb3_contrib

        cls = sb3_contrib.QRDQN
    try:
        model = cls(
            "MlpPolicy",
            envs,
            seed=seed,
            device="cpu",
            policy_kwargs={"net_arch": shape, "activation_fn": activation},
            **config.hyperparameters,
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(f"hyperparameters of {config.algorithm}: {error}") from None
    if config.algorithm == "ppo":
        ride = envs.features.context.action_index(*RIDE)
        model.policy.action_net.bias.data[ride] += config.ride_logit_bias
    return model
