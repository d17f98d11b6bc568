"""Results as files: one JSON per task and estimator, written whole or not at all, read strictly.

    <out>/results/<task>/<estimator>.json

Every score of every drive and training seed is kept, never only a mean. A result says which task
(by digest), package and metrics it belongs to; one that belongs to others is stale, and shown as
such, never mixed with the rest. A file that cannot be read is an error that names it.
"""

import dataclasses
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from leaderboard import metrics
from leaderboard.environment import version
from leaderboard.tasks import Task
from road_envs.config import STRICT, ConfigError, build
from road_envs.files import write_text

FORMAT = 1
Role = Literal["entry", "sentinel"]
Z_UNIT = 1e-5
"""Heights of a trace are stored as whole numbers of 0.01 mm."""

NUMBERS = re.compile(r"\[[\s\d.,eE+-]+\]")
"""A list of numbers in JSON, which is written on one line."""


@dataclass(frozen=True, kw_only=True)
class DriveScores:
    """Scores of one estimate: test drive `drive` of the condition, on the road of `road_seed`, by
    an estimator trained with `seed`. A score that is not defined is None.
    """

    __pydantic_config__ = STRICT

    condition: str
    drive: int
    road: str
    road_seed: int
    seed: int
    scores: dict[str, float | None]


@dataclass(frozen=True, kw_only=True)
class Trace:
    """A stretch of truth and estimate to be drawn: heights (2, M) in units of 0.01 mm.

    `scores` are those of the whole drive.
    """

    __pydantic_config__ = STRICT

    condition: str
    speed_kmh: float
    road: str
    road_seed: int
    seed: int
    scores: dict[str, float | None]
    ds: float  # [m]
    truth: tuple[tuple[int, ...], tuple[int, ...]]
    estimate: tuple[tuple[int, ...], tuple[int, ...]]

    @property
    def s(self) -> np.ndarray:
        """Stations (M,) [m]."""
        return self.ds * np.arange(len(self.truth[0]))

    @property
    def z_true(self) -> np.ndarray:
        """True heights (2, M) [m]."""
        return Z_UNIT * np.array(self.truth)

    @property
    def z_estimated(self) -> np.ndarray:
        """Estimated heights (2, M) [m]."""
        return Z_UNIT * np.array(self.estimate)


@dataclass(frozen=True, kw_only=True)
class Result:
    """What one estimator did on one task; with a `failure` in one sentence, nothing is scored."""

    __pydantic_config__ = STRICT

    task: str
    task_digest: str
    estimator: str
    role: Role
    settings: dict[str, Any]
    package_version: str
    metric_version: int
    seeds: tuple[int, ...]  # of the training, as asked; one that draws nothing used the first
    drives: tuple[DriveScores, ...] = ()
    train_seconds: tuple[float, ...] = ()  # one per condition and seed
    estimate_ms_per_100m: float | None = None
    parameters: int | None = None  # numbers learnt
    causal: bool | None = None
    failure: str | None = None
    notes: tuple[str, ...] = ()
    traces: tuple[Trace, ...] = ()
    environment: dict[str, str] = dataclasses.field(default_factory=dict)
    format: int = FORMAT

    def values(self, score: str) -> np.ndarray:
        """One score as (R, C, S): roads, conditions, seeds; NaN where it is not defined."""
        roads = list(dict.fromkeys(d.drive for d in self.drives))
        conditions = list(dict.fromkeys(d.condition for d in self.drives))
        seeds = list(dict.fromkeys(d.seed for d in self.drives))
        values = np.full((len(roads), len(conditions), len(seeds)), np.nan)
        for d in self.drives:
            at = roads.index(d.drive), conditions.index(d.condition), seeds.index(d.seed)
            value = d.scores.get(score)
            values[at] = np.nan if value is None else value
        return values

    def stale(self, task: Task) -> str | None:
        """Why this result does not belong beside results of `task` made now; None if it does."""
        if self.task_digest != task.digest:
            return "the task has changed"
        if self.package_version != version():
            return f"made by version {self.package_version}"
        if self.metric_version != metrics.VERSION:
            return f"scored by metrics {self.metric_version}, now {metrics.VERSION}"
        return None


def path_of(out: Path, task: str, estimator: str) -> Path:
    """Where the result of an estimator on a task is kept."""
    return out / "results" / task / f"{estimator}.json"


def save(result: Result, out: Path) -> Path:
    """Write a result to its place, whole or not at all."""
    path = path_of(out, result.task, result.estimator)
    text = json.dumps(_plain(dataclasses.asdict(result)), indent=1, allow_nan=False)
    text = NUMBERS.sub(lambda match: " ".join(match[0].split()), text) + "\n"
    write_text(path, text, durable=True)
    return path


def load(path: Path) -> Result:
    """A result from its file. Raises ConfigError that names the file and what is wrong with it."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"{path}: damaged, not valid JSON: {error}") from None
    if not isinstance(data, dict) or "format" not in data:
        raise ConfigError(f"{path}: not a result (it has no format)")
    if data["format"] != FORMAT:
        raise ConfigError(
            f"{path}: written in format {data['format']!r}, this version reads {FORMAT}; "
            "delete the file and evaluate again"
        )
    result = build(Result, data, str(path))
    if (result.task, result.estimator) != (path.parent.name, path.stem):
        raise ConfigError(
            f"{path}: holds the result of {result.estimator} on {result.task}, not what it says"
        )
    return result


def load_all(out: Path, task: str) -> list[Result]:
    """All results of a task, by name of the estimator. Raises ConfigError for a damaged one."""
    return [load(path) for path in sorted((out / "results" / task).glob("*.json"))]


def heights(z: np.ndarray) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Heights (2, M) [m] as a trace keeps them; beyond 1 km they are cut."""
    left, right = np.rint(np.clip(z, -1e3, 1e3) / Z_UNIT).astype(int).tolist()
    return tuple(left), tuple(right)


def _plain(value: Any) -> Any:
    """`value` with None for what JSON has no number for."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
