"""Planning of a run: the jobs of missing results, and assembling rows from stored parts."""

import dataclasses
import math
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from leaderboard.entries.entries import fold, is_by_others
from leaderboard.entries.entry import Entry
from leaderboard.evaluation import store
from leaderboard.evaluation.results import Result, content_digest, merge_parts
from leaderboard.evaluation.tasks import Task
from leaderboard.running.jobs import Job, JobDone, result_identity
from leaderboard.sandbox.limits import Limits
from road_envs.core.artifacts import NewerFormatError
from road_envs.core.config import ConfigError


class ReplacedRowError(ConfigError):
    """Stored rows of other code that a run would replace; `names` are those of their entries."""

    def __init__(self, names: Sequence[str], out: Path):
        self.names = tuple(names)
        replace = " ".join(f"--replace {name}" for name in names)
        super().__init__(
            f"{out} holds rows of {', '.join(names)} that were made by other code; to replace them "
            f"give {replace}, else name the entry differently or choose another folder"
        )


@dataclass(frozen=True, eq=False)
class PlannedRow:
    """A row of the board that a run has to produce."""

    task: Task
    entry: Entry
    seeds: tuple[int, ...]

    @cached_property
    def identity(self) -> str:
        """Identity of the whole row."""
        return result_identity(self.task, None, self.entry, self.seeds)

    @cached_property
    def parts(self) -> tuple[str, ...]:
        """Identities of the parts, one for each condition."""
        conditions = range(len(self.task.conditions))
        return tuple(result_identity(self.task, k, self.entry, self.seeds) for k in conditions)


def check_owners(rows: Sequence[PlannedRow], out: Path, replace: Collection[str] = ()) -> None:
    """Raise ConfigError if a row of an entry from outside would replace that of other code.

    ReplacedRowError unless its name is in `replace`; no two names may look the same.
    """
    asked: dict[str, None] = {}
    for row in rows:
        name = row.entry.name
        path = store.row_path(out, row.task.name, name)
        others = path.parent.glob("*.json") if is_by_others(row.entry) else ()
        for other in (x for x in others if fold(x.stem) == fold(name)):
            if other.stem != name:
                raise ConfigError(f"{other}: {name} looks the same; rename the entry")
            with suppress(ConfigError):  # a damaged row
                stored = store.load(path)
                if stored.failure is None and stored.code != row.entry.code and name not in replace:
                    asked[name] = None
    if asked:
        raise ReplacedRowError(list(asked), out)


