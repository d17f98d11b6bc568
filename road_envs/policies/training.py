"""Learning with Stable-Baselines3 on the native vector environment; what comes out is a `Network`.

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
from stable_baselines3.common.vec_env import VecEnv

from road_envs._atomic_io import whole
from road_envs.config import STRICT, ConfigError
from road_envs.envs.sb3 import RoadReconVecEnv
from road_envs.policies.api import Cabin
from road_envs.policies.features import MOST, Features, width
from road_envs.policies.network_policy import Learned, Network
from road_envs.policies.rollout import drive

RIDE = ("ride", "ride")
"""What the twins do."""

Progress = Callable[[str, float], None]


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How a policy is learnt: `algorithm` with its `hyper` parameters as Stable-Baselines3 names
    them, choices `steps` in all, cars side by side for each case, layers of the network,
    evaluation every `every` steps on roads of the training seeds, weight of `information`. An
    action is held for `held` intervals: what is tried at random must last to make a difference.
    A step of the learner is one choice of an action. With `twins` the reward is what is gained over
    a car in ride on the same road: the road's share of it falls out, the best policy stays.
    With `ahead` the features tell of the road ahead of the rear axle. PPO begins with ride more
    likely by exp(`lean`) than any other pair: whether another pair pays is seen only when it is an
    exception, not amid random ones.
    """

    __pydantic_config__ = STRICT

    algorithm: Literal["ppo", "dqn"] = "ppo"
    steps: int = 300_000
    cars: int = 16
    layers: tuple[int, ...] = (64, 64)
    every: int = 50_000
    information: float = 0.0
    held: int = 5
    twins: bool = False
    ahead: bool = False
    lean: float = 0.0
    reward_scale: float = 10.0
    hyper: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        if min(self.steps, self.cars, self.every, self.held, *self.layers) < 1:
            raise ValueError("steps, cars, every, held and layers must be at least 1")


@dataclass(frozen=True)
class Learnt:
    """The best network by its own evaluations, and the evaluations: steps, return per second."""

    network: Network
    curve: tuple[tuple[int, float], ...]


