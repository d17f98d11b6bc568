"""Training study of a learned policy: one configuration trained from several seeds.

Training drives decide which policy is kept. The public drives are driven once, at the end, by the
policy of every seed, so that the spread over seeds is visible: intervals are bootstraps over seeds
and drives, a drive and its mirror image together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from leaderboard.policies import comparison
from leaderboard.policies.best_found import Progress
from leaderboard.policies.comparison import GROUPS, interval, members
from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.policies import PolicySettings, create
from road_envs.policies.evolution import EvolutionConfig, evolve
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork

RIVALS = ("rrms", "rrms_lateral", "lateral")
"""Laws with which every study is compared."""


class TrainingStudy(NamedTuple):
    """Networks and their learning curves on the training drives, by seed."""

    networks: list[PolicyNetwork]
    curves: list[tuple[tuple[int, float], ...]]

    @property
    def best(self) -> PolicyNetwork:
        """The network with the best score on training drives."""
        return self.networks[int(np.argmax([max(v for _, v in curve) for curve in self.curves]))]


def load_training_config(name: str, steps: int | None = None) -> EvolutionConfig:
    """Load the training settings of a learned policy by name or YAML path.

    Raises ConfigError.
    """
    shipped = config.load(PolicySettings, "policies", name)
    if not shipped.training:
        raise ConfigError(f"{name} has no training section; only learned policies can be trained")
    built = config.build(EvolutionConfig, shipped.training, f"{name}: training")
    return built if steps is None else replace(built, steps=steps)


def train_seeds(
    training_config: EvolutionConfig,
    seeds: Sequence[int],
    progress: Progress = lambda text, share: None,
) -> TrainingStudy:
    """Train from each of `seeds`."""
    networks, curves = [], []
    for i, seed in enumerate(seeds):
        network, curve = evolve(
            training_config,
            seed,
            # the defaults bind the loop variables
            lambda text, share, i=i, seed=seed: progress(  # type: ignore[misc]
                f"seed {seed}: {text}", (i + share) / len(seeds)
            ),
        )
        networks.append(network)
        curves.append(curve)
    return TrainingStudy(networks, curves)


def evaluate_study(study: TrainingStudy) -> dict[str, Any]:
    """Return the comparison of all seeds with RIVALS on public drives, as plain data.

    `curves` are the learning curves, `more` the differences of all seeds from each rival by group.
    """
    drives = comparison.public_drives()
    own = {f"seed {n.metadata['seed']}": NetworkPolicy.from_network(n) for n in study.networks}
    laws = {name: create(name) for name in RIVALS}
    found = comparison.compare(own | laws, drives, sweeps=0)
    scores = np.stack([found.rollouts[name].score for name in own])
    everywhere = {"all": np.ones(len(drives), dtype=bool)}
    groups = everywhere | {group: members(drives, group) for group in GROUPS}
    more = {
        name: {
            # the drives of one side come without their mirror images
            group: interval((scores - found.rollouts[name].score)[:, inside], group not in SIDES)
            for group, inside in groups.items()
            if inside.any()
        }
        for name in laws
    }
    return found.data | {"curves": dict(zip(own, study.curves, strict=True)), "more": more}


SIDES = ("left", "right")


def study_lines(evaluation: Mapping[str, Any]) -> list[str]:
    """Return the lines of a terminal report on the result of `evaluate_study`."""
    lines = [
        f"{name}: {step:8d} steps  score {value:.4f} on training drives"
        for name, curve in evaluation["curves"].items()
        for step, value in [curve[0], *curve[:: max(1, len(curve) // 10)][1:], curve[-1]]
    ]
    differences = [
        f"all seeds over {rival}: "
        + ", ".join(
            f"{group} {d['mean']:+.3f} ({d['low']:+.3f} to {d['high']:+.3f})"
            for group, d in more.items()
        )
        for rival, more in evaluation["more"].items()
    ]
    return [*lines, *comparison.table_lines(evaluation), *differences]
