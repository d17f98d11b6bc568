"""A board: tasks, and what is stored about them. Runs what is missing, reads what is there."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from estimators import create
from estimators.protocol import Estimator
from leaderboard.drives import DriveSource, simulated
from leaderboard.environment import code
from leaderboard.evaluate import SEEDS, Entries, run_task, settings_of, steps
from leaderboard.results import Result, load, load_all, path_of, save
from leaderboard.sentinels import SENTINELS, TRUTH_PLUS_NOISE
from leaderboard.tasks import Task

Progress = Callable[[int, int, str], None]
"""Hears of each step as it begins: steps done, steps in all, and what is being done now."""


@dataclass(frozen=True)
class Board:
    """Tasks in order, and all stored results of each, fresh, failed and stale."""

    tasks: tuple[Task, ...]
    results: Mapping[str, Sequence[Result]]

    def scored(self, task: Task) -> list[Result]:
        """The results that count: they belong to the task as it is, and did not fail."""
        return [r for r in self._fresh(task) if r.failure is None]

    def failed(self, task: Task) -> list[Result]:
        """Fresh results of estimators that failed."""
        return [r for r in self._fresh(task) if r.failure is not None]

    def stale(self, task: Task) -> list[tuple[Result, str]]:
        """Results of another task, package or metric version, each with the reason."""
        stale = [(r, r.stale(task)) for r in self.results[task.name]]
        return [(r, why) for r, why in stale if why is not None]

    def _fresh(self, task: Task) -> list[Result]:
        return [r for r in self.results[task.name] if r.stale(task) is None]


def load_board(tasks: Sequence[Task], out: Path) -> Board:
    """The board of what is stored under `out`. Raises ConfigError for a damaged file."""
    return Board(tuple(tasks), {task.name: load_all(out, task.name) for task in tasks})


def run_board(
    tasks: Sequence[Task],
    entries: Mapping[str, Estimator],
    out: Path,
    *,
    roads: int | None = None,
    seeds: Sequence[int] = SEEDS,
    resume: bool = False,
    drive: DriveSource = simulated,
    progress: Progress = lambda done, total, text: None,
) -> Board:
    """Evaluate `entries` (name: estimator) and the sentinels on `tasks`, store under `out`, and
    return the board of everything stored there.

    `roads` is the number of test drives per condition on tasks that draw their roads; `resume`
    keeps stored results of the same task, code, settings and seeds. Raises ConfigError, before
    anything is run, if a stored result that is to stay cannot be read.
    """
    tasks = [task.with_roads(roads) if roads and task.draws_roads else task for task in tasks]
    everyone: Entries = {**entries, **sentinels()}
    wanted = {
        task.name: {
            name: e
            for name, e in everyone.items()
            if not (resume and _stored(task, name, e, seeds, out))
        }
        for task in tasks
    }
    for task in tasks:
        for path in (out / "results" / task.name).glob("*.json"):
            if path.stem not in wanted[task.name]:
                load(path)
    total = sum(steps(task, wanted[task.name]) for task in tasks)
    done = 0

    def report(text: str) -> None:
        nonlocal done
        progress(done, total, text)
        done += 1

    for task in filter(lambda task: wanted[task.name], tasks):
        for result in run_task(task, wanted[task.name], seeds, drive=drive, report=report):
            save(result, out)
    return load_board(tasks, out)


def sentinels() -> dict[str, Estimator | None]:
    """The marks that stand on every board."""
    return {name: None if name == TRUTH_PLUS_NOISE else create(name) for name in SENTINELS}


def _stored(
    task: Task, name: str, estimator: Estimator | None, seeds: Sequence[int], out: Path
) -> bool:
    """Whether a result of the same task, versions, code, settings and seeds is there to keep."""
    path = path_of(out, task.name, name)
    if not path.exists():
        return False
    result = load(path)
    return (
        result.stale(task) is None
        and result.failure is None
        and result.seeds == tuple(seeds)
        and json.dumps(result.settings) == json.dumps(settings_of(estimator), default=str)
        and result.environment.get("code") == code()
    )
