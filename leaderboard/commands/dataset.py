"""Command `dataset`: simulated drives with their true roads, for training without the simulator,
and episodes of a switching policy as a Minari data set, for offline reinforcement learning.
"""

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import numpy as np

from leaderboard.api import load_task
from leaderboard.commands import command_line, progress_bar
from leaderboard.commands.options import Sensors, option
from leaderboard.commands.output import Output, facts_table
from leaderboard.task_tables import write_task
from road_envs import __version__
from road_envs.core.atomic_io import new_folder
from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import
from road_envs.drives.dataset import write_dataset
from road_envs.drives.training_corpus import Corpus
from road_envs.policies import make_policy
from road_envs.policies.rollout import roll_out

_DRIVES, _SEED, _SENSORS = 200, 2, "paper"  # defaults of the drives that are not those of a task

_ENVIRONMENT = "RoadRecon-v0"
_NAMESPACE = "roadrecon"

_OPTIONS = {"observe": ("accelerations", "planar", "struts"), "control": "states"}
"""Options of the environment: all that a policy may use, and all states of both axles."""

_BATCH = 16  # episodes that are driven at once

_DATASETS_PATH = "MINARI_DATASETS_PATH"  # environment variable of Minari's folder of data sets


def dataset(
    *,
    out: Annotated[Path, option("Folder of the data set; it must not exist.")],
    drives: Annotated[int, option("Number of drives.", min=10)] = _DRIVES,
    seed: Annotated[int, option("Seed of the drives.", min=0)] = _SEED,
    sensors: Sensors = _SENSORS,
    episodes: Annotated[
        str | None, option("Write episodes of this switching policy instead, for Minari.")
    ] = None,
    task: Annotated[
        str | None, option("Write the drives of this task instead, to be scored by `score`.")
    ] = None,
    roads: Annotated[int | None, option("With --task: test drives per condition.", min=1)] = None,
    csv: Annotated[bool, option("With --task: CSV, not Parquet.", "--csv")] = False,
) -> Output:
    """Write simulated drives with true roads as Parquet: splits, card, licence, checksums.

    The same options and version give the same drives. Seed 1 is that of the shipped weights'
    training. With --episodes, a data set of Minari has as many episodes of a policy in
    RoadRecon-v0. With --task, the drives of a task, whose test drives have no true road.
    """
    if task is not None and episodes is not None:
        raise ConfigError("give either --task or --episodes, not both")
    if task is None and (csv or roads is not None):
        raise ConfigError("--csv and --roads are of a task: give --task")
    if task is not None and (drives, seed, sensors) != (_DRIVES, _SEED, _SENSORS):
        raise ConfigError("--drives, --seed and --sensors are those of the task: leave them out")
    if not out.parent.is_dir():
        raise ConfigError(f"{out}: the folder {out.parent} does not exist")
    facts: dict[str, Any]
    with new_folder(out) as folder, progress_bar() as progress:
        if episodes is not None:
            facts = _write_episodes(episodes, drives, seed, folder, progress, sensors=sensors)
        elif task is not None:
            arrays = load_task(task, roads=roads)
            facts = {"training": len(arrays.training), "test": len(arrays.test)}
            write_task(arrays, folder, "csv" if csv else "parquet", roads)
        else:
            corpus = Corpus(number=drives, seed=seed, instruments=sensors)
            facts = write_dataset(corpus, folder, command=command_line(), progress=progress)
    facts["written"] = [str(out)]
    if episodes is None:
        return Output(facts=facts)
    load = f"to load it: {_DATASETS_PATH}={out} and minari.load_dataset({facts['data_set']!r})"
    return Output(facts=facts, shows=[*facts_table(facts), load])


def _write_episodes(
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
    identifier = f"{_NAMESPACE}/{name}-v0"
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
    """Let Minari write into `folder`."""
    before = os.environ.get(_DATASETS_PATH)
    os.environ[_DATASETS_PATH] = str(folder.resolve())
    try:
        yield
    finally:
        os.environ.pop(_DATASETS_PATH)
        if before is not None:
            os.environ[_DATASETS_PATH] = before
