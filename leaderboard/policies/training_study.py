"""Learned policies: one recipe trained from several seeds, and what the seeds make of it.

Training roads decide which network is kept. Held-out roads are driven once, at the end, by the
network of every seed, so that luck of a seed is seen: intervals are over roads, then seeds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from leaderboard.policies import grid_search
from leaderboard.policies.comparison import Progress
from leaderboard.policies.scenarios import Scenarios
from leaderboard.policies.summary import REFERENCE, RIVALS, averaged, difference
from road_envs.policies import create
from road_envs.policies.network_policy import Learned, Network


class Learning(NamedTuple):
    """Networks, and the curves of their trainings on training roads, seed by seed."""

    networks: list[Network]
    curves: list[tuple[tuple[int, float], ...]]

    @property
    def scores(self) -> list[float]:
        """The best return per second of each training, on training roads."""
        return [max(value for _, value in curve) for curve in self.curves]

    @property
    def best(self) -> Network:
        """The network that did best on training roads."""
        return self.networks[int(np.argmax(self.scores))]


def learn(
    recipe: Any,
    scenarios: Scenarios,
    seeds: Sequence[int],
    *,
    checkpoint: Path | None = None,
    log: Path | None = None,
    progress: Progress = lambda text, share: None,
) -> Learning:
    """Train from each of `seeds`; with several, each has a checkpoint of its own. Raises
    ConfigError.
    """
    from road_envs.policies.training import train

    cases = [scenarios.options(case) for case in scenarios.cases]
    found = []
    for i, seed in enumerate(seeds):

        def told(text: str, share: float, i: int = i, seed: int = seed) -> None:
            progress(f"seed {seed}: {text}", (i + share) / len(seeds))

        kept = checkpoint
        if checkpoint is not None and len(seeds) > 1:
            kept = checkpoint.with_stem(f"{checkpoint.stem}_{seed}")
        found.append(
            train(
                recipe,
                cases,
                scenarios.training.all,
                seed,
                checkpoint=kept,
                log=log,
                progress=told,
            )
        )
    return Learning([one.network for one in found], [one.curve for one in found])


def judged(learning: Learning, scenarios: Scenarios, weight: float = 0.0) -> dict[str, Any]:
    """Return per second on held-out roads, each with its interval: of all seeds together, of each,
    of fixed ride and RIVALS, and how much more all seeds get than these; `weight` of information.
    """
    priced = replace(scenarios, weights=replace(scenarios.weights, information=weight))
    roads = scenarios.test.all
    seeds = [network.about["seed"] for network in learning.networks]
    each = [grid_search.rates(Learned.of(n), priced, roads) for n in learning.networks]
    mine = np.stack(each, axis=2)
    others = (REFERENCE, *RIVALS)
    rivals = {name: grid_search.rates(create(name), priced, roads)[:, :, None] for name in others}
    return {
        "scenarios": scenarios.name,
        "roads": len(roads),
        "seeds": seeds,
        "training_roads": learning.scores,
        "held_out": averaged(mine)._asdict(),
        "by_seed": [float(averaged(x[:, :, None]).mean) for x in each],
        "spread": float(np.std([np.mean(x) for x in each], ddof=1)) if len(each) > 1 else 0.0,
        "rivals": {name: averaged(x)._asdict() for name, x in rivals.items()},
        "more_than": {name: difference(mine, x)._asdict() for name, x in rivals.items()},
    }


def lines(name: str, told: Mapping[str, Any]) -> list[str]:
    """What `judged` found, for a terminal."""

    def span(x: Mapping[str, float], sign: str = "") -> str:
        return f"{x['mean']:{sign}.4f} ({x['low']:{sign}.4f} to {x['high']:{sign}.4f})"

    seeds = ", ".join(
        f"{seed}: {value:.4f}" for seed, value in zip(told["seeds"], told["by_seed"], strict=True)
    )
    return [
        f"return per second on {told['roads']} held-out roads, 95 % over roads and seeds",
        f"{name}: {span(told['held_out'])}, spread over seeds {told['spread']:.4f}",
        f"by seed: {seeds}",
        *(
            f"{rival}: {span(value)}; {name} gets {span(told['more_than'][rival], '+')} more"
            for rival, value in told["rivals"].items()
        ),
    ]
