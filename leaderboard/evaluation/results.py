"""Results: what one estimator did on one task, and how the parts of it are put together.

Every score of every drive and training seed is kept, never only a mean. A result says which task
(by digest), code, package and metrics it belongs to; one that belongs to others is stale, and shown
as such, never mixed with the rest.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from leaderboard.evaluation.code_version import evaluation_version
from leaderboard.evaluation.provenance import package_version
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics import heights
from road_envs.config import STRICT

FORMAT = 3
Role = Literal["entry", "sentinel"]
Z_UNIT = 1e-5
"""Heights of a trace are stored as whole numbers of 0.01 mm."""


@dataclass(frozen=True, kw_only=True)
class DriveScores:
    """Scores of one estimate: test drive `drive` of the condition, on the road of `road_seed`, by
    an estimator trained with `seed`. A score that is not defined is left out, in memory as on disk.
    """

    __pydantic_config__ = STRICT

    condition: str
    drive: int
    road: str
    road_seed: int
    seed: int
    scores: dict[str, float]


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
    scores: dict[str, float]
    ds: float  # [m]
    truth: tuple[tuple[int, ...], tuple[int, ...]]
    estimate: tuple[tuple[int, ...], tuple[int, ...]]
    deviation: tuple[tuple[int, ...], tuple[int, ...]] | None = None  # where the estimate has one

    @property
    def z_std(self) -> np.ndarray | None:
        """Standard deviation (2, M) [m] of the estimate, where it has one."""
        return None if self.deviation is None else Z_UNIT * np.array(self.deviation)

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
    """What one estimator did on one task, or under one of its conditions; with a `failure` in one
    sentence, nothing is scored.
    """

    __pydantic_config__ = STRICT

    task: str
    task_digest: str
    estimator: str
    role: Role
    settings: dict[str, Any]
    package_version: str
    metric_version: int
    seeds: tuple[int, ...]  # of the training, as asked; one that draws nothing used the first
    code: str = ""  # version of the estimator's sources
    judge: str = ""  # version of the sources that make drives and scores
    identity: str = ""  # of all that it depends on: task, estimator, versions, seeds
    conditions: tuple[str, ...] = ()
    drives: Sequence[DriveScores] = ()
    train_seconds: tuple[float, ...] = ()  # one per condition and seed
    estimate_ms_per_100m: float | None = None
    parameters: int | None = None  # numbers learnt
    causal: bool | None = None
    failure: str | None = None
    notes: tuple[str, ...] = ()
    traces: Sequence[Trace] = ()
    peak_memory: float | None = None  # [GiB] of the entry's processes, libraries included
    isolation: str = "none"  # of the entry from the judge: none, process, namespaces
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
            values[at] = d.scores.get(score, np.nan)
        return values

    def stale_reason(self, task: Task) -> str | None:
        """Why this result does not belong beside results of `task` made now; None if it does."""
        if self.task_digest != task.digest:
            return "the task has changed"
        if self.package_version != package_version():
            return f"made by version {self.package_version}"
        if self.metric_version != heights.VERSION:
            return f"scored by metrics {self.metric_version}, now {heights.VERSION}"
        if self.judge != evaluation_version():
            return "driven or scored by other code"
        return None


RUN_DEPENDENT = frozenset(
    {"train_seconds", "estimate_ms_per_100m", "peak_memory", "isolation", "environment"}
)
"""Fields that differ from run to run."""


def content_digest(result: Result) -> str:
    """Digest of all that is the same whenever and wherever a result is made."""
    names = sorted(f.name for f in dataclasses.fields(result) if f.name not in RUN_DEPENDENT)
    values = [getattr(result, name) for name in names]
    plain = [[vars(x) for x in v] if _is_dataclass_sequence(v) else v for v in values]
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()


def merge_parts(parts: Sequence[Result], identity: str) -> Result:
    """One result of those under each condition, in their order; a failure in one fails it all."""
    first = parts[0]
    failure = next((part.failure for part in parts if part.failure is not None), None)
    scored = () if failure else parts
    costs = [part.estimate_ms_per_100m for part in parts if part.estimate_ms_per_100m is not None]
    names = dict.fromkeys(name for part in parts for name in part.environment)
    return dataclasses.replace(
        first,
        identity=identity,
        conditions=tuple(label for part in parts for label in part.conditions),
        drives=tuple(drive for part in scored for drive in part.drives),
        train_seconds=tuple(spent for part in scored for spent in part.train_seconds),
        estimate_ms_per_100m=float(np.mean(costs)) if costs else None,
        parameters=_maximum(part.parameters for part in parts),
        peak_memory=_maximum(part.peak_memory for part in parts),
        failure=failure,
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
        traces=tuple(trace for part in scored for trace in part.traces),
        isolation=_join_distinct(part.isolation for part in scored),
        environment={
            name: _join_distinct(part.environment.get(name, "none") for part in parts)
            for name in names
        },
    )


def quantize_heights(z: np.ndarray) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Heights (2, M) [m] as a trace keeps them; beyond 1 km they are cut."""
    left, right = np.rint(np.clip(z, -1e3, 1e3) / Z_UNIT).astype(int).tolist()
    return tuple(left), tuple(right)


def _is_dataclass_sequence(value: Any) -> bool:
    return isinstance(value, Sequence) and len(value) > 0 and dataclasses.is_dataclass(value[0])


def _join_distinct(texts: Iterable[str]) -> str:
    return " or ".join(dict.fromkeys(texts))


def _maximum(values: Iterable[float | None]) -> Any:
    return max((value for value in values if value is not None), default=None)
