"""Results: all scores of one estimator on one task, and merging the parts of several conditions.

Every score of every drive and training seed is stored, not only a mean. A result names the versions
of the task (by digest), code, package and metrics that it was made with. A result of other versions
is stale: it is reported as such and not compared with the rest.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from leaderboard.evaluation.provenance import package_version
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics import heights
from road_envs.core.artifacts import Kind, code_version
from road_envs.core.config import Settings

EVALUATION_MODULE = "leaderboard.evaluation.evaluate"
"""Module that imports, directly or not, all code that determines drives and scores."""

RESULT = Kind("result", 5, (EVALUATION_MODULE,))
Role = Literal["entry", "baseline"]
ISOLATED = ("bubblewrap",)
"""Values of `Result.isolation` of entries without access to files, network and other processes."""

Z_UNIT = 1e-5
"""Unit [m] of the heights of a trace, which are stored as integers."""


@dataclass(frozen=True, kw_only=True)
class DriveScores(Settings):
    """Scores of one estimate: test drive `drive` of the condition, on the road of `road_seed`.

    The estimator was trained with `seed`. An undefined score is omitted, in memory and on disk.
    """

    condition: str
    drive: int
    road: str
    road_seed: int
    seed: int
    scores: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class Trace(Settings):
    """True and estimated heights (2, M) of the start of a drive, in units of 0.01 mm, for plots.

    `scores` are those of the whole drive.
    """

    condition: str
    speed_kmh: float
    road: str
    road_seed: int
    seed: int
    scores: dict[str, float]
    ds: float  # [m]
    truth: tuple[tuple[int, ...], tuple[int, ...]]
    estimate: tuple[tuple[int, ...], tuple[int, ...]]
    deviation: tuple[tuple[int, ...], tuple[int, ...]] | None = None  # if the estimate has one

    def __post_init__(self):
        super().__post_init__()
        given = (*self.truth, *self.estimate, *(self.deviation or ()))
        if len({len(heights) for heights in given}) > 1:
            raise ValueError("truth, estimate and deviation must have one number of heights")

    @property
    def z_std(self) -> np.ndarray | None:
        """Standard deviation (2, M) [m] of the estimate; None if it has none."""
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
class Result(Settings):
    """Scores of one estimator on one task, or under one of its conditions.

    With a `failure`, one sentence, there are no scores.
    """

    task: str
    task_digest: str
    estimator: str
    role: Role
    settings: dict[str, Any]
    package_version: str
    metric_version: int
    seeds: tuple[int, ...]  # requested training seeds; a deterministic training used the first
    code: str = ""  # version of the estimator's sources and weights
    evaluation_code: str = ""  # version of the sources that make drives and scores
    identity: str = ""  # digest of all inputs: task, estimator, versions, seeds
    conditions: tuple[str, ...] = ()
    drives: Sequence[DriveScores] = ()
    train_seconds: tuple[float, ...] = ()  # one per condition and seed
    calibrates: bool | None = None  # to the vehicle; None on tasks without calibration drives
    calibrate_seconds: float | None = None  # mean of one calibration
    estimate_ms_per_100m: float | None = None
    parameters: int | None = None  # number of fitted parameters
    causal: bool | None = None
    lag: float = 0.0  # [m] behind the front axle, of a causal estimate
    failure: str | None = None
    notes: tuple[str, ...] = ()
    traces: Sequence[Trace] = ()
    peak_memory: float | None = None  # [GiB] of the entry's processes, libraries included
    isolation: str = "none"  # of the entry: none, process, bubblewrap
    environment: dict[str, str] = dataclasses.field(default_factory=dict)

    def stale_reason(self, task: Task) -> str | None:
        """Return why this result cannot be compared with current results of `task`, else None."""
        if self.task_digest != task.digest:
            return "the task has changed"
        if self.package_version != package_version():
            return f"made by version {self.package_version}"
        if self.metric_version != heights.VERSION:
            return f"scored by metrics {self.metric_version}, now {heights.VERSION}"
        if self.evaluation_code != evaluation_version():
            return "driven or scored by other code"
        return None


RUN_DEPENDENT = frozenset(
    {
        "train_seconds",
        "calibrate_seconds",
        "estimate_ms_per_100m",
        "peak_memory",
        "isolation",
        "environment",
    }
)
"""Fields that differ from run to run and machine to machine."""


def evaluation_version() -> str:
    """Version of the code that determines drives and scores."""
    return code_version(EVALUATION_MODULE)


def content_digest(result: Result) -> str:
    """Return a digest of the reproducible fields of a result, to the last bit.

    It tells whether a stored result was altered. Two runs of the same inputs need not have one
    digest, as another processor rounds otherwise: `comparison.disagreements` compares them.
    """
    names = sorted(f.name for f in dataclasses.fields(result) if f.name not in RUN_DEPENDENT)
    values = [getattr(result, name) for name in names]
    plain = [[vars(x) for x in v] if _is_dataclass_sequence(v) else v for v in values]
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()


def merge_parts(parts: Sequence[Result], identity: str) -> Result:
    """Merge the results of each condition, in order; a failure in one part fails the whole."""
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
        train_seconds=tuple(seconds for part in scored for seconds in part.train_seconds),
        calibrate_seconds=_maximum(part.calibrate_seconds for part in parts),
        estimate_ms_per_100m=float(np.mean(costs)) if costs else None,
        causal=first.causal if all(part.causal == first.causal for part in parts) else False,
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


def isolation_notice(results: Iterable[Result]) -> str | None:
    """Return one sentence on the scored rows that ran without isolation; None if all had it."""
    names = [
        r.estimator
        for r in results
        if r.role == "entry" and r.failure is None and r.isolation not in ISOLATED
    ]
    if not names:
        return None
    return (
        f"Run without isolation: {', '.join(dict.fromkeys(names))}. These estimators had the "
        "rights of the user who ran the board: their rows hold only if that user trusts their code."
    )


def quantize_heights(z: np.ndarray) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return heights (2, M) [m] as integers of Z_UNIT, clipped to 1 km."""
    left, right = np.rint(np.clip(z, -1e3, 1e3) / Z_UNIT).astype(int).tolist()
    return tuple(left), tuple(right)


def _is_dataclass_sequence(value: Any) -> bool:
    return isinstance(value, Sequence) and len(value) > 0 and dataclasses.is_dataclass(value[0])


def _join_distinct(texts: Iterable[str]) -> str:
    return " or ".join(dict.fromkeys(texts))


def _maximum(values: Iterable[float | None]) -> Any:
    return max((value for value in values if value is not None), default=None)
