"""Training study of the learned policy: one configuration trained from several seeds.

Training drives decide which policy is kept. The public drives are driven once, at the end, by the
policy of every seed, so that the spread over seeds is visible: intervals are bootstraps over seeds
and drives, a drive and its mirror image together.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from leaderboard.policies import comparison
from leaderboard.policies.best_found import Progress
from leaderboard.policies.comparison import GROUPS, interval, members
from road_envs.policies import create
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork
from road_envs.policies.policy_iteration import IterationConfig, iterate

RIVALS = ("rrms", "rrms_lateral", "lateral", "mpc")
"""Laws with which every study is compared."""

SIDES = ("left", "right")
"""Groups whose drives come without their mirror images."""


class TrainingStudy(NamedTuple):
    """Networks and their learning curves on the development drives, by seed."""

    networks: list[PolicyNetwork]
    curves: list[tuple[tuple[int, float], ...]]

    @property
    def best(self) -> PolicyNetwork:
        """The network with the best score on development drives."""
        return self.networks[int(np.argmax([max(v for _, v in curve) for curve in self.curves]))]


def train_seeds(
    config: IterationConfig,
    seeds: Sequence[int],
    progress: Progress = lambda text, share: None,
) -> TrainingStudy:
    """Train from each of `seeds`."""
    found = []
    for i, seed in enumerate(seeds):

        def report(text: str, share: float, i: int = i, seed: int = seed) -> None:
            progress(f"seed {seed}: {text}", (i + share) / len(seeds))

        found.append(iterate(config, seed, report))
    return TrainingStudy([network for network, _ in found], [curve for _, curve in found])


def evaluate_study(study: TrainingStudy) -> dict[str, Any]:
    """Return the comparison of all seeds with RIVALS on public drives, as plain data.

    `curves` are the learning curves, `more` the differences of all seeds from each rival by group.
    """
    drives = comparison.public_drives()
    own = {f"seed {n.metadata['seed']}": NetworkPolicy.from_network(n) for n in study.networks}
    found = comparison.compare(own | {name: create(name) for name in RIVALS}, drives, sweeps=0)
    scores = np.stack([found.rollouts[name].score for name in own])
    groups = {"all": np.ones(len(drives), dtype=bool)}
    groups |= {group: members(drives, group) for group in GROUPS}
    more = {
        name: {
            group: interval((scores - found.rollouts[name].score)[:, inside], group not in SIDES)
            for group, inside in groups.items()
            if inside.any()
        }
        for name in RIVALS
    }
    return found.data | {"curves": dict(zip(own, study.curves, strict=True)), "more": more}


def study_lines(evaluation: Mapping[str, Any]) -> list[str]:
    """Return the lines of a terminal report on the result of `evaluate_study`."""
    curves = [
        f"{name}, score by round: " + " ".join(f"{score:.3f}" for _, score in curve)
        for name, curve in evaluation["curves"].items()
    ]
    differences = [
        f"all seeds over {rival}: "
        + ", ".join(
            f"{group} {d['mean']:+.3f} ({d['low']:+.3f} to {d['high']:+.3f})"
            for group, d in more.items()
        )
        for rival, more in evaluation["more"].items()
    ]
    return [*curves, "", *comparison.table_lines(evaluation), "", *differences]
