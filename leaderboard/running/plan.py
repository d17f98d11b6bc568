"""From what is wanted to jobs, and from stored parts to the rows of a board."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from leaderboard.evaluation import store
from leaderboard.evaluation.entry import Entry
from leaderboard.evaluation.results import content_digest, merge_parts
from leaderboard.evaluation.store import NewerFormatError
from leaderboard.evaluation.tasks import Task
from leaderboard.running.jobs import Job, JobDone, result_identity
from leaderboard.sandbox.limits import Limits
from road_envs.config import ConfigError


@dataclass(frozen=True, eq=False)
class PlannedRow:
    """A row that a run is to leave on the board."""

    task: Task
    entry: Entry
    seeds: tuple[int, ...]

    @cached_property
    def identity(self) -> str:
        """Of the whole row."""
        return result_identity(self.task, None, self.entry, self.seeds)

    @cached_property
    def parts(self) -> tuple[str, ...]:
        """Identities of its parts, one for each condition."""
        conditions = range(len(self.task.conditions))
        return tuple(result_identity(self.task, k, self.entry, self.seeds) for k in conditions)


class Plan:
    """Which rows stand, which parts are there, and what is left to be run.

    Entries that are not kept in by namespaces could change what is stored while they run. So the
    plan remembers what it has seen or been told, and looks again before it relies on it.
    """

    def __init__(self, rows: Sequence[PlannedRow], out: Path, resume: bool):
        """Raises NewerFormatError if a row would take the place of one that cannot be read here."""
        self.rows, self.out = rows, out
        self._known: dict[Path, str] = {}  # rows and parts: content, or checksum of the file
        self._failed: set[str] = set()  # parts that hold a failure
        self._may_be_altered = False
        self._pending = [row for row in rows if not self._is_current(row, resume)]
        for row in self._pending if resume else []:
            for part in row.parts:
                self._find_part(part)

    def missing(self) -> list[tuple[PlannedRow, int]]:
        """Conditions of rows that have to be run."""
        return [
            (row, k)
            for row in self._pending
            for k, part in enumerate(row.parts)
            if self._part_path(part) not in self._known
        ]

    def record_part(self, done: JobDone) -> None:
        """Remember a part that was run."""
        self._known[self._part_path(done.identity)] = done.content_digest
        self._may_be_altered |= done.isolation != "namespaces"
        if done.failure is not None:
            self._failed.add(done.identity)

    def assemble_rows(self) -> bool:
        """Put rows together and write them; False if there is more to be run.

        What is no longer what it was is forgotten, and has to be run again.
        """
        if self._may_be_altered:
            for path in [
                path for path, told in self._known.items() if not _is_unchanged(path, told)
            ]:
                del self._known[path]
        left = [
            row
            for row in self.rows
            if row in self._pending or self._row_path(row) not in self._known
        ]
        self._pending = [row for row in left if not self._assemble(row)]
        return not self._pending

    def _is_current(self, row: PlannedRow, resume: bool) -> bool:
        path = self._row_path(row)
        try:
            result, told = store.load_with_checksum(path)
        except NewerFormatError:
            raise
        except ConfigError:  # none there, or none that is worth keeping
            return False
        if not resume or result.identity != row.identity or result.failure is not None:
            return False
        self._known[path] = told
        return True

    def _find_part(self, part: str) -> None:
        path = self._part_path(part)
        try:
            result = store.load_part(path)
        except ConfigError:
            return
        if result.failure is None:
            self._known[path] = content_digest(result)

    def _assemble(self, row: PlannedRow) -> bool:
        """Put a row together if all parts are there, or one with a failure: then no more is run."""
        here = [part for part in row.parts if self._part_path(part) in self._known]
        if len(here) < len(row.parts) and not self._failed.intersection(here):
            return False
        parts = [store.load_part(self._part_path(part)) for part in here]
        whole = merge_parts(parts, row.identity)
        self._known[store.save(whole, self.out)] = content_digest(whole)
        return True

    def _row_path(self, row: PlannedRow) -> Path:
        return store.row_path(self.out, row.task.name, row.entry.name)

    def _part_path(self, identity: str) -> Path:
        return store.part_path(self.out, identity)


def _is_unchanged(path: Path, known: str) -> bool:
    """Whether a file has the content, or the checksum, that it was known by."""
    try:
        result, told = store.read_with_checksum(path)
    except ConfigError:
        return False
    return known in (told, content_digest(result))


def make_jobs(missing: Iterable[tuple[PlannedRow, int]], workers: int, limits: Limits) -> list[Job]:
    """Jobs for what has to be run: a condition each, the longest first, every second one with its
    entries from the last to the first.

    Entries of one condition share its drives; they are spread over several jobs only where there
    would be fewer jobs than workers.
    """
    groups: dict[tuple[str, int, tuple[int, ...]], list[PlannedRow]] = {}
    for row, condition in missing:
        groups.setdefault((row.task.digest, condition, row.seeds), []).append(row)
    spread = math.ceil(workers / max(1, len(groups)))
    found = []
    for (_, condition, seeds), rows in groups.items():
        for k in range(min(spread, len(rows))):
            chosen = tuple(row.entry for row in rows[k::spread])
            found.append(
                Job(
                    task=rows[0].task,
                    condition=condition,
                    entries=chosen,
                    seeds=seeds,
                    limits=limits,
                )
            )
    found.sort(key=_estimated_cost, reverse=True)
    return [_reversed(job) if k % 2 else job for k, job in enumerate(found)]


def _reversed(job: Job) -> Job:
    """The job with its entries in the other order: side by side with one that has them in this
    order it seldom compiles the same kernels at the same time.
    """
    return dataclasses.replace(job, entries=job.entries[::-1])


def _estimated_cost(job: Job) -> float:
    """Seconds of driving to be explained, which is about what a job costs."""
    metres = sum(road.length for road, _ in job.task.test.roads_and_seeds)
    return len(job.entries) * metres / job.task.conditions[job.condition].speed_kmh
