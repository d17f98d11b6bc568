"""Training study of a learned policy: one configuration trained from several seeds.

Training roads decide which network is kept. Held-out roads are driven once, at the end, by the
network of every seed, so that the spread over seeds is visible: intervals are over roads, then
seeds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from leaderboard.policies import grid_search
from leaderboard.policies.comparison import Progress
from leaderboard.policies.scenarios import Scenarios
from leaderboard.policies.summary import REFERENCE, TUNED_POLICIES, case_mean, paired_difference
from road_envs.policies import create
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork


class TrainingStudy(NamedTuple):
    """Networks and their learning curves on the training roads, by seed."""

    networks: list[PolicyNetwork]
    curves: list[tuple[tuple[int, float], ...]]

    @property
    def scores(self) -> list[float]:
        """Best return per second of each training, on training roads."""
        return [max(value for _, value in curve) for curve in self.curves]

    @property
    def best(self) -> PolicyNetwork:
        """The network with the best return on training roads."""
        return self.networks[int(np.argmax(self.scores))]


def train_seeds(
    training_config: Any,
    scenarios: Scenarios,
    seeds: Sequence[int],
    *,
    checkpoint: Path | None = None,
    log: Path | None = None,
    progress: Progress = lambda text, share: None,
) -> TrainingStudy:
    """Train from each of `seeds`; with several, each has a checkpoint of its own.

    Raises ConfigError.
    """
    from road_envs.policies.training import train

    cases = [scenarios.options(case) for case in scenarios.cases]
    trained = []
    for i, seed in enumerate(seeds):
        # the defaults bind the loop variables
        def seed_progress(text: str, share: float, i: int = i, seed: int = seed) -> None:
            progress(f"seed {seed}: {text}", (i + share) / len(seeds))

        seed_checkpoint = checkpoint
        if checkpoint is not None and len(seeds) > 1:
            seed_checkpoint = checkpoint.with_stem(f"{checkpoint.stem}_{seed}")
        trained.append(
            train(
                training_config,
                cases,
                scenarios.training.seeds,
                seed,
                checkpoint=seed_checkpoint,
                log=log,
                progress=seed_progress,
            )
        )
    return TrainingStudy([one.network for one in trained], [one.curve for one in trained])


def evaluate_study(
    study: TrainingStudy, scenarios: Scenarios, weight: float = 0.0
) -> dict[str, Any]:
    """Return the returns per second on held-out roads, with intervals, as plain data.

    Holds all seeds together, each seed, fixed ride and TUNED_POLICIES, and the paired differences
    to these. `weight` is the weight of the unresolved variance in the reward.
    """
    weighted = replace(scenarios, weights=replace(scenarios.weights, unresolved_variance=weight))
    roads = scenarios.test.seeds
    seeds = [network.metadata["seed"] for network in study.networks]
    each = [
        grid_search.return_rates(NetworkPolicy.from_network(n), weighted, roads)
        for n in study.networks
    ]
    mine = np.stack(each, axis=2)
    others = (REFERENCE, *TUNED_POLICIES)
    rivals = {
        name: grid_search.return_rates(create(name), weighted, roads)[:, :, None] for name in others
    }
    return {
        "scenarios": scenarios.name,
        "roads": len(roads),
        "seeds": seeds,
        "training_roads": study.scores,
        "held_out": case_mean(mine)._asdict(),
        "by_seed": [float(case_mean(x[:, :, None]).mean) for x in each],
        "spread": float(np.std([np.mean(x) for x in each], ddof=1)) if len(each) > 1 else 0.0,
        "rivals": {name: case_mean(x)._asdict() for name, x in rivals.items()},
        "more_than": {name: paired_difference(mine, x)._asdict() for name, x in rivals.items()},
    }


def study_lines(name: str, evaluation: Mapping[str, Any]) -> list[str]:
    """Return the lines of a terminal report on the result of `evaluate_study`."""

    def span(x: Mapping[str, float], sign: str = "") -> str:
        return f"{x['mean']:{sign}.4f} ({x['low']:{sign}.4f} to {x['high']:{sign}.4f})"

    seeds = ", ".join(
        f"{seed}: {value:.4f}"
        for seed, value in zip(evaluation["seeds"], evaluation["by_seed"], strict=True)
    )
    return [
        f"return per second on {evaluation['roads']} held-out roads, 95 % over roads and seeds",
        f"{name}: {span(evaluation['held_out'])}, spread over seeds {evaluation['spread']:.4f}",
        f"by seed: {seeds}",
        *(
            f"{rival}: {span(value)}; {name} gets {span(evaluation['more_than'][rival], '+')} more"
            for rival, value in evaluation["rivals"].items()
        ),
    ]
