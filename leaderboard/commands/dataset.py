"""Command `dataset`: simulated drives with their true roads, for training without the simulator."""

from pathlib import Path
from typing import Annotated, Any

from leaderboard.api import load_task
from leaderboard.commands import command_line, progress_bar
from leaderboard.commands.options import Sensors, option
from leaderboard.commands.output import Output, facts_table
from leaderboard.episode_tables import DATASETS_PATH, write_episodes
from leaderboard.task_tables import write_task
from road_envs.core.atomic_io import new_folder
from road_envs.core.config import ConfigError
from road_envs.drives.dataset import write_dataset
from road_envs.drives.training_corpus import Corpus

_DRIVES, _SEED, _SENSORS = 200, 2, "paper"  # defaults of the drives that are not those of a task


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
            facts = write_episodes(episodes, drives, seed, folder, progress, sensors=sensors)
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
    load = f"to load it: {DATASETS_PATH}={out} and minari.load_dataset({facts['data_set']!r})"
    return Output(facts=facts, shows=[*facts_table(facts), load])
