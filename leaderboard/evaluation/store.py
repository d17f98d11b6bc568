"""Results as files: written whole or not at all, read strictly, known by what they depend on.

    <out>/results/<task>/<estimator>.json   a row of the board
    <out>/jobs/<identity>.json              a part of one: the same under one condition

The name of a part is the digest of all that it depends on, so it never has to be changed, only
written; two runs that write one folder write the same. A row is put together from its parts, and
can be again. Each file begins with a checksum of the rest.
"""

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, overload

from leaderboard.evaluation.code_version import evaluation_version
from leaderboard.evaluation.provenance import package_version
from leaderboard.evaluation.results import FORMAT, DriveScores, Result, Trace
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics import heights
from leaderboard.metrics.baselines import BASELINES
from road_envs._atomic_io import write_text
from road_envs.config import STRICT, ConfigError, build

CHECKSUM_PREFIX = '{\n "sha256": "'
CHECKSUM_SUFFIX = '",\n'

ROW_REPLACED = "another run has replaced it by a different result; read the board again"

CACHED_ROWS = 8
"""How many results are held in memory whole; of the others only what stands above their drives."""


class RowChangedError(ConfigError):
    """A row that another run has replaced by a different one since it was listed."""


class NewerFormatError(ConfigError):
    """A file that a newer version wrote: not to be read here, nor to be written over."""


@dataclass(frozen=True)
class _DriveColumns:
    """All scores of a result, column by column."""

    __pydantic_config__ = STRICT

    condition: tuple[str, ...]
    drive: tuple[int, ...]
    road: tuple[str, ...]
    road_seed: tuple[int, ...]
    seed: tuple[int, ...]
    scores: dict[str, tuple[float | None, ...]]
    """A score that is not defined for a drive is None in its column."""


@dataclass(frozen=True)
class _LargeFields:
    """The large part of a result."""

    drives: tuple[DriveScores, ...]
    traces: tuple[Trace, ...]


def row_path(out: Path, task: str, estimator: str) -> Path:
    """Where the result of an estimator on a task is kept."""
    return out / "results" / task / f"{estimator}.json"


def part_path(out: Path, identity: str) -> Path:
    """Where the part of a result is kept."""
    return out / "jobs" / f"{identity}.json"


def save(result: Result, out: Path) -> Path:
    """Write a result to its place on the board, whole or not at all."""
    path = row_path(out, result.task, result.estimator)
    write_durable(path, to_text(result))
    return path


def write_durable(path: Path, text: str) -> None:
    """Write the text of a result, whole or not at all, and to the disk before anyone sees it."""
    write_text(path, text, durable=True)


def to_text(result: Result) -> str:
    """A result as JSON, the checksum of the rest first."""
    large: dict[str, Any] = {
        "drives": _columns(result.drives),
        "traces": [vars(trace) for trace in result.traces],
    }
    names = [f.name for f in dataclasses.fields(result)]
    return with_checksum(
        {n: large[n] if n in large else _nan_to_none(getattr(result, n)) for n in names}
    )


def with_checksum(data: Mapping[str, Any]) -> str:
    """`data`, of which `format` is a part, as JSON with the checksum of the rest first."""
    rest = _dump_by_lines(dict(data))[2:] + "\n"
    blank = f"{CHECKSUM_PREFIX}{'0' * 64}{CHECKSUM_SUFFIX}{rest}"
    return blank.replace("0" * 64, text_checksum(blank), 1)


def load(path: Path) -> Result:
    """A row of the board from its file. Raises ConfigError that names file and fault."""
    return load_with_checksum(path)[0]


def load_with_checksum(path: Path) -> tuple[Result, str]:
    """A row of the board, and the checksum of its file. Raises ConfigError as `load`."""
    result, told = read_with_checksum(path)
    if (result.task, result.estimator) != (path.parent.name, path.stem):
        raise ConfigError(
            f"{path}: holds the result of {result.estimator} on {result.task}, not what it says"
        )
    return result, told


def load_part(path: Path) -> Result:
    """A part from its file. Raises ConfigError that names the file and what is wrong with it."""
    result = read(path)
    if result.identity != path.stem:
        raise ConfigError(f"{path}: holds the result {result.identity}, not what its name says")
    return result


def read(path: Path) -> Result:
    """A row or a part, whatever the name of its file says. Raises ConfigError."""
    return read_with_checksum(path)[0]


def load_all(out: Path, task: str) -> list[Result]:
    """All rows of a task, by name of the estimator. Raises ConfigError for a damaged one."""
    return [load(path) for path in _row_files(out, task)]


def load_rows(out: Path, task: Task) -> list[Result]:
    """All rows of a task, whose drives and traces are read from their files when they are needed.

    A file that cannot be read is a failed row that says so.
    """
    return [_row_or_failure(path, task) for path in _row_files(out, task.name)]


def row_checksum(result: Result) -> str:
    """Of the file that a result from `load_rows` stands in; of any other, of what it would be."""
    drives = result.drives
    return (
        drives.checksum if isinstance(drives, _StoredSequence) else text_checksum(to_text(result))
    )


def text_checksum(text: str) -> str:
    """The checksum of the text of a result, whatever it says itself."""
    return hashlib.sha256(
        text[len(CHECKSUM_PREFIX) + 64 + len(CHECKSUM_SUFFIX) :].encode()
    ).hexdigest()


