"""A policy driven over roads: one car for each seed, side by side, without the truth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from road_envs.envs.vector import RoadReconVectorEnv
from road_envs.policies.api import Cabin, Policy, checked

POLICY_SEED = 0
"""For the policies' own draws."""


@dataclass(frozen=True)
class Driven:
    """What N cars did and saw in at most T intervals after the first one, which no action decided.

    `actions` (T, N); `observations` (T + 1, N, d); `intervals` (N,), how many of the T were driven;
    `returns` (N,) of the reward; `reasons` (N,), why a drive failed, else empty.
    """

    actions: np.ndarray
    observations: np.ndarray
    intervals: np.ndarray
    returns: np.ndarray
    reasons: tuple[str, ...]


def drive(
    policy: Policy,
    options: dict[str, Any],
    seeds: Sequence[int],
    *,
    keep: bool = True,
    report: Callable[[float], None] = lambda share: None,
) -> Driven:
    """Drive the roads of `seeds` in environments with `options`, to their ends.

    Observations are kept only if `keep`. Raises PolicyError for actions that are none, ConfigError,
    and whatever the policy raises.
    """
    envs = RoadReconVectorEnv(len(seeds), **{**options, "truth": False})
    observations, _ = envs.reset(seed=list(seeds))
    cabin = Cabin.of(envs.setup, len(seeds), POLICY_SEED)
    policy.reset(cabin)
    alive = np.ones(len(seeds), dtype=bool)
    returns, intervals = np.zeros(len(seeds)), np.zeros(len(seeds), dtype=int)
    reasons, actions, seen = [""] * len(seeds), [], [observations.copy()]
    total = envs.convoy.steps_left.max() / envs.convoy.steps
    while alive.any():
        chosen = checked(policy.act(observations), cabin)
        observations, rewards, terminated, truncated, infos = envs.step(chosen)
        returns += np.where(alive, rewards, 0.0)
        intervals += alive
        for i in np.flatnonzero(alive & terminated):
            reasons[i] = infos["reason"][i]
        alive &= ~(terminated | truncated)
        actions.append(chosen.copy())
        if keep:
            seen.append(observations.copy())
        report(min(len(actions) / total, 1.0))
    return Driven(np.array(actions), np.array(seen), intervals, returns, tuple(reasons))
