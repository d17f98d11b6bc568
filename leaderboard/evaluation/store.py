"""Storage of results as JSON files: atomic writes, strict reading, content-addressed parts.

    <out>/results/<task>/<estimator>.json   a row of the board
    <out>/jobs/<identity>.json              a part of a row: the result under one condition

The file name of a part is the digest of all its inputs, so parts are written but never modified,
and two runs in one folder write the same files. Each file begins with a checksum of the rest.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from leaderboard.evaluation.results import RESULT, Result, make_table, to_plain, unscored_result
from leaderboard.evaluation.tasks import Task
from road_envs.core.artifacts import HEADER
from road_envs.core.atomic_io import write_text
from road_envs.core.config import ConfigError, Settings, build


@dataclass(frozen=True)
class _ScoreColumns(Settings):
    """The table of the scores of a result by columns."""

    condition: tuple[str, ...]
    drive: tuple[int, ...]
    road: tuple[str, ...]
    road_seed: tuple[int, ...]
    seed: tuple[int, ...]
    score: tuple[str, ...]
    value: tuple[float, ...]


def row_path(out: Path, task: str, estimator: str) -> Path:
    """Return the file of the result of an estimator on a task."""
    return out / "results" / task / f"{estimator}.json"


def part_path(out: Path, identity: str) -> Path:
    """Return the file of a part of a result."""
    return out / "jobs" / f"{identity}.json"


def save(result: Result, out: Path) -> Path:
    """Write a result atomically to its row file and return the path."""
    path = row_path(out, result.task, result.estimator)
    write_text(path, to_text(result), durable=True)
    return path


def save_part(text: str, out: Path, identity: str) -> None:
    """Write the text of a part atomically."""
    write_text(part_path(out, identity), text, durable=True)


def to_text(result: Result) -> str:
    """Text of a result as an artifact."""
    content = {name: x for name, x in to_plain(result).items() if name not in HEADER}
    return RESULT.to_text(content, result.identity)


def load(path: Path) -> Result:
    """Read a row from its file. Raises ConfigError that names file and fault."""
    result = read(path)
    row = f"the result of {result.estimator} on {result.task}"
    _check_name(path, (result.task, result.estimator) == (path.parent.name, path.stem), row)
    return result


def load_part(path: Path) -> Result:
    """Read a part from its file. Raises ConfigError that names file and fault."""
    result = read(path)
    _check_name(path, result.identity == path.stem, f"the part {result.identity}")
    return result


def _check_name(path: Path, named: bool, what: str) -> None:
    if not named:
        raise ConfigError(f"{path}: contains {what}, which its path does not name; evaluate again")


def load_rows(out: Path, task: Task) -> list[Result]:
    """Return all rows of a task; an unreadable file becomes a row with a failure."""
    rows = []
    for path in sorted((out / "results" / task.name).glob("[!.]*.json")):
        try:
            rows.append(load(path))
        except ConfigError as error:
            failure = f"its result cannot be read: {error}"
            rows.append(unscored_result(task, path.stem, settings={}, seeds=(), failure=failure))
    return rows


def read(path: Path) -> Result:
    """Read a row or a part, whatever its name. Raises ConfigError."""
    data, _ = RESULT.read(path)
    scores = data.pop("scores", None)
    result = build(Result, data, str(path))
    if scores is None:
        if result.failure is None:
            raise ConfigError(f"{path}: neither scores nor a failure; evaluate again")
        return result
    columns = vars(build(_ScoreColumns, scores, f"{path}: scores"))
    if len({len(column) for column in columns.values()}) > 1:
        raise ConfigError(f"{path}: scores: columns have different lengths; evaluate again")
    if not np.isfinite(columns["value"]).all():  # it would count as a drive that was not driven
        raise ConfigError(f"{path}: scores: a value is not finite; evaluate again")
    return dataclasses.replace(result, scores=make_table(columns))