class Cases(VecEnv):
    """`cars` environments of each case as one, observed through Features; an action is held for
    `held` intervals, and their rewards are added and scaled. With `twins`, less the rewards of
    cars that stay in ride on the same roads (once one of a pair turns over, on others of the kind).
    """

    def __init__(
        self,
        cases: Sequence[dict[str, Any]],
        cars: int,
        seed: int,
        scale: float,
        held: int = 1,
        twins: bool = False,
        ahead: bool = False,
    ):
        self.envs, self.twins = (
            [RoadReconVecEnv(cars, **options) for options in some]
            for some in (cases, cases if twins else [])
        )
        self.cars, self.scale, self.held = cars, scale, held
        for envs in (self.envs, self.twins):
            for i, env in enumerate(envs):
                env.seed(seed + 1_000_000 * (i + 1))
        setups = [env.env.setup for env in self.envs]
        if len({setup.action_space.n for setup in setups}) > 1:
            raise ConfigError("all cases must have one control")
        self.features = [Features(Cabin.of(setup, cars, seed), ahead) for setup in setups]
        space = gymnasium.spaces.Box(-MOST, MOST, (width(ahead),), dtype=np.float32)
        super().__init__(cars * len(self.envs), space, setups[0].action_space)

    def reset(self) -> np.ndarray:
        """Features (N, K) at the beginning."""
        everyone = np.ones(self.cars, dtype=bool)
        for features in self.features:
            features.restart(everyone)
        seen = [env.reset() for env in self.envs]
        for twin in self.twins:
            twin.reset()
        return np.concatenate([f.of(o) for f, o in zip(self.features, seen, strict=True)])

    def step_async(self, actions: np.ndarray) -> None:
        """Note the actions (N,)."""
        self.chosen = np.split(np.asarray(actions), len(self.envs))

    def step_wait(self):
        """Features, rewards, dones (N, ...) and infos."""
        twins: list[RoadReconVecEnv | None] = [*self.twins] or [None] * len(self.envs)
        parts = [
            self._hold(*each)
            for each in zip(self.envs, twins, self.features, self.chosen, strict=True)
        ]
        seen, rewards, dones, told = zip(*parts, strict=True)
        infos = [info for part in told for info in part]
        return np.concatenate(seen), np.concatenate(rewards), np.concatenate(dones), infos

    def _hold(
        self,
        env: RoadReconVecEnv,
        twin: RoadReconVecEnv | None,
        features: Features,
        actions: np.ndarray,
    ):
        """One case: what comes after an episode's end within the hold counts for nobody."""
        total, ended = np.zeros(self.cars, dtype=np.float32), np.zeros(self.cars, dtype=bool)
        infos: list[dict[str, Any]] = [{} for _ in range(self.cars)]
        for _ in range(self.held):
            env.step_async(actions)
            observations, rewards, dones, told = env.step_wait()
            if twin is not None:
                rewards = rewards - twin.step(np.full(self.cars, features.cabin.action(*RIDE)))[1]
            total += np.where(ended, 0.0, self.scale * rewards).astype(np.float32)
            fresh = np.flatnonzero(dones & ~ended)
            if fresh.size:  # an end is only cut off, so the last view matters
                for i, view in zip(fresh, self._last(features, told, fresh), strict=True):
                    infos[i] = {**told[i], "terminal_observation": view}
            features.restart(dones)
            seen = features.of(observations)
            ended |= dones
        return seen, total, ended, infos

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

    def _last(self, features: Features, told: list[dict[str, Any]], ended: np.ndarray):
        """Features (E, K) of the last observations of cars `ended` (E,), as if they had no past."""
        views = np.stack([told[i]["terminal_observation"] for i in ended])
        seen = np.zeros((self.cars, views.shape[1]), dtype=views.dtype)
        seen[ended] = views
        return Features(features.cabin, features.road is not None).of(seen)[ended]


