"""Results: all scores of one estimator on one task, and merging the parts of several conditions.

Scores are a long table with the columns of COLUMNS, a row for each defined score of a run: of one
estimate, of a drive under a condition after one training. Runs are in the order of their making.

A result names the versions of the task (by digest), code, package and metrics that it was made
with. A result of other versions is stale: it is reported as such and not compared with the rest.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, PlainValidator

import estimators
from leaderboard.entries.entry import Entry
from leaderboard.evaluation.provenance import package_code, package_version
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics import heights
from leaderboard.metrics.baselines import ALL_BASELINES
from leaderboard.metrics.registry import SCORES
from road_envs.core import config
from road_envs.core.artifacts import Kind, code_version
from road_envs.core.code_digest import digest
from road_envs.core.config import Settings
from road_envs.core.extras import optional_import

if TYPE_CHECKING:
    import pandas as pd

_JUDGE = ("leaderboard.evaluation.evaluate", "leaderboard.sandbox.client")
"""Modules that import, directly or not, all code that determines drives, notes and scores."""

RESULT = Kind("result", 6, _JUDGE)
ISOLATED = ("bubblewrap",)
"""Values of `Result.isolation` of entries without access to files, network and other processes."""

_Cost = Annotated[float, Field(ge=0, le=1e12, allow_inf_nan=False)]  # has a mean
_Z_UNIT = 1e-5  # unit [m] of the heights of a trace, which are stored as integers
_MAX_HEIGHTS = 10_000  # of a trace: 100 m at the least spacing; the shortest road has 4

RUN = ("condition", "drive", "road", "road_seed", "seed")
"""Columns that tell a run of an entry: `road_seed` is that of the road, `seed` of the training."""

COLUMNS = (*RUN, "score", "value")
"""Columns of a table of scores. Values are as computed, not scaled for printing."""


def _as_heights(values: Any) -> np.ndarray:
    array: np.ndarray = np.empty(0, dtype=np.int32)
    with suppress(TypeError, ValueError, OverflowError):  # of lists of different lengths, too
        array = np.array(values, dtype=np.int32)
    if array.ndim != 2 or array.shape[0] != 2 or not 4 <= array.shape[1] <= _MAX_HEIGHTS:
        raise ValueError("left and right must have one number of heights, 4 to 10000 whole numbers")
    return _shared(array.tobytes())


@lru_cache(maxsize=64)
def _shared(data: bytes) -> np.ndarray:
    """Return heights (2, M), read-only: all rows of a task have the same true ones."""
    return np.frombuffer(data, dtype=np.int32).reshape(2, -1)


_Heights = Annotated[np.ndarray, PlainValidator(_as_heights)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace(Settings):
    """True and estimated heights (2, M) of the start of a drive, in units of _Z_UNIT, for plots.

    `scores` are those of the whole drive.
    """

    condition: str
    speed_kmh: Annotated[float, Field(gt=0.1, le=400)]
    road: str
    road_seed: int
    seed: int
    scores: dict[str, float]
    ds: Annotated[float, Field(gt=0.01, lt=0.1)]  # [m]
    truth: _Heights
    estimate: _Heights
    deviation: _Heights | None = None  # if the estimate has one

    def __post_init__(self):
        super().__post_init__()
        given = [x for x in (self.estimate, self.deviation) if x is not None]
        if any(x.shape != self.truth.shape for x in given):
            raise ValueError("truth, estimate and deviation must have one number of heights")

    @staticmethod
    def quantized(z: np.ndarray) -> np.ndarray:
        """Return heights (2, M) [m] as integers of _Z_UNIT, clipped to 1 km."""
        return np.rint(np.clip(z, -1e3, 1e3) / _Z_UNIT).astype(np.int32)

    @property
    def z_std(self) -> np.ndarray | None:
        """Standard deviation (2, M) [m] of the estimate; None if it has none."""
        return None if self.deviation is None else _Z_UNIT * self.deviation

    @property
    def s(self) -> np.ndarray:
        """Stations (M,) [m]."""
        return self.ds * np.arange(self.truth.shape[1])

    @property
    def z_true(self) -> np.ndarray:
        """True heights (2, M) [m]."""
        return _Z_UNIT * self.truth

    @property
    def z_estimated(self) -> np.ndarray:
        """Estimated heights (2, M) [m]."""
        return _Z_UNIT * self.estimate


@dataclass(frozen=True, kw_only=True, eq=False)
class Result(Settings):
    """Scores of one estimator on one task, or under one of its conditions, and their provenance.

    `scores` is a table with COLUMNS; None with a `failure`, one sentence.
    """

    task: str
    task_digest: str
    estimator: str
    role: Literal["entry", "baseline"]
    settings: dict[str, Any]
    package_version: str
    metric_version: int
    seeds: tuple[int, ...]  # requested training seeds; a deterministic training used the first
    code: str = ""  # version of the estimator's sources and weights
    evaluation_code: str = ""  # version of the sources that make drives and scores
    identity: str = ""  # digest of all inputs: task, estimator, versions, seeds
    conditions: tuple[str, ...] = ()
    scores: Any = None
    train_seconds: tuple[_Cost, ...] = ()  # one per condition and seed
    calibrates: bool | None = None  # to the vehicle; None on tasks without calibration drives
    calibrate_seconds: _Cost | None = None  # mean of one calibration
    estimate_ms_per_100m: _Cost | None = None
    parameters: Annotated[int, Field(ge=0, lt=2**63)] | None = None  # number of fitted parameters
    causal: bool | None = None
    lag: float = 0.0  # [m] behind the front axle, of a causal estimate
    failure: str | None = None
    notes: tuple[str, ...] = ()
    traces: tuple[Trace, ...] = ()
    peak_memory: _Cost | None = None  # [GiB] of the entry's processes, libraries included
    isolation: str = "none"  # of the entry: none, process, bubblewrap
    limits: tuple[float, float] = (0.0, 0.0)  # [s], [GiB] of a run of the entry; 0: unknown
    environment: dict[str, str] = dataclasses.field(default_factory=dict)

    def stale_reason(self, task: Task, entry: Entry | None = None) -> str | None:
        """Return why this result cannot be compared with current ones of a task, else None.

        `entry` is the current version of its entry, if that is known.
        """
        if self.task_digest != task.digest:
            return "the task has changed"
        if self.package_version != package_version():
            return f"made by version {self.package_version}"
        if self.metric_version != heights.VERSION:
            return f"scored by metrics {self.metric_version}, now {heights.VERSION}"
        if self.evaluation_code != evaluation_version():
            return "driven or scored by other code"
        by_others = self.role == "entry" and self.estimator not in estimators.REGISTRY
        if by_others and self.environment.get("code", package_code()) != package_code():
            return "made with other code or weights of this package"
        if entry is None or not self.code:
            return None
        if self.code != entry.code:
            return "its code or its weights have changed"
        return None if self.settings == entry.settings else "made with other settings"


def unscored_result(task: Task, estimator: str, **fields: Any) -> Result:
    """Return a result of an estimator on a task, by the code of this package, without scores.

    `fields` are its other ones: at least `settings` and `seeds`.
    """
    return Result(
        task=task.name, task_digest=task.digest, estimator=estimator,
        role="baseline" if estimator in ALL_BASELINES else "entry",
        package_version=package_version(), metric_version=heights.VERSION,
        evaluation_code=evaluation_version(), **fields,
    )  # fmt: skip


RUN_DEPENDENT = frozenset({
    "train_seconds", "calibrate_seconds", "estimate_ms_per_100m", "peak_memory", "isolation",
    "limits", "environment",
})  # fmt: skip
"""Fields that differ from run to run and machine to machine."""


@lru_cache(maxsize=1)
def evaluation_version() -> str:
    """Version of what determines drives, notes and scores: code, and the shipped instruments."""
    folder = config.folder() / "sensors"  # estimators read them, whatever a task has
    return f"{code_version(*_JUDGE)}+{digest(folder.iterdir(), folder)}"


def content_digest(result: Result) -> str:
    """Return a digest of the reproducible fields of a result, to the last bit.

    It tells whether a stored result was altered. Two runs of the same inputs need not have one
    digest, as another processor rounds otherwise: `comparison.distances` compares them.
    """
    plain = {name: x for name, x in to_plain(result).items() if name not in RUN_DEPENDENT}
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()


def to_plain(result: Result) -> dict[str, Any]:
    """Return the fields of a result as JSON types: its table by columns, heights as lists."""
    fields = dict(vars(result))
    if result.scores is not None:
        fields["scores"] = {name: column.tolist() for name, column in result.scores.items()}
    fields["traces"] = [
        {name: x.tolist() if isinstance(x, np.ndarray) else x for name, x in vars(trace).items()}
        for trace in result.traces
    ]
    return fields


def make_table(columns: Any) -> "pd.DataFrame":
    """Return a table of scores from its columns or rows; repeated texts are stored once.

    Raises MissingExtraError without pandas.
    """
    with optional_import("a table of scores"):
        import pandas as pd  # slow to load: only where a table is made

    table = pd.DataFrame(columns, columns=list(COLUMNS))
    return table.astype({name: "category" for name in ("condition", "road", "score")})


def scores_table(results: Iterable[Result]) -> "pd.DataFrame":
    """Table of the scores of all runs of results: estimator, and COLUMNS."""
    import pandas as pd

    tables = [r.scores.assign(estimator=r.estimator) for r in results if r.scores is not None]
    table = pd.concat(tables or [make_table([]).assign(estimator="")], ignore_index=True)
    return table[["estimator", *COLUMNS]]


def score_arrays(table: "pd.DataFrame", scores: Sequence[str] = tuple(SCORES)) -> np.ndarray:
    """Scores (K, R, C, S) of the runs of one estimator: roads, conditions, training seeds.

    Roads are in the order of the task. NaN where a road was not driven under a condition and where
    a score is undefined. A training whose others are equal counts for each, so that all weigh one.
    """
    import pandas as pd

    roads, at_road = np.unique(table["drive"], return_inverse=True)
    at_condition, conditions = pd.factorize(table["condition"])
    at_seed, seeds = pd.factorize(table["seed"])
    at_score = pd.Index(scores).get_indexer(table["score"])
    arrays = np.full((len(scores), len(roads), len(conditions), len(seeds)), np.nan)
    known = at_score >= 0
    places = (at[known] for at in (at_score, at_road, at_condition, at_seed))
    arrays[tuple(places)] = table["value"].to_numpy()[known]
    trained = np.zeros(arrays.shape[2:], dtype=bool)
    trained[at_condition, at_seed] = True
    first = arrays[:, :, range(len(trained)), trained.argmax(axis=1), None]  # in any order of a row
    return np.where(trained, arrays, first)


def merge_parts(parts: Sequence[Result], identity: str) -> Result:
    """Merge the results of each condition, in order; a failure in one part fails the whole."""
    first = parts[0]
    failure = next((part.failure for part in parts if part.failure is not None), None)
    scored = () if failure else parts
    names = dict.fromkeys(name for part in parts for name in part.environment)
    return dataclasses.replace(
        first,
        identity=identity,
        conditions=tuple(label for part in parts for label in part.conditions),
        scores=make_table(scores_table(scored)[list(COLUMNS)]) if scored else None,
        train_seconds=tuple(seconds for part in scored for seconds in part.train_seconds),
        calibrates=_maximum(part.calibrates for part in parts),  # under some condition
        calibrate_seconds=_mean(part.calibrate_seconds for part in parts),
        estimate_ms_per_100m=_mean(part.estimate_ms_per_100m for part in parts),
        causal=first.causal if all(part.causal == first.causal for part in parts) else False,
        parameters=_maximum(part.parameters for part in parts),
        peak_memory=_maximum(part.peak_memory for part in parts),
        limits=(max(part.limits[0] for part in parts), max(part.limits[1] for part in parts)),
        failure=failure,
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
        traces=tuple(trace for part in scored for trace in part.traces),
        isolation=" or ".join(dict.fromkeys(part.isolation for part in scored)),
        environment={
            name: " or ".join(dict.fromkeys(part.environment.get(name, "none") for part in parts))
            for name in names
        },
    )


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _maximum(values: Iterable[float | None]) -> Any:
    return max((value for value in values if value is not None), default=None)
