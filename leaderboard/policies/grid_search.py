"""Tuning of policies by grid search, and the training settings of learned policies.

The cost is minus the return per second, averaged over all cases and training roads of the
scenarios. Test roads are never driven here.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from leaderboard.policies.scenarios import Scenarios
from road_envs.core import config
from road_envs.core.atomic_io import atomic_write
from road_envs.core.config import ConfigError
from road_envs.policies import PolicySettings, create
from road_envs.policies.rollout import roll_out

TWO_STATE: dict[str, tuple[Any, ...]] = {
    "high": ("soft_high", "handling"),
    "leak": (0.2, 1.0),
    "bias": (-2.0, -0.5),
}
GRIDS: dict[str, Mapping[str, tuple[Any, ...]]] = {
    "rrms": {"window": (0.5, 1.0, 2.0), "ratio": (1.0, 2.0, 3.0)},
    "preview": {
        "window": (0.5, 1.0),
        "ratio": (1.0, 2.0),
        "bump": (0.02, 0.04, 0.08),
        "reach": (1.0, 2.0),
    },
    "roll_angle": {"threshold": (0.03, 0.05, 0.07, 0.1), "hold": (0.1, 0.5)},
    "skyhook": TWO_STATE,
    "groundhook": TWO_STATE,
    "add": TWO_STATE,
    "sh_add": {**TWO_STATE, "crossover": (1.9, 3.0)},
}
"""Grid of settings for every policy that can be tuned."""


class Trial(NamedTuple):
    """Settings and their cost per second."""

    settings: dict[str, Any]
    cost: float


class SearchResult(NamedTuple):
    """The settings of least cost, that cost per second, and all trials."""

    settings: dict[str, Any]
    cost: float
    trials: list[Trial]


def tune(
    name: str, scenarios: Scenarios, progress: Callable[[str, float], None] = lambda text, x: None
) -> SearchResult:
    """Evaluate the whole grid of a policy on the training roads."""
    grid = GRIDS[name]
    trials: list[Trial] = []
    choices = list(itertools.product(*grid.values()))
    for k, values in enumerate(choices):
        settings = dict(zip(grid, values, strict=True))
        progress(f"{name}: {settings}", k / len(choices))
        trials.append(Trial(settings, cost(create(name, **settings), scenarios)))
    best = min(trials, key=lambda trial: trial.cost)
    return SearchResult(best.settings, best.cost, trials)


def cost(policy: Any, scenarios: Scenarios) -> float:
    """Return minus the mean return per second over all cases and training roads."""
    return -float(np.mean(return_rates(policy, scenarios, scenarios.training.seeds)))


def return_rates(policy: Any, scenarios: Scenarios, seeds: Sequence[int]) -> np.ndarray:
    """Return the returns per second (R, C) on the roads of `seeds` (R,), for every case (C)."""
    rollouts = [
        roll_out(policy, scenarios.options(case), seeds, store_observations=False)
        for case in scenarios.cases
    ]
    # an interval lasts 1 / control_rate seconds
    return np.stack([d.returns * scenarios.control_rate / d.intervals for d in rollouts], axis=1)


def as_yaml(best: SearchResult, command: str) -> str:
    """Return the text of a settings file for `configs/policies`."""
    source = f"{command}: cost {best.cost:.4f} per second, best of {len(best.trials)}"
    return yaml.safe_dump({"settings": best.settings, "source": source}, sort_keys=False)


def load_training_config(name: str, steps: int | None = None) -> Any:
    """Load the training settings of a learned policy by name or YAML path.

    Raises ConfigError.
    """
    from road_envs.policies.training import TrainingConfig

    shipped = config.load(PolicySettings, "policies", name)
    if not shipped.training:
        raise ConfigError(f"{name} has no training section; only learned policies can be trained")
    training = config.build(TrainingConfig, shipped.training, f"{name}: training")
    return training if steps is None else replace(training, steps=steps)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        partial.write_bytes(data)