def train(
    recipe: Recipe,
    cases: Sequence[dict[str, Any]],
    seeds: Sequence[int],
    seed: int,
    *,
    checkpoint: Path | None = None,
    log: Path | None = None,
    progress: Progress = lambda text, share: None,
) -> Learnt:
    """Learn on `cases` (options of the environment), judged on the roads of `seeds`.

    A `checkpoint` is taken up if it is there, and written after every evaluation; `log` is a folder
    for TensorBoard, where that is installed. Raises ConfigError.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # layers this small only lose by being split
    try:
        return _train(recipe, cases, seeds, seed, checkpoint, log, progress)
    finally:
        torch.set_num_threads(threads)


def _train(recipe, cases, seeds, seed, checkpoint, log, progress) -> Learnt:
    cases = [_with_information(options, recipe.information) for options in cases]
    envs = Cases(
        cases, recipe.cars, seed, recipe.reward_scale, recipe.held, recipe.twins, recipe.ahead
    )
    model = _model(recipe, envs, seed, log)
    state: dict[str, Any] = {"steps": 0, "best": -np.inf, "curve": [], "network": None}
    if checkpoint is not None and checkpoint.exists():
        _take_up(model, state, checkpoint, recipe)
    about = {
        "activation": "tanh" if recipe.algorithm == "ppo" else "relu",
        "control": cases[0]["control"],
        "held": recipe.held,
        "ahead": recipe.ahead,
        "algorithm": recipe.algorithm,
        "seed": seed,
        "steps": recipe.steps,
        "information": recipe.information,
    }
    while state["steps"] < recipe.steps:
        part = min(recipe.every, recipe.steps - state["steps"])
        done = state["steps"]
        model.learn(part, callback=_bar(progress, done, recipe.steps), reset_num_timesteps=False)
        state["steps"] = int(model.num_timesteps)
        network = Network(_layers(model, recipe.algorithm), about)
        score = evaluate(network, cases, seeds)
        state["curve"].append((state["steps"], score))
        if score > state["best"]:
            state["best"], state["network"] = score, network
        if checkpoint is not None:
            _put_down(model, state, checkpoint, recipe)
    return Learnt(state["network"], tuple(map(tuple, state["curve"])))


def evaluate(network: Network, cases: Sequence[dict[str, Any]], seeds: Sequence[int]) -> float:
    """Mean return per second over `cases` and roads of `seeds`."""
    policy = Learned.of(network)
    rates = []
    for options in cases:
        driven = drive(policy, options, seeds, keep=False)
        rates.append(driven.returns / (driven.intervals / options["control_rate"]))
    return float(np.mean(rates))


def _with_information(options: dict[str, Any], weight: float) -> dict[str, Any]:
    return {**options, "weights": {**options.get("weights", {}), "information": weight}}


def _model(recipe: Recipe, envs: Cases, seed: int, log: Path | None):
    import torch
    from stable_baselines3 import DQN, PPO

    layers = list(recipe.layers)
    activation = torch.nn.Tanh if recipe.algorithm == "ppo" else torch.nn.ReLU
    shape: Any = {"pi": layers, "vf": layers} if recipe.algorithm == "ppo" else layers
    cls: Any = PPO if recipe.algorithm == "ppo" else DQN
    try:
        model = cls(
            "MlpPolicy",
            envs,
            seed=seed,
            device="cpu",
            policy_kwargs={"net_arch": shape, "activation_fn": activation},
            tensorboard_log=str(log) if log is not None and _has_tensorboard() else None,
            **recipe.hyper,
        )
    except (TypeError, ValueError) as error:
        raise ConfigError(f"hyper parameters of {recipe.algorithm}: {error}") from None
    if recipe.algorithm == "ppo":
        model.policy.action_net.bias.data[envs.features[0].cabin.action(*RIDE)] += recipe.lean
    return model


def _has_tensorboard() -> bool:
    from importlib.util import find_spec

    return find_spec("tensorboard") is not None


def _bar(progress: Progress, done: int, total: int):
    from stable_baselines3.common.callbacks import BaseCallback

    class Bar(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls % 32 == 0:
                progress(f"{self.num_timesteps} of {total} steps", self.num_timesteps / total)
            return True

    return Bar()


def _layers(model: Any, algorithm: str) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """The acting network of a model as plain arrays."""
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


def _put_down(model: Any, state: dict[str, Any], path: Path, recipe: Recipe) -> None:
    """Write what is needed to go on; the old file stays until the new one is whole."""
    import torch

    plain = {"steps": state["steps"], "best": state["best"], "curve": state["curve"]}
    network = {
        f"{kind}_{i}": torch.from_numpy(array)
        for i, layer in enumerate(state["network"].layers)
        for kind, array in zip("Wb", layer, strict=True)
    }
    with whole(path) as partial:
        torch.save(
            {
                "policy": model.policy.state_dict(),
                "optimizer": model.policy.optimizer.state_dict(),
                "network": network,
                "state": json.dumps(plain),
                "recipe": repr(recipe),
                "about": json.dumps(state["network"].about),
            },
            partial,
        )


def _take_up(model: Any, state: dict[str, Any], path: Path, recipe: Recipe) -> None:
    """Go on from a checkpoint. Raises ConfigError if it is damaged or of another recipe."""
    import pickle

    import torch

    try:
        stored = torch.load(path, weights_only=True)
        if stored["recipe"] != repr(recipe):
            raise ConfigError(f"{path}: belongs to another recipe; train into another file")
        model.policy.load_state_dict(stored["policy"])
        model.policy.optimizer.load_state_dict(stored["optimizer"])
        state |= json.loads(stored["state"])
        arrays, about = stored["network"], json.loads(stored["about"])
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
    state["network"] = Network(tuple((W.numpy(), b.numpy()) for W, b in layers), about)
    model.num_timesteps = state["steps"]