def _row_or_failure(path: Path, task: Task) -> Result:
    try:
        result, checksum = load_with_checksum(path)
    except ConfigError as error:
        return Result(
            task=task.name,
            task_digest=task.digest,
            estimator=path.stem,
            role="sentinel" if path.stem in BASELINES else "entry",
            settings={},
            package_version=package_version(),
            metric_version=heights.VERSION,
            seeds=(),
            judge=evaluation_version(),
            failure=f"its result cannot be read: {error}",
        )
    return dataclasses.replace(
        result,
        drives=_StoredSequence(path, result, checksum, "drives"),
        traces=_StoredSequence(path, result, checksum, "traces"),
    )


class _StoredSequence(Sequence[Any]):
    """Drives or traces that stay on the disk until they are asked for.

    Another run may write the same row meanwhile. A file with the same identity holds the same
    drives, whatever its times of computing, so it serves; any other raises RowChangedError.
    """

    def __init__(self, path: Path, result: Result, checksum: str, name: str):
        self.checksum = checksum  # of the file as it was found
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
        values = getattr(_large_fields(self._path, self.checksum, self._identity), self._name)
        if len(values) != self._size:
            raise RowChangedError(f"{self._path}: {ROW_REPLACED}")
        return values


@lru_cache(maxsize=CACHED_ROWS)
def _large_fields(path: Path, checksum: str, identity: str) -> _LargeFields:
    result, found = read_with_checksum(path)
    if found != checksum and (not identity or result.identity != identity):
        raise RowChangedError(f"{path}: {ROW_REPLACED}")
    return _LargeFields(tuple(result.drives), tuple(result.traces))


def _row_files(out: Path, task: str) -> list[Path]:
    return sorted(p for p in (out / "results" / task).glob("*.json") if p.name[0] != ".")


def read_with_checksum(path: Path) -> tuple[Result, str]:
    """As `read`, with the checksum of the file."""
    data, told = read_checked_json(path, FORMAT)
    drives = build(_DriveColumns, data.pop("drives", {}), f"{path}: drives")
    result = build(Result, data, str(path))
    return dataclasses.replace(
        result, drives=_drive_scores(drives, path), traces=tuple(result.traces)
    ), told


def read_checked_json(path: Path, known: int) -> tuple[dict[str, Any], str]:
    """What stands in a file made by `with_checksum` in the format `known`, and its checksum.

    Raises NewerFormatError, and ConfigError that says what is wrong with it.
    """
    try:
        text = path.read_text(encoding="utf-8")
        data = json.loads(text)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: damaged, not valid JSON: {error}") from None
    if not isinstance(data, dict) or not isinstance(data.get("format"), int):
        raise ConfigError(f"{path}: not a result (it has no format)")
    if data["format"] > known:
        raise NewerFormatError(
            f"{path}: written in format {data['format']} by a newer version, this one reads "
            f"{known}; use that version, or another folder"
        )
    if data["format"] < known:
        raise ConfigError(
            f"{path}: written in format {data['format']}, this version reads {known}; "
            "evaluate again"
        )
    told = data.pop("sha256", None)
    if not text.startswith(f"{CHECKSUM_PREFIX}{told}{CHECKSUM_SUFFIX}"):
        raise ConfigError(f"{path}: not a result (it does not begin with its checksum)")
    if text_checksum(text) != told:
        raise ConfigError(
            f"{path}: changed since it was written, by hand or by a fault of the disk; "
            "evaluate again"
        )
    return data, str(told)


def _columns(drives: Sequence[DriveScores]) -> dict[str, Any]:
    fields = [f.name for f in dataclasses.fields(DriveScores) if f.name != "scores"]
    names = dict.fromkeys(name for drive in drives for name in drive.scores)
    columns: dict[str, Any] = {name: [getattr(d, name) for d in drives] for name in fields}
    return columns | {"scores": {name: [d.scores.get(name) for d in drives] for name in names}}


def _drive_scores(table: _DriveColumns, path: Path) -> tuple[DriveScores, ...]:
    columns = [table.condition, table.drive, table.road, table.road_seed, table.seed]
    size = len(table.drive)
    if any(len(column) != size for column in [*columns, *table.scores.values()]):
        raise ConfigError(f"{path}: drives: columns of different lengths")
    return tuple(
        DriveScores(
            condition=table.condition[k],
            drive=table.drive[k],
            road=table.road[k],
            road_seed=table.road_seed[k],
            seed=table.seed[k],
            scores={
                name: value
                for name, column in table.scores.items()
                if (value := column[k]) is not None
            },
        )
        for k in range(size)
    )


def _dump_by_lines(value: Any, depth: int = 2) -> str:
    """JSON with a line for each key down to `depth`, and all that lies deeper on that line."""
    if depth and isinstance(value, dict) and value:
        indent = " " * (3 - depth)
        lines = [
            f"{indent}{json.dumps(k)}: {_dump_by_lines(v, depth - 1)}" for k, v in value.items()
        ]
        return "{\n" + ",\n".join(lines) + "\n" + indent[1:] + "}"
    return json.dumps(value, allow_nan=False)


def _nan_to_none(value: Any) -> Any:
    """`value` with None for what JSON has no number for."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: _nan_to_none(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_nan_to_none(item) for item in value]
    return value
