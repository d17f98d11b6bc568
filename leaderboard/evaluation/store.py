"""Storage of results as JSON files: atomic writes, strict reading, content-addressed parts.

    <out>/results/<task>/<estimator>.json   a row of the board
    <out>/jobs/<identity>.json              a part of a row: the result under one condition

The file name of a part is the digest of all its inputs, so parts are written but never modified,
and two runs in one folder write the same files. A row is assembled from its parts and can be
assembled again. Each file begins with a checksum of the rest.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, overload

from leaderboard.evaluation.provenance import package_version
from leaderboard.evaluation.results import RESULT, DriveScores, Result, evaluation_version
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics import heights
from leaderboard.metrics.baselines import ALL_BASELINES
from road_envs.core.artifacts import HEADER
from road_envs.core.atomic_io import write_text
from road_envs.core.config import ConfigError, Settings, build

ROW_REPLACED = "another run has replaced it by a different result; read the board again"

CACHED_ROWS = 8
"""Number of results whose drives and traces are cached in memory."""


class RowChangedError(ConfigError):
    """A row that another run has replaced by a different one since it was read."""


@dataclass(frozen=True)
class _DriveColumns(Settings):
    """All scores of a result by columns, one value per drive."""

    condition: tuple[str, ...]
    drive: tuple[int, ...]
    road: tuple[str, ...]
    road_seed: tuple[int, ...]
    seed: tuple[int, ...]
    scores: dict[str, tuple[float | None, ...]]
    """None where a score is undefined."""


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
    large: dict[str, Any] = {
        "drives": _columns(result.drives),
        "traces": [vars(trace) for trace in result.traces],
    }
    names = [f.name for f in dataclasses.fields(result) if f.name not in HEADER]
    content = {name: large.get(name, getattr(result, name)) for name in names}
    return RESULT.to_text(content, result.identity)


def load(path: Path) -> Result:
    """Read a row from its file. Raises ConfigError that names file and fault."""
    return load_with_checksum(path)[0]


def load_with_checksum(path: Path) -> tuple[Result, str]:
    """Read a row and the checksum of its file. Raises ConfigError as `load`."""
    result, checksum = read(path)
    if (result.task, result.estimator) != (path.parent.name, path.stem):
        raise ConfigError(
            f"{path}: contains the result of {result.estimator} on {result.task}, "
            "which its path does not name; evaluate again"
        )
    return result, checksum


def load_part(path: Path) -> Result:
    """Read a part from its file. Raises ConfigError that names file and fault."""
    result, _ = read(path)
    if result.identity != path.stem:
        raise ConfigError(
            f"{path}: contains the part {result.identity}, which its name does not say; "
            "evaluate again"
        )
    return result


def load_rows(out: Path, task: Task) -> list[Result]:
    """Return all rows of a task; drives and traces are read from disk on demand.

    An unreadable file becomes a row with a failure.
    """
    paths = sorted((out / "results" / task.name).glob("*.json"))
    return [_row_or_failure(path, task) for path in paths if path.name[0] != "."]


def _row_or_failure(path: Path, task: Task) -> Result:
    try:
        result, checksum = load_with_checksum(path)
    except ConfigError as error:
        return Result(
            task=task.name,
            task_digest=task.digest,
            estimator=path.stem,
            role="baseline" if path.stem in ALL_BASELINES else "entry",
            settings={},
            package_version=package_version(),
            metric_version=heights.VERSION,
            seeds=(),
            evaluation_code=evaluation_version(),
            failure=f"its result cannot be read: {error}",
        )
    return dataclasses.replace(
        result,
        drives=_StoredSequence(path, result, checksum, "drives"),
        traces=_StoredSequence(path, result, checksum, "traces"),
    )


class _StoredSequence(Sequence[Any]):
    """Drives or traces of a result, read from disk on demand.

    Another run may replace the row file meanwhile. A file with the same identity has the same
    drives and is accepted, although its timings differ; any other raises RowChangedError.
    """

    def __init__(self, path: Path, result: Result, checksum: str, name: str):
        self.checksum = checksum  # of the file when it was listed
        self._path, self._name = path, name
        self._size = len(getattr(result, name))
        self._identity = result.identity

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, at: int) -> Any: ...
    @overload
    def __getitem__(self, at: slice) -> Sequence[Any]: ...
    def __getitem__(self, at: int | slice) -> Any:
        return self._all()[at]

    def __iter__(self):
        return iter(self._all())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and tuple(self) == tuple(other)

    def _all(self) -> tuple[Any, ...]:
        values = getattr(_stored_result(self._path, self.checksum, self._identity), self._name)
        if len(values) != self._size:
            raise RowChangedError(f"{self._path}: {ROW_REPLACED}")
        return values


@lru_cache(maxsize=CACHED_ROWS)
def _stored_result(path: Path, checksum: str, identity: str) -> Result:
    result, current = read(path)
    if current != checksum and (not identity or result.identity != identity):
        raise RowChangedError(f"{path}: {ROW_REPLACED}")
    return result


def read(path: Path) -> tuple[Result, str]:
    """Read a row or a part, whatever its name, and the checksum of its file. Raises ConfigError."""
    data, checksum = RESULT.read(path)
    drives = build(_DriveColumns, data.pop("drives", {}), f"{path}: drives")
    result = build(Result, data, str(path))
    return dataclasses.replace(
        result, drives=_drive_scores(drives, path), traces=tuple(result.traces)
    ), checksum


def _columns(drives: Sequence[DriveScores]) -> dict[str, Any]:
    fields = [f.name for f in dataclasses.fields(DriveScores) if f.name != "scores"]
    names = dict.fromkeys(name for drive in drives for name in drive.scores)
    columns: dict[str, Any] = {name: [getattr(d, name) for d in drives] for name in fields}
    return columns | {"scores": {name: [d.scores.get(name) for d in drives] for name in names}}


def _drive_scores(table: _DriveColumns, path: Path) -> tuple[DriveScores, ...]:
    names = ("condition", "drive", "road", "road_seed", "seed")
    columns = [getattr(table, name) for name in names]
    if len({len(column) for column in [*columns, *table.scores.values()]}) > 1:
        raise ConfigError(f"{path}: drives: columns have different lengths; evaluate again")
    return tuple(
        DriveScores(
            **dict(zip(names, place, strict=True)),
            scores={n: x for n, column in table.scores.items() if (x := column[k]) is not None},
        )
        for k, place in enumerate(zip(*columns, strict=True))
    )
