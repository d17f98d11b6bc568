"""A task as files of tables, and its row from a file of heights: for programs in any language.

    drives            drive, split (training or test), condition
    SPLIT_records     drive, t [s], a column of each sensor [m/s²], v [m/s], s [m] of the front
                      axle, spring_stiff_WHEEL and damper_high_WHEEL (0 or 1)
    SPLIT_profiles    drive, station [m], left and right [m], which are empty for test drives, and
                      for these task, the drives that they are of and what made them

Each is CSV or Parquet. Heights are returned as test_profiles with `left` and `right` filled in, and
if they are known `left_std` and `right_std` [m].
"""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.api import TaskArrays, real_numbers, score_arrays
from leaderboard.scoring import ScoreTable
from road_envs._version import __version__
from road_envs.core.atomic_io import write_text
from road_envs.core.config import ConfigError
from road_envs.core.extras import import_pandas
from road_envs.core.reading import parsing, read_parquet
from road_envs.vehicle.suspension import WHEELS

_SIDES = ("left", "right")
_STATION_TOLERANCE = 1e-6  # largest difference [m] of a station from that of the task, for rounding
_CARD = Path(__file__).parent / "templates" / "task_card.txt"


def write_task(task: TaskArrays, folder: Path, form: str, roads: int | None = None) -> None:
    """Write the drives of a task into `folder` as tables of the `form` csv or parquet.

    `roads` is that of `load_task`, for the card. Raises MissingExtraError without pandas, and
    ConfigError for a task that tables cannot hold.
    """
    pd = import_pandas()
    if any(x["calibration"] or x["vehicle"] != task.vehicle for x in task.test):
        raise ConfigError(
            f"{task.name}: tables hold neither calibration drives nor a vehicle for each "
            "condition; leaderboard.load_task has them"
        )
    tables = defaultdict[str, list[Any]](list)
    for split, drives in (("training", task.training), ("test", task.test)):
        for k, drive in enumerate(drives, start=1):
            about = {"drive": [k], "split": split, "condition": drive["condition"]}
            sensors = dict(zip(drive["channels"], drive["a"], strict=True))
            states = {
                f"{name}_{wheel}": drive[name][:, column].astype(int)
                for name in ("spring_stiff", "damper_high")
                for column, wheel in enumerate(WHEELS)
            }
            signals = {"t": drive["t"], **sensors, "v": drive["v"], "s": drive["s"], **states}
            z = drive.get("z", np.full((2, drive["stations"].size), np.nan))
            heights = {"station": drive["stations"], **dict(zip(_SIDES, z, strict=True))}
            own = {"task": task.identity} if split == "test" else {}
            tables["drives"].append(pd.DataFrame(about))
            tables[f"{split}_records"].append(pd.DataFrame({"drive": k, **signals}))
            tables[f"{split}_profiles"].append(pd.DataFrame({"drive": k, **heights, **own}))
    for name, parts in tables.items():
        path = folder / f"{name}.{form}"
        table = pd.concat(parts, ignore_index=True)
        table.to_parquet(path) if form == "parquet" else table.to_csv(path, index=False)
    card = _CARD.read_text(encoding="utf-8").format(
        name=task.name, training=len(task.training), test=len(task.test), form=form,
        tables=(__doc__ or "").split("\n\n")[1], version=__version__,
        roads="" if roads is None else f" --roads {roads}",
    )  # fmt: skip
    write_text(folder / "README.md", card)
    write_text(folder / "vehicle.json", json.dumps(task.vehicle, indent=1, default=str) + "\n")


def score_file(task: TaskArrays, path: Path) -> ScoreTable:
    """Score the heights of a CSV or Parquet file in the order of test_profiles.

    Raises ConfigError for a missing column, and for a task, drives or stations that are others or
    drives that other code made.
    """
    pd = import_pandas()
    with parsing(path, ConfigError, "damaged, or not a table of numbers"):
        is_parquet = path.suffix == ".parquet"
        table = read_parquet(path).to_pandas() if is_parquet else pd.read_csv(path)
        columns = ["drive", "station", *_SIDES]
        if missing := [name for name in (*columns, "task") if name not in table]:
            raise ConfigError(f"no column {missing[0]!r}; needed are {', '.join(columns)}, task")
        heads = table.columns  # pandas gives the second one of a CSV another name
        if not is_parquet:
            heads = pd.Index(pd.read_csv(path, header=None, nrows=1, dtype=str).iloc[0])
        if twice := heads[heads.duplicated()].tolist():
            raise ConfigError(f"it has two columns {twice[0]!r}")
        if other := set(table["task"].astype(str)) - {task.identity}:
            remedy = "give --task and --roads as for the tables"
            if min(other).startswith(task.identity.rpartition("-")[0]):
                remedy = "another version of this program made those drives, so write them again"
            raise ConfigError(
                f"its heights are of {min(other)[:80]}, not of {task.identity}: {remedy}"
            )
        deviations = [name for name in ("left_std", "right_std") if name in table]
        if len(deviations) == 1:
            raise ConfigError(f"{deviations[0]} is there alone; give left_std and right_std")
        values = {name: real_numbers(table[name]) for name in (*columns, *deviations)}
        if others := [name for name, x in values.items() if len(x) < len(table)]:
            raise ConfigError(f"column {others[0]!r} is not one of numbers")
        if not np.isin(values["drive"], np.arange(1, len(task.test) + 1)).all():
            raise ConfigError(f"a row is of no test drive; those are 1 to {len(task.test)}")
    heights, std = [], []
    for k, drive in enumerate(task.test, start=1):
        rows = values["drive"] == k
        given, right = values["station"][rows], drive["stations"]
        if given.shape != right.shape or not np.abs(given - right).max() <= _STATION_TOLERANCE:
            raise ConfigError(
                f"{path}: test drive {k} needs its {right.size} stations, 0 to {right[-1]:g} m, "
                f"in order and to {_STATION_TOLERANCE:g} m; got {given.size}"
            )
        heights.append(np.stack([values[name][rows] for name in _SIDES]))
        std.append(np.stack([values[name][rows] for name in deviations]) if deviations else None)
    return score_arrays(task, heights, std if deviations else None)
