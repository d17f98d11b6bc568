"""Linear policies found by an evolution strategy on the drives of `RoadRecon/Safe4S4-v1`.

    z_front = A_front h,   z_rear = A_rear h,   state of an axle = argmax of its four values

with the features h of `features`, which are equal for both sides, and 1. The whole drive's score is
maximised, violations and all, so that no reward has to be discounted. All candidates of a
generation drive all training drives at once, in the lanes of one fleet. The strategy is the
separable CMA-ES of Ros & Hansen (PPSN X, 2008): step size and variances of each weight are adapted.
It starts from a lateral threshold.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from road_envs.core.config import Count, Positive, Settings
from road_envs.policies.api import PolicyContext
from road_envs.policies.features import NAMES, FeatureExtractor
from road_envs.policies.network_policy import PolicyNetwork
from road_envs.policies.rollout import drive_all, training_drives
from road_envs.vehicle.suspension import MODES

STATES = tuple(MODES)

Progress = Callable[[str, float], None]
"""Called with a description and the share done."""


@dataclass(frozen=True, kw_only=True)
class EvolutionConfig(Settings):
    """Settings of the search; a step is a generation."""

    steps: Count = 29
    population: Count = 24
    drives: Count = 12  # of the split "train", each to both sides
    spread: Positive = 0.3  # of the weights in the first generation


@dataclass
class LinearPolicies:
    """One policy for every vehicle of each drive in turn: `weights` (P, 2, 4, K + 1)."""

    weights: np.ndarray

    def reset(self, context: PolicyContext) -> None:
        """Reset the features."""
        self.context, self.features = context, FeatureExtractor(context)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return the actions (D P,) of P policies on D drives."""
        h = self.features.update(observations).reshape(-1, len(self.weights), len(NAMES))
        h = np.concatenate([h, np.ones((*h.shape[:2], 1))], axis=2)
        # (D, P, K + 1) features and (P, 8, K + 1) weights: values of four states of either axle
        weights = self.weights.reshape(len(self.weights), -1, h.shape[2])
        values = np.matmul(weights, h.transpose(1, 2, 0)).transpose(2, 0, 1)
        front, rear = values.reshape(-1, 2, len(STATES)).argmax(axis=2).T
        return front + len(STATES) * rear


def evolve(
    config: EvolutionConfig, seed: int, progress: Progress = lambda text, share: None
) -> tuple[PolicyNetwork, tuple[tuple[int, float], ...]]:
    """Return the policy of the best mean weights, and the score of each generation's mean.

    Scores are on the training drives.
    """
    drives, rng = training_drives(config.drives), np.random.default_rng(seed)
    start = _lateral_threshold()
    size, P = start.size, config.population
    # weights of recombination, and learning rates with their default values of the paper
    parents = P // 2
    w = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    w /= w.sum()
    mu = 1.0 / np.sum(w**2)
    c_sigma, c_c = (mu + 2.0) / (size + mu + 3.0), 4.0 / (size + 4.0)
    c_cov = 1.0 / mu * 2.0 / (size + 1.4) ** 2 + (1.0 - 1.0 / mu) * (
        min(1.0, (2.0 * mu - 1.0) / ((size + 2.0) ** 2 + mu))
    )
    c_cov = min(1.0, c_cov * (size + 2.0) / 3.0)
    damping = 1.0 + 2.0 * max(0.0, np.sqrt((mu - 1.0) / (size + 1.0)) - 1.0) + c_sigma
    expected = np.sqrt(size) * (1.0 - 1.0 / (4.0 * size) + 1.0 / (21.0 * size**2))
    mean, sigma, variance = start.ravel(), config.spread, np.ones(size)
    p_sigma, p_c = np.zeros(size), np.zeros(size)
    curve: list[tuple[int, float]] = []
    best_mean, best_score = mean, -np.inf
    for generation in range(config.steps):
        steps = np.sqrt(variance) * rng.standard_normal((P, size))
        steps[-1] = 0.0  # the mean itself, whose score is the curve's
        candidates = (mean + sigma * steps).reshape(P, *start.shape)
        rollout = drive_all(LinearPolicies(candidates), drives, copies=P)
        score = rollout.score.reshape(-1, P).mean(axis=0)
        curve.append((generation, float(score[-1])))
        if score[-1] > best_score:
            best_mean, best_score = mean, score[-1]
        progress(f"generation {generation}: {score[-1]:.4f}", generation / config.steps)
        best = np.argsort(-score)[:parents]
        step = w @ steps[best]
        mean = mean + sigma * step
        p_sigma = (1.0 - c_sigma) * p_sigma + np.sqrt(c_sigma * (2.0 - c_sigma) * mu) * (
            step / np.sqrt(variance)
        )
        p_c = (1.0 - c_c) * p_c + np.sqrt(c_c * (2.0 - c_c) * mu) * step
        rank_mu = w @ steps[best] ** 2
        variance = (1.0 - c_cov) * variance + c_cov * (p_c**2 / mu + (1.0 - 1.0 / mu) * rank_mu)
        sigma *= np.exp(c_sigma / damping * (np.linalg.norm(p_sigma) / expected - 1.0))
    about = {"seed": seed, "steps": config.steps}
    return as_network(best_mean.reshape(start.shape), about), tuple(curve)


def _lateral_threshold() -> np.ndarray:
    """Return the weights (2, 4, K + 1) of handling beyond 0.8 m/s² of lateral force, else ride."""
    weights = np.zeros((2, len(STATES), len(NAMES) + 1))
    weights[:, STATES.index("handling"), NAMES.index("lateral_fast")] = 2.0
    weights[:, STATES.index("handling"), -1] = -2.0 * 0.5 * 0.8
    weights[:, [STATES.index("soft_high"), STATES.index("stiff_low")], -1] = -1.0
    return weights


def as_network(weights: np.ndarray, about: dict[str, Any]) -> PolicyNetwork:
    """Return a network of one layer that takes the actions of `weights` (2, 4, K + 1)."""
    front, rear = weights
    # the value of a pair is the sum of its states' values, whose maximum is that of both
    rows = (rear[:, None] + front[None]).reshape(-1, weights.shape[2])
    metadata = {
        "activation": "tanh", "control": "states", "held": 1, "algorithm": "evolution", **about,
    }  # fmt: skip
    return PolicyNetwork(((rows[:, :-1].copy(), rows[:, -1].copy()),), metadata)
