"""Rollouts of a policy: one vehicle for each seed, all at once, without access to the truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from road_envs.envs.vector import RoadReconVectorEnv
from road_envs.policies.api import Policy, PolicyContext, validate_actions

POLICY_SEED = 0
"""Seed of random policies."""


@dataclass(frozen=True)
class Rollout:
    """Actions, rewards, observations and returns of N vehicles over at most T control intervals.

    `actions` and `rewards` (T, N), of which those after the end of a drive mean nothing;
    `observations` (T + 1, N, d), the first one of the interval that reset drives; `intervals` (N,),
    the number of intervals until the end; `returns` (N,), the sum of rewards; `reasons` (N,), why a
    drive failed, else empty.
    """

    actions: np.ndarray
    rewards: np.ndarray
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
    """Run a policy on the roads of `seeds`, in environments with `options`, to their ends.

    With `store_observations` False only the first observations are stored. `progress` is called
    with the share done. Raises PolicyError for invalid actions, ConfigError, and what the policy
    raises.
    """
    envs = RoadReconVectorEnv(len(seeds), **{**options, "truth": False})
    observations, _ = envs.reset(seed=list(seeds))
    context = PolicyContext.from_setup(envs.setup, len(seeds), POLICY_SEED)
    policy.reset(context)
    running = np.ones(len(seeds), dtype=bool)
    returns, intervals = np.zeros(len(seeds)), np.zeros(len(seeds), dtype=int)
    reasons, actions, earned = [""] * len(seeds), [], []
    stored = [observations.copy()]
    total = envs.fleet.steps_left.max() / envs.fleet.steps
    while running.any():
        selected_actions = validate_actions(policy.act(observations), context)
        observations, rewards, terminated, truncated, _ = envs.step(selected_actions)
        returns += np.where(running, rewards, 0.0)
        intervals += running
        for i in np.flatnonzero(running & terminated):
            reasons[i] = envs.failures[i]
        running &= ~(terminated | truncated)
        actions.append(selected_actions.copy())
        earned.append(rewards.copy())
        if store_observations:
            stored.append(observations.copy())
        progress(min(len(actions) / total, 1.0))
    steps = np.array(actions), np.array(earned), np.array(stored)
    return Rollout(*steps, intervals, returns, tuple(reasons))
