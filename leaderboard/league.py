"""Suspension-switching policies compared on roads that none of them has driven before.

Every policy drives the same roads. Learners train on roads drawn from other seeds. Without a
manoeuvre there is nothing that handling is good for, so fixed ride is hard to beat here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

import road_envs
from leaderboard.statistics import Interval, interval
from road_envs.config import ConfigError, one_of
from road_envs.policies import REGISTRY, Learner, Policy

SCENARIO: dict[str, Any] = {"road": "iso_d", "speed_kmh": 54.0, "length": 100.0, "truth": True}
"""Keyword arguments of the environment in which policies are compared."""

TEST_SEEDS = range(1001, 1011)
TRAINING_SEED = 1
LEARNING_STEPS = 60_000
"""Control intervals that a learner gets: about a minute on one core."""

METRICS = {
    "comfort": "Wk-weighted RMS heave acceleration [m/s²]",
    "rattle": "RMS strut extension [m]",
    "tyre_load": "dynamic tyre load coefficient [-]",
    "switches_per_km": "changes of the command [1/km]",
    "episode_return": "return of the reward [-]",
}

Progress = Callable[[str, float], None]
"""Hears what is being done and the share of all work that is done."""


@dataclass(frozen=True)
class Standing:
    """One policy's metrics: per drive (R,), and the interquartile mean with its 95 % interval."""

    policy: str
    drives: Mapping[str, np.ndarray]
    intervals: Mapping[str, Interval]
    failure: str | None = None


def compare(
    names: Sequence[str],
    *,
    scenario: Mapping[str, Any] = SCENARIO,
    learning_steps: int = LEARNING_STEPS,
    seeds: Sequence[int] = TEST_SEEDS,
    progress: Progress = lambda text, share: None,
) -> list[Standing]:
    """Train the learners, drive every policy over every road; a failure is a row.

    Raises ConfigError for an unknown policy, a bad scenario or a training seed among `seeds`.
    """
    for name in names:
        one_of("policy", name, REGISTRY)
    if TRAINING_SEED in seeds:
        raise ConfigError(f"seed {TRAINING_SEED} is for training; test on others")
    env = gymnasium.make(road_envs.ID, **scenario)
    standings = []
    for i, name in enumerate(names):

        def report(share: float, name: str = name, i: int = i) -> None:
            progress(name, (i + share) / len(names))

        try:
            standings.append(_standing(name, env, dict(scenario), learning_steps, seeds, report))
        except Exception as error:  # whatever a policy does wrong is its own row's news
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            standings.append(Standing(name, {}, {}, reason))
    progress("done", 1.0)
    return standings


def _standing(name, env, scenario, learning_steps, seeds, report) -> Standing:
    policy, begin = REGISTRY[name](), 0.0
    if isinstance(policy, Learner):
        options, begin = {**scenario, "truth": False}, 0.9
        policy.learn(options, learning_steps, TRAINING_SEED, lambda x: report(0.9 * x))
    episodes = []
    for k, seed in enumerate(seeds):
        report(begin + (1.0 - begin) * k / len(seeds))
        episodes.append(episode(policy, env, seed))
    drives = {metric: np.array([e[metric] for e in episodes]) for metric in METRICS}
    return Standing(name, drives, {m: interval(x[:, None, None]) for m, x in drives.items()})


def episode(policy: Policy, env: gymnasium.Env, seed: int) -> dict[str, float]:
    """METRICS of one drive under `policy` on the road of `seed`."""
    observation, info = env.reset(seed=seed)
    actions: Any = env.action_space
    policy.reset(int(actions.n), seed)
    start, last, switches, total = info["station"], None, 0, 0.0
    squares: dict[str, list[float]] = {"comfort": [], "rattle": [], "tyre_load": []}
    over = False
    while not over:
        action = policy.act(observation)
        switches += last is not None and action != last
        last = action
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        total += float(reward)
        for name, values in squares.items():
            values.append(info[name] ** 2)
    rms = {name: float(np.sqrt(np.mean(values))) for name, values in squares.items()}
    distance_km = (info["station"] - start) / 1000.0
    return {**rms, "switches_per_km": switches / distance_km, "episode_return": total}
