"""How policies get their settings: a full grid on training roads, and recipes for learned ones.

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
from road_envs import config
from road_envs._atomic_io import whole
from road_envs.config import ConfigError
from road_envs.policies import Tuned, create
from road_envs.policies.rollout import drive

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
"""What is tried of every policy that has something to tune."""


class Tried(NamedTuple):
    """Settings and their cost per second."""

    settings: dict[str, Any]
    cost: float


class Best(NamedTuple):
    """The settings of least cost, the cost before, and all that was tried."""

    settings: dict[str, Any]
    cost: float
    tried: list[Tried]


def tune(
    name: str, scenarios: Scenarios, progress: Callable[[str, float], None] = lambda text, x: None
) -> Best:
    """Try all of a policy's grid."""
    grid = GRIDS[name]
    tried: list[Tried] = []
    choices = list(itertools.product(*grid.values()))
    for k, values in enumerate(choices):
        settings = dict(zip(grid, values, strict=True))
        progress(f"{name}: {settings}", k / len(choices))
        tried.append(Tried(settings, cost(create(name, **settings), scenarios)))
    best = min(tried, key=lambda one: one.cost)
    return Best(best.settings, best.cost, tried)


def cost(policy: Any, scenarios: Scenarios) -> float:
    """Minus the mean return per second over all cases and training roads."""
    return -float(np.mean(rates(policy, scenarios, scenarios.training.all)))


def rates(policy: Any, scenarios: Scenarios, seeds: Sequence[int]) -> np.ndarray:
    """Returns per second (R, C) on the roads of `seeds`, in every case."""
    driven = [drive(policy, scenarios.options(case), seeds, keep=False) for case in scenarios.cases]
    return np.stack([d.returns * scenarios.control_rate / d.intervals for d in driven], axis=1)


def as_yaml(best: Best, command: str) -> str:
    """The file for `configs/policies`."""
    source = f"{command}: cost {best.cost:.4f} per second, best of {len(best.tried)}"
    return yaml.safe_dump({"settings": best.settings, "source": source}, sort_keys=False)


def recipe(name: str, steps: int | None = None) -> Any:
    """How a learned policy is trained, by name or YAML path. Raises ConfigError."""
    from road_envs.policies.training import Recipe

    shipped = config.load(Tuned, "policies", name)
    if not shipped.recipe:
        raise ConfigError(f"{name} is not learned: its settings have no recipe")
    found = config.build(Recipe, shipped.recipe, f"{name}: recipe")
    return found if steps is None else replace(found, steps=steps)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as partial:
        partial.write_bytes(data)