class Plan:
    """State of a run: current rows, stored parts, and missing results, also of wider `limits`.

    An entry that runs without isolation could change stored files. The plan therefore records a
    digest of each file that it has read or that a job has reported, and verifies it before use.
    """

    def __init__(
        self, rows: Sequence[PlannedRow], out: Path, limits: Limits, resume: bool = True,
        replace: Collection[str] = (),
    ):  # fmt: skip
        """Raises as `check_owners`; NewerFormatError if a file in a newer format is replaced."""
        check_owners(rows, out, replace)
        self.rows, self.out, self._limits, self._replace = rows, out, limits, replace
        self._digests: dict[Path, str] = {}  # of the content, by path
        self._failed: set[Path] = set()  # parts that hold a failure
        self._pending = [row for row in rows if not self._is_current(row, resume)]
        for row in self._pending if resume else []:
            for path, part in zip(self._parts(row), row.parts, strict=True):
                with suppress(ConfigError):  # missing or damaged
                    result = store.load_part(path)
                    named = result.identity, result.task_digest, result.estimator, result.seeds
                    is_of_row = named == (part, row.task.digest, row.entry.name, row.seeds)
                    if self._is_valid(result) and is_of_row:  # it may come from elsewhere
                        self._digests[path] = content_digest(result)

    def missing(self) -> list[tuple[PlannedRow, int]]:
        """Return the rows and conditions that have to be run."""
        return [
            (row, k)
            for row in self._pending
            for k, path in enumerate(self._parts(row))
            if path not in self._digests
        ]

    def record_part(self, done: JobDone) -> None:
        """Record a part that was run."""
        path = store.part_path(self.out, done.identity)
        self._digests[path] = done.content_digest
        if done.failure is not None:
            self._failed.add(path)

    def assemble_rows(self) -> bool:
        """Assemble and write rows; return False if results are missing.

        Files that have changed since they were recorded are dropped and have to be run again.
        """
        known = self._digests.items()
        self._digests = {path: digest for path, digest in known if _is_unchanged(path, digest)}
        left = [x for x in self.rows if x in self._pending or self._path(x) not in self._digests]
        self._pending = [row for row in left if not self._assemble(row)]
        return not self._pending

    def _is_current(self, row: PlannedRow, resume: bool) -> bool:
        try:
            result = store.load(self._path(row))
        except NewerFormatError:
            raise
        except ConfigError:  # missing or damaged
            return False
        if not resume or result.identity != row.identity or not self._is_valid(result):
            return False
        self._digests[self._path(row)] = content_digest(result)
        return True

    def _is_valid(self, result: Result) -> bool:
        seconds, memory = result.limits
        is_wider = seconds > self._limits.seconds or memory > self._limits.memory
        return result.failure is None and not is_wider

    def _assemble(self, row: PlannedRow) -> bool:
        """Write a row if all parts are stored; return whether it was written."""
        stored = [path for path in self._parts(row) if path in self._digests]
        # one failed part fails the row: the other conditions are not run then
        if len(stored) < len(row.parts) and not self._failed.intersection(stored):
            return False
        check_owners([row], self.out, self._replace)  # another run may have written it meanwhile
        merged = merge_parts([store.load_part(path) for path in stored], row.identity)
        self._digests[store.save(merged, self.out)] = content_digest(merged)
        return True

    def _path(self, row: PlannedRow) -> Path:
        return store.row_path(self.out, row.task.name, row.entry.name)

    def _parts(self, row: PlannedRow) -> list[Path]:
        return [store.part_path(self.out, part) for part in row.parts]


def _is_unchanged(path: Path, digest: str) -> bool:
    """Return whether `digest` is that of the reproducible content of a file."""
    with suppress(ConfigError):
        return digest == content_digest(store.read(path))
    return False


def make_jobs(missing: Iterable[tuple[PlannedRow, int]], workers: int, limits: Limits) -> list[Job]:
    """Return jobs for missing results, one condition each, the most expensive first.

    Entries of one condition share its drives; they are split into several jobs only if there would
    be fewer jobs than workers. Every second job has its entries in reverse order.
    """
    groups: dict[tuple[str, int, tuple[int, ...]], list[PlannedRow]] = {}
    for row, condition in missing:
        groups.setdefault((row.task.digest, condition, row.seeds), []).append(row)
    spread = math.ceil(workers / max(1, len(groups)))
    jobs = []
    for (_, condition, seeds), rows in groups.items():
        whole = Job(task=rows[0].task, condition=condition, entries=(), seeds=seeds, limits=limits)
        for k in range(min(spread, len(rows))):
            entries = tuple(row.entry for row in rows[k::spread])
            jobs.append(dataclasses.replace(whole, entries=entries))
    jobs.sort(key=_estimated_cost, reverse=True)
    # two jobs side by side seldom compile the same kernels at once if their orders are opposite
    return [
        dataclasses.replace(job, entries=job.entries[:: -1 if k % 2 else 1])
        for k, job in enumerate(jobs)
    ]


def _estimated_cost(job: Job) -> float:
    """Return the duration of the test drives times the entries [s/3.6], a proxy of run time."""
    condition = job.task.conditions[job.condition]
    metres = sum(road.length for _, road, _ in job.task.drives_of(job.task.test, condition))
    return len(job.entries) * metres / condition.speed_kmh
