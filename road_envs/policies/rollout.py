"""A policy driven over roads: one car for each seed, side by side, without the truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from road_envs.envs.vector import RoadReconVectorEnv
from road_envs.policies.api import Policy, PolicyContext, validate_actions

POLICY_SEED = 0
"""For the policies' own draws."""


@dataclass(frozen=True)
class Rollout:
    """What N cars did and saw in at most T intervals after the first one, which no action decided.

    `actions` (T, N); `observations` (T + 1, N, d); `intervals` (N,), how many of the T were driven;
    `returns` (N,) of the reward; `reasons` (N,), why a drive failed, else empty.
    """

    actions: np.ndarray
    observations: np.ndarray
    intervals: np.ndarray
    returns: np.ndarray
    reasons: tuple[str, ...]


def roll_out(
    policy: Policy,
    options: dict[str, Any],
    seeds: Sequence[int],
    *,
    store_observations: bool = True,
    progress: Callable[[float], None] = lambda share: None,
) -> Rollout:
    """Drive the roads of `seeds` in environments with `options`, to their ends.

    Observations are kept only if `store_observations`. Raises PolicyError for actions that are
    none, ConfigError, and whatever the policy raises.
    """
    envs = RoadReconVectorEnv(len(seeds), **{**options, "truth": False})
    observations, _ = envs.reset(seed=list(seeds))
    context = PolicyContext.from_setup(envs.setup, len(seeds), POLICY_SEED)
    policy.reset(context)
    alive = np.ones(len(seeds), dtype=bool)
    returns, intervals = np.zeros(len(seeds)), np.zeros(len(seeds), dtype=int)
    reasons, actions, seen = [""] * len(seeds), [], [observations.copy()]
    total = envs.fleet.steps_left.max() / envs.fleet.steps
    while alive.any():
        selected_actions = validate_actions(policy.act(observations), context)
        observations, rewards, terminated, truncated, infos = envs.step(selected_actions)
        returns += np.where(alive, rewards, 0.0)
        intervals += alive
        for i in np.flatnonzero(alive & terminated):
            reasons[i] = infos["reason"][i]
        alive &= ~(terminated | truncated)
        actions.append(selected_actions.copy())
        if store_observations:
            seen.append(observations.copy())
        progress(min(len(actions) / total, 1.0))
    return Rollout(np.array(actions), np.array(seen), intervals, returns, tuple(reasons))
