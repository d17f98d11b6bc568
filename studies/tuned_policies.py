"""Tuning of the shipped policies by grid search, on training drives only.

    python -m studies.tuned_policies rrms_lateral [--drives 12] [--out mine.yaml]

The cost is minus the mean score of the benchmark (mean square comfort, and the price of violations)
over drives of the split "train" and their mirror images.
"""

import argparse
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from road_envs.core.atomic_io import write_text
from road_envs.envs.safe4s4 import Safe4S4Setup
from road_envs.policies import create
from road_envs.policies.rollout import Drives, drive_all

TUNING_SEED, TRAINING_DRIVES = 1_000_000, 12
"""First seed of the drives of tuning, and their number; each is driven to both sides."""

FIRM = ("handling", "soft_high", "stiff_low")
TWO_STATE: dict[str, tuple[Any, ...]] = {
    "high": ("soft_high", "handling"),
    "leak": (0.2, 1.0),
    "bias": (-2.0, 2.0, 8.0),
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


def training_drives(number: int = TRAINING_DRIVES) -> Drives:
    """Return drives of the split "train", each followed by its mirror image."""
    setup = Safe4S4Setup({"split": "train"})
    return Drives.mirrored(setup, range(TUNING_SEED, TUNING_SEED + number))


def tune(name: str, drives: Drives) -> list[Trial]:
    """Evaluate the whole grid of a policy on training drives; the best trial comes first."""
    trials = []
    for values in itertools.product(*GRIDS[name].values()):
        settings = dict(zip(GRIDS[name], values, strict=True))
        score = drive_all(create(name, **settings), drives).score
        trials.append(Trial(settings, -float(score.mean())))
    return sorted(trials, key=lambda trial: trial.cost)


def main() -> None:
    """Tune a policy, print all trials and write a settings file for `configs/policies`."""
    parser = argparse.ArgumentParser(description="Tune a policy on training drives.")
    parser.add_argument("name", choices=GRIDS)
    parser.add_argument("--drives", type=int, default=TRAINING_DRIVES, help="each to both sides")
    parser.add_argument("--out", type=Path, help="YAML file for the settings")
    arguments = parser.parse_args()
    trials = tune(arguments.name, training_drives(arguments.drives))
    for trial in trials:
        print(f"{trial.cost:.4f}  {trial.settings}")
    if arguments.out:
        command = f"python -m studies.tuned_policies {arguments.name} --drives {arguments.drives}"
        source = f"{command}: cost {trials[0].cost:.4f} m²/s⁴, best of {len(trials)}"
        settings = {"settings": trials[0].settings, "source": source}
        text = yaml.safe_dump(settings, sort_keys=False, allow_unicode=True)
        write_text(arguments.out, text)


if __name__ == "__main__":
    main()
