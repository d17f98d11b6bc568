"""Tuning of policies by grid search, and the training settings of learned policies.

The cost is minus the mean score of the benchmark (mean square comfort, and the price of violations)
over drives of the split "train" and their mirror images. Test drives are never driven here.
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
from road_envs.envs.safe4s4 import Safe4S4Setup
from road_envs.policies import PolicySettings, create
from road_envs.policies.rollout import roll_out
from road_envs.policies.safe_rollout import SafeDrives, drive_safely

FIRM = ("handling", "soft_high", "stiff_low")
TWO_STATE: dict[str, tuple[Any, ...]] = {
    "high": ("soft_high", "handling"),
    "leak": (0.2, 1.0),
    "bias": (-2.0, -0.5, 2.0),
}
GRIDS: dict[str, Mapping[str, tuple[Any, ...]]] = {
    "fixed": dict.fromkeys(("front", "rear"), ("ride", *FIRM)),
    "rrms": {"window": (0.25, 0.5, 1.0), "ratio": (0.25, 0.5, 1.0, 2.0), "firm": FIRM},
    "lateral": {"threshold": (0.3, 0.5, 0.8, 1.2), "hold": (0.0, 0.5, 1.0), "firm": FIRM},
    "rrms_lateral": {
        "window": (0.5,),
        "ratio": (0.5, 1.0),
        "threshold": (0.8, 1.2),
        "hold": (0.0, 0.5),
        "firm": FIRM,
    },
    "roll_angle": {"threshold": (0.01, 0.02, 0.03), "hold": (0.1, 0.5)},
    "skyhook": TWO_STATE,
    "groundhook": TWO_STATE,
    "add": TWO_STATE,
    "sh_add": {**TWO_STATE, "crossover": (1.9, 3.0)},
}
"""Grid of settings for every policy that can be tuned."""


TUNING_SEED, TRAINING_DRIVES = 1_000_000, 12
"""First seed of the drives of tuning, and their number; each is driven to both sides."""


class Trial(NamedTuple):
    """Settings and their cost."""

    settings: dict[str, Any]
    cost: float


class SearchResult(NamedTuple):
    """The settings of least cost, that cost, and all trials."""

    settings: dict[str, Any]
    cost: float
    trials: list[Trial]


def training_drives(number: int = TRAINING_DRIVES) -> SafeDrives:
    """Return drives of the split "train", each followed by its mirror image."""
    setup = Safe4S4Setup({"split": "train"})
    return SafeDrives.mirrored(setup, range(TUNING_SEED, TUNING_SEED + number))


def tune(
    name: str,
    drives: SafeDrives,
    progress: Callable[[str, float], None] = lambda text, x: None,
) -> SearchResult:
    """Evaluate the whole grid of a policy on training drives."""
    grid = GRIDS[name]
    trials: list[Trial] = []
    choices = list(itertools.product(*grid.values()))
    for k, values in enumerate(choices):
        settings = dict(zip(grid, values, strict=True))
        progress(f"{name}: {settings}", k / len(choices))
        score = drive_safely(create(name, **settings), drives).score
        trials.append(Trial(settings, -float(score.mean())))
    best = min(trials, key=lambda trial: trial.cost)
    return SearchResult(best.settings, best.cost, trials)


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
    source = f"{command}: cost {best.cost:.4f} m²/s⁴, best of {len(best.trials)}"
    return yaml.safe_dump(
        {"settings": best.settings, "source": source}, sort_keys=False, allow_unicode=True
    )


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
