"""Tuning of policies by grid search.

The cost is minus the mean score of the benchmark (mean square comfort, and the price of violations)
over drives of the split "train" and their mirror images. Test drives are never driven here.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import yaml

from road_envs.policies import create
from road_envs.policies.rollout import Drives, drive_all

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
    "mpc": {
        "horizon": (0.5, 0.6, 0.8),
        "lead": (0.3,),
        "margin": (0.02, 0.03, 0.04),
        "advantage": (0.0, 0.1),
    },
    "roll_angle": {"threshold": (0.01, 0.02, 0.03), "hold": (0.1, 0.5)},
    "skyhook": TWO_STATE,
    "groundhook": TWO_STATE,
    "add": TWO_STATE,
    "sh_add": {**TWO_STATE, "crossover": (1.9, 3.0)},
}
"""Grid of settings for every policy that can be tuned."""


class Trial(NamedTuple):
    """Settings and their cost."""

    settings: dict[str, Any]
    cost: float


def tune(
    name: str, drives: Drives, progress: Callable[[str, float], None] = lambda text, x: None
) -> list[Trial]:
    """Evaluate the whole grid of a policy on training drives; the best trial comes first."""
    trials, choices = [], list(itertools.product(*GRIDS[name].values()))
    for k, values in enumerate(choices):
        settings = dict(zip(GRIDS[name], values, strict=True))
        progress(f"{name}: {settings}", k / len(choices))
        score = drive_all(create(name, **settings), drives).score
        trials.append(Trial(settings, -float(score.mean())))
    return sorted(trials, key=lambda trial: trial.cost)


def as_yaml(trials: Sequence[Trial], command: str) -> str:
    """Return the text of a settings file for `configs/policies`."""
    source = f"{command}: cost {trials[0].cost:.4f} m²/s⁴, best of {len(trials)}"
    return yaml.safe_dump(
        {"settings": trials[0].settings, "source": source}, sort_keys=False, allow_unicode=True
    )
