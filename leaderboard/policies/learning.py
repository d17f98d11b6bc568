"""Training study of a learned policy: one configuration trained from several seeds.

Training drives decide which policy is kept. The public drives are driven once, at the end, by the
policy of every seed, so that the spread over seeds is visible: intervals are bootstraps over seeds
and drives, a drive and its mirror image together.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from leaderboard.policies.comparison import BOOTSTRAPS, GROUPS, members, public_drives
from road_envs.core import config
from road_envs.core.atomic_io import atomic_write
from road_envs.core.config import ConfigError
from road_envs.policies import PolicySettings, create
from road_envs.policies.evolution import EvolutionConfig, evolve
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork
from road_envs.policies.rollout import drive_all

RIVALS = ("rrms", "rrms_lateral", "lateral")
"""Laws with which every study is compared."""

Progress = Callable[[str, float], None]


class TrainingStudy(NamedTuple):
    """Networks and their learning curves on the training drives, by seed."""

    networks: list[PolicyNetwork]
    curves: list[tuple[tuple[int, float], ...]]

    @property
    def best(self) -> PolicyNetwork:
        """The network with the best score on training drives."""
        return self.networks[int(np.argmax([max(v for _, v in curve) for curve in self.curves]))]


def load_training_config(name: str, steps: int | None = None) -> Any:
    """Load the training settings of a learned policy by name or YAML path.

    Raises ConfigError.
    """
    shipped = config.load(PolicySettings, "policies", name)
    if not shipped.training:
        raise ConfigError(f"{name} has no training section; only learned policies can be trained")
    training = dict(shipped.training)
    cls: Any = EvolutionConfig
    if training.pop("algorithm", None) != "evolution":
        from road_envs.policies.training import TrainingConfig

        cls, training = TrainingConfig, shipped.training
    built = config.build(cls, training, f"{name}: training")
    return built if steps is None else replace(built, steps=steps)


def train_seeds(
    training_config: Any,
    seeds: Sequence[int],
    *,
    checkpoint: Path | None = None,
    log: Path | None = None,
    progress: Progress = lambda text, share: None,
) -> TrainingStudy:
    """Train from each of `seeds`; with several, each has a checkpoint of its own.

    Raises ConfigError.
    """
    networks, curves = [], []
    for i, seed in enumerate(seeds):
        # the defaults bind the loop variables
        def seed_progress(text: str, share: float, i: int = i, seed: int = seed) -> None:
            progress(f"seed {seed}: {text}", (i + share) / len(seeds))

        if isinstance(training_config, EvolutionConfig):
            network, curve = evolve(training_config, seed, seed_progress)
        else:
            from road_envs.policies.training import train

            own = checkpoint
            if checkpoint is not None and len(seeds) > 1:
                own = checkpoint.with_stem(f"{checkpoint.stem}_{seed}")
            network, curve = train(
                training_config, seed, checkpoint=own, log=log, progress=seed_progress
            )
        networks.append(network)
        curves.append(curve)
    return TrainingStudy(networks, curves)


def evaluate_study(study: TrainingStudy) -> dict[str, Any]:
    """Return the scores on public drives as plain data: each seed, and all against RIVALS."""
    drives = public_drives()
    own = [drive_all(NetworkPolicy.from_network(network), drives) for network in study.networks]
    rivals = {name: drive_all(create(name), drives) for name in RIVALS}
    scores = np.stack([rollout.score for rollout in own])
    groups = {"all": np.ones(len(drives), dtype=bool)} | {g: members(drives, g) for g in GROUPS}
    return {
        "seeds": [network.metadata["seed"] for network in study.networks],
        "curves": [list(map(list, curve)) for curve in study.curves],
        "by_seed": [float(score.mean()) for score in scores],
        "violations": float(np.mean([rollout.violated for rollout in own])),
        "rivals": {
            name: {
                "score": float(rival.score.mean()),
                "violations": float(rival.violated.mean()),
                "more": {
                    group: difference((scores - rival.score)[:, inside])
                    for group, inside in groups.items()
                    if inside.any()
                },
            }
            for name, rival in rivals.items()
        },
    }


def difference(more: np.ndarray) -> dict[str, float]:
    """Return the mean of `more` (S, N) and its 95 % interval over S seeds and pairs of N drives."""
    pairs = more.reshape(len(more), -1, 2).mean(axis=2) if more.shape[1] % 2 == 0 else more
    rng = np.random.default_rng(0)
    seeds = rng.integers(0, len(pairs), (BOOTSTRAPS, len(pairs)))
    drives = rng.integers(0, pairs.shape[1], (BOOTSTRAPS, pairs.shape[1]))
    means = pairs[seeds[:, :, None], drives[:, None, :]].mean(axis=(1, 2))
    low, high = np.quantile(means, [0.025, 0.975])
    return {"mean": float(pairs.mean()), "low": float(low), "high": float(high)}


def study_lines(name: str, evaluation: Mapping[str, Any]) -> list[str]:
    """Return the lines of a terminal report on the result of `evaluate_study`."""
    lines = [
        f"seed {seed}: {step:8d} steps  score {value:.4f} on training drives"
        for seed, curve in zip(evaluation["seeds"], evaluation["curves"], strict=True)
        for step, value in [curve[0], *curve[:: max(1, len(curve) // 10)][1:], curve[-1]]
    ]
    scores = ", ".join(f"{score:.4f}" for score in evaluation["by_seed"])
    lines.append(
        f"{name} on public drives, by seed: {scores}; {evaluation['violations']:.0%} in violation"
    )
    for rival, x in evaluation["rivals"].items():
        parts = ", ".join(
            f"{group} {d['mean']:+.3f} ({d['low']:+.3f} to {d['high']:+.3f})"
            for group, d in x["more"].items()
        )
        lines.append(
            f"{rival}: {x['score']:.4f}, {x['violations']:.0%} in violation; {name} gets more: "
            f"{parts}"
        )
    return lines


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        partial.write_bytes(data)
