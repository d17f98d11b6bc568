"""From what is wanted to jobs, and from stored parts to the rows of a board."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from leaderboard import store
from leaderboard.entry import Entry
from leaderboard.isolation.limits import Limits
from leaderboard.jobs import Done, Job, identity
from leaderboard.results import together
from leaderboard.store import NewerFormatError
from leaderboard.tasks import Task
from road_envs.config import ConfigError


@dataclass(frozen=True, eq=False)
class Row:
    """A row that a run is to leave on the board."""

    task: Task
    entry: Entry
    seeds: tuple[int, ...]

    @cached_property
    def identity(self) -> str:
        """Of the whole row."""
        return identity(self.task, None, self.entry, self.seeds)

    @cached_property
    def parts(self) -> tuple[str, ...]:
        """Identities of its parts, one for each condition."""
        conditions = range(len(self.task.conditions))
        return tuple(identity(self.task, k, self.entry, self.seeds) for k in conditions)


class Plan:
    """Which rows stand, which parts are there, and what is left to be run.

    It remembers the checksum of every file that it relies on, so that one that somebody changes
    while entries run is found.
    """

    def __init__(self, rows: Sequence[Row], out: Path, resume: bool):
        """Raises NewerFormatError if a row would take the place of one that cannot be read here."""
        self.rows, self.out = rows, out
        self._relied: dict[Path, str] = {}
        self._here: dict[str, bool] = {}  # parts by identity; whether they hold a failure
        self._standing = {row for row in rows if self._stands(row, resume)}
        for row in self.open_rows() if resume else []:
            for part in row.parts:
                self._find(part)

    def open_rows(self) -> list[Row]:
        """Rows that are not on the board yet, or not any more."""
        return [row for row in self.rows if row not in self._standing]

    def missing(self) -> list[tuple[Row, int]]:
        """Conditions of rows that have to be run."""
        return [
            (row, k)
            for row in self.open_rows()
            for k, part in enumerate(row.parts)
            if part not in self._here
        ]

    def note(self, done: Done) -> None:
        """Remember a part that was run."""
        self._here[done.identity] = done.failure is not None
        self._relied[store.part_of(self.out, done.identity)] = done.checksum

    def settle(self) -> list[Row]:
        """Put rows together and write them; those for which something is missing are left open.

        Files that are not what they were are forgotten, and what stands on them is open again.
        """
        changed = {path for path, told in self._relied.items() if store.checksum(path) != told}
        for row in list(self._standing):
            if self._path(row) in changed:
                self._standing.discard(row)
        for row in self.open_rows():
            parts = [store.part_of(self.out, part) for part in row.parts if part in self._here]
            for path in changed.intersection(parts):
                del self._here[path.stem]
            if self._complete(row):
                self._write(row)
        for path in changed:
            self._relied.pop(path, None)
        return self.open_rows()

    def _stands(self, row: Row, resume: bool) -> bool:
        path = self._path(row)
        try:
            result, told = store.load_checked(path)
        except NewerFormatError:
            raise
        except ConfigError:  # none there, or none that is worth keeping
            return False
        if not resume or result.identity != row.identity or result.failure is not None:
            return False
        self._relied[path] = told
        return True

    def _find(self, part: str) -> None:
        path = store.part_of(self.out, part)
        try:
            result = store.load_part(path)
        except ConfigError:
            return
        if result.failure is None:
            self._here[part] = False
            self._relied[path] = store.checksum(path) or ""

    def _complete(self, row: Row) -> bool:
        """Whether all parts are there, or one with a failure: the rest is not run then."""
        here = [self._here[part] for part in row.parts if part in self._here]
        return any(here) or len(here) == len(row.parts)

    def _write(self, row: Row) -> None:
        parts = [
            store.load_part(store.part_of(self.out, part))
            for part in row.parts
            if part in self._here
        ]
        path = store.save(together(parts, row.identity), self.out)
        self._relied[path] = store.checksum(path) or ""
        self._standing.add(row)

    def _path(self, row: Row) -> Path:
        return store.path_of(self.out, row.task.name, row.entry.name)


def jobs_of(missing: Iterable[tuple[Row, int]], workers: int, limits: Limits) -> list[Job]:
    """Jobs for what has to be run: a condition each, the longest first.

    Entries of one condition share its drives; they are spread over several jobs only where there
    would be fewer jobs than workers.
    """
    groups: dict[tuple[str, int, tuple[int, ...]], list[Row]] = {}
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
    return sorted(found, key=_effort, reverse=True)


def _effort(job: Job) -> float:
    """Metres to be estimated, which is about what a job costs."""
    return len(job.entries) * sum(road.length for road, _ in job.task.test.pairs)
