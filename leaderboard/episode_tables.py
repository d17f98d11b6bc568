"""Episodes of a switching policy as a Minari data set, for offline reinforcement learning."""

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from road_envs import __version__
from road_envs.core.extras import optional_import
from road_envs.policies import make_policy
from road_envs.policies.rollout import roll_out

_ENVIRONMENT = "RoadRecon-v0"
_OPTIONS = {"observe": ("accelerations", "planar", "struts"), "control": "states"}
"""Options of the environment: all that a policy may use, and all states of both axles."""

_BATCH = 16  # episodes that are driven at once
DATASETS_PATH = "MINARI_DATASETS_PATH"  # environment variable of Minari's folder of data sets


def write_episodes(
    reference: str,
    number: int,
    seed: int,
    folder: Path,
    progress: Callable[[str, float], None],
    **options: Any,
) -> dict[str, Any]:
    """Write `number` episodes of a policy, one of each seed from `seed` on; return the facts.

    The data set lies in `folder`, Minari's folder of data sets, under the name in the facts;
    `options` are those of the environment. Raises ConfigError, and what the policy raises.
    """
    options = {**_OPTIONS, **options}
    policy, name = make_policy(reference), reference.rpartition(":")[2].lower()
    with optional_import("a data set of episodes"):
        import minari
        from minari.data_collector import EpisodeBuffer

    buffers, returns = [], []
    for first in range(0, number, _BATCH):
        seeds = range(seed + first, seed + min(first + _BATCH, number))
        progress(f"driving seeds {seeds[0]} to {seeds[-1]}", first / number)
        rollout = roll_out(policy, options, seeds)
        for k, n in enumerate(rollout.intervals):
            ended = np.arange(1, n + 1) == n
            failed = bool(rollout.reasons[k])
            episode = EpisodeBuffer(
                id=first + k, seed=seeds[k], observations=list(rollout.observations[: n + 1, k]),
                actions=list(rollout.actions[:n, k]), rewards=list(rollout.rewards[:n, k]),
                terminations=list(ended & failed), truncations=list(ended & (not failed)),
            )  # fmt: skip
            buffers.append(episode)
            returns.append(float(rollout.returns[k]))
    identifier = f"roadrecon/{name}-v0"
    env = gymnasium.make(_ENVIRONMENT, **options)
    with _datasets_in(folder), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of an address and links that are left out
        minari.create_dataset_from_buffers(
            identifier, buffers, env=env, algorithm_name=name, author="RoadRecon",
            description=f"Episodes of the policy {name} in {_ENVIRONMENT}, seeds {seed} to "
            f"{seed + number - 1}, road-envs {__version__}; licence CC-BY-4.0.",
            data_format="arrow", requirements=[f"road-envs=={__version__}"],
        )  # fmt: skip
    steps = int(sum(len(buffer.rewards) for buffer in buffers))
    facts = {"data_set": identifier, "episodes": number, "steps": steps}
    return {**facts, "mean_return": float(np.mean(returns))}


@contextmanager
def _datasets_in(folder: Path) -> Iterator[None]:
    before = os.environ.get(DATASETS_PATH)
    os.environ[DATASETS_PATH] = str(folder.resolve())
    try:
        yield
    finally:
        os.environ.pop(DATASETS_PATH)
        if before is not None:
            os.environ[DATASETS_PATH] = before
