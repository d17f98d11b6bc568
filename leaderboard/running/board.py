"""Boards: tasks with their stored results; runs missing results and loads stored ones."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from leaderboard.conformance.results import EstimatorCard, card_identity, find_card, probe_entries
from leaderboard.entries.entries import entry_refit_per_case, registered_entry
from leaderboard.entries.entry import Entry
from leaderboard.evaluation.evaluate import SEEDS
from leaderboard.evaluation.results import Result
from leaderboard.evaluation.store import load_rows
from leaderboard.evaluation.tasks import Task
from leaderboard.method_card import MethodCard, find_method_card
from leaderboard.metrics.baselines import ALL_BASELINES, BASELINES
from leaderboard.running.executors import Executor
from leaderboard.running.jobs import to_packed_text
from leaderboard.running.plan import Plan, PlannedRow, make_jobs
from leaderboard.running.verification import Verified, load_verified, other_drives, save_definition
from leaderboard.sandbox.limits import Limits
from road_envs.core.atomic_io import copy_file, remove_stale_partials, remove_stale_temp, write_text
from road_envs.core.config import ConfigError


@dataclass(frozen=True)
class RunRequest:
    """Request to evaluate `entries` and the baselines on each of `tasks`.

    `roads` is the number of test drives per condition on tasks that draw their roads; `resume`
    keeps stored results whose inputs have not changed; `probes` requests a card of each entry;
    `replace` names entries from outside whose stored rows of other code may be replaced.
    """

    tasks: Sequence[Task]
    entries: Sequence[Entry]
    seeds: Sequence[int] = SEEDS
    roads: int | None = None
    resume: bool = True
    limits: Limits = field(default_factory=Limits)
    probes: bool = False
    replace: tuple[str, ...] = ()

    def sized_tasks(self) -> list[Task]:
        """Return the tasks with the requested number of roads.

        Raises ConfigError if there are fewer, or if two tasks have one name.
        """
        names, n = [task.name for task in self.tasks], self.roads
        if twice := [name for name in names if names.count(name) > 1]:
            raise ConfigError(f"two tasks are named {twice[0]}: name one differently")
        return [
            task.with_test_drives(n) if n and task.has_several_test_drives else task
            for task in self.tasks
        ]

    def rows(self) -> list[PlannedRow]:
        """Return the rows of every entry on every task. Raises ConfigError."""
        rows = []
        for task in self.sized_tasks():
            refits = task.trains_on_test_road
            entries = [entry_refit_per_case(x) if refits else x for x in self.entries]
            baselines = [registered_entry(name, refits) for name in baseline_names(task)]
            rows += [PlannedRow(task, x, tuple(self.seeds)) for x in [*entries, *baselines] if x]
        return rows


ATTEMPTS = 3  # to make results while another process changes them


@dataclass(frozen=True)
class Board:
    """Tasks in order with all their stored results: scored, failed and stale.

    `entries` are the current versions of the entries by task and name; `cards` are by identity,
    what was `verified` by the identity of the row, the authors' cards of `methods` by name.
    """

    tasks: tuple[Task, ...]
    results: Mapping[str, Sequence[Result]]
    entries: Mapping[tuple[str, str], Entry] = field(default_factory=dict)
    cards: Mapping[str, EstimatorCard] = field(default_factory=dict)
    verified: Mapping[str, Sequence[Verified]] = field(default_factory=dict)
    methods: Mapping[str, MethodCard] = field(default_factory=dict)
    limits: Limits = field(default_factory=Limits)  # of a run; what failed within less is stale

    def scored(self, task: Task) -> list[Result]:
        """Return the current results of a task that have scores."""
        return [r for r in self._fresh(task) if r.failure is None]

    def failed(self, task: Task) -> list[Result]:
        """Return the current results of a task that failed."""
        return [r for r in self._fresh(task) if r.failure is not None]

    def stale(self, task: Task) -> list[tuple[Result, str]]:
        """Return results of another task, package, code or metric version, with the reasons."""
        reasons = [(r, self.stale_reason(task, r)) for r in self.results[task.name]]
        return [(r, reason) for r, reason in reasons if reason is not None]

    def stale_reason(self, task: Task, result: Result) -> str | None:
        """Return why a result cannot be compared with current ones; None if it can."""
        key = task.name, result.estimator
        reason = result.stale_reason(task, self.entries.get(key)) or self._other_drives[key]
        seconds, memory = result.limits
        is_narrower = 0 < seconds < self.limits.seconds or 0 < memory < self.limits.memory
        if reason is None and result.failure is not None and is_narrower:
            return f"failed within narrower limits: {seconds:g} s, {memory:g} GiB"
        return reason

    @cached_property
    def _other_drives(self) -> dict[tuple[str, str], str | None]:
        """Why the drives of a result are not those of its task, by task and estimator."""
        return {
            (task.name, row.estimator): other_drives(row, task) if row.failure is None else None
            for task in self.tasks
            for row in self.results[task.name]
        }

    def card(self, result: Result) -> EstimatorCard | None:
        """Return the card of the estimator of a result, if it was probed."""
        return self.cards.get(card_identity(result))

    def _fresh(self, task: Task) -> list[Result]:
        return [r for r in self.results[task.name] if self.stale_reason(task, r) is None]


def load_board(tasks: Sequence[Task], out: Path, rows: Sequence[PlannedRow] = ()) -> Board:
    """Load the board stored under `out`; an unreadable file becomes a failed row.

    Results are compared with the current entries in `rows` and with those of this package. Raises
    ConfigError if what was verified cannot be read.
    """
    results = {task.name: load_rows(out, task) for task in tasks}
    entries = {(row.task.name, row.entry.name): row.entry for row in rows}
    stored = [(task, result) for task in tasks for result in results[task.name]]
    for task, result in stored:
        key = task.name, result.estimator
        if key not in entries and (entry := registered_entry(key[1], task.trains_on_test_road)):
            entries[key] = entry
    identities = {card_identity(result) for _, result in stored}
    cards = {x: found for x in identities if (found := find_card(out, x))}
    names = {result.estimator for _, result in stored}
    methods = {name: card for name in names if (card := find_method_card(out, name))}
    return Board(tuple(tasks), results, entries, cards, load_verified(out), methods)


def run_board(
    request: RunRequest,
    out: Path,
    executor: Executor,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Board:
    """Run the missing results of a request, store them under `out` and return the whole board.

    `progress` takes a description of the last stored result and the share of them that are done.
    Failed results are run again. Raises ConfigError if a file of a newer version or the row of
    another entry would have to be replaced, before anything is run, and the exceptions of the
    executor.
    """
    remove_stale_partials(out)
    remove_stale_temp()
    rows = request.rows()
    plan = Plan(rows, out, request.limits, request.resume, request.replace)
    for task in request.sized_tasks():
        save_definition(task, out)
    if request.probes:
        entries = [row.entry for row in rows]
        probe_entries(entries, out, request.limits, lambda text: progress(text, 0.0))
    for _ in range(ATTEMPTS):
        jobs = make_jobs(plan.missing(), executor.workers, request.limits)
        total = sum(len(job.entries) for job in jobs)
        progress("starting", 0.0)
        for k, done in enumerate(executor.run(jobs, out), start=1):
            plan.record_part(done)
            progress(f"{done.task}: {done.entry}, {done.condition}", k / total)
        if plan.assemble_rows():
            board = load_board(request.sized_tasks(), out, rows)
            stored = {result.identity for own in board.results.values() for result in own}
            if all(row.identity in stored for row in rows):  # else another run has replaced one
                return replace(board, limits=request.limits)
    raise ConfigError(
        f"{out}: another process changed the files of this run in {ATTEMPTS} attempts; "
        "use a folder of its own"
    )


def write_jobs(request: RunRequest, out: Path, folder: Path) -> int:
    """Write a job file for each missing result, with copies of what the jobs need.

    Return the number of jobs.
    """
    rows = request.rows()
    plan = Plan(rows, out, request.limits, request.resume, request.replace)
    missing = plan.missing()
    for k, job in enumerate(make_jobs(missing, len(missing) ** 2, request.limits)):
        text, sources = to_packed_text(job)
        for name, source in sources.items():
            if not (folder / name).exists():
                copy_file(source, folder / name)
        write_text(folder / f"{k}.json", text)
    return len(missing)


def baseline_names(task: Task) -> tuple[str, ...]:
    """Return the baselines of a task: `memory` where it trains on its test road."""
    return ALL_BASELINES if task.trains_on_test_road else BASELINES
