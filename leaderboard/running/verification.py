"""Verification of a folder of results: a random share of its drives, run again and compared.

    <out>/definitions/<digest>.json   each task that was run, by the digest that its results name
    <out>/verified.json               how far rows are from what was found here

A drive is simulated, estimated and scored again with what a row names: task, entry, settings,
training seeds; all rows of a task on the same drives. A row of other code, or of another task,
cannot be run again, which is said instead.
"""

import dataclasses
import math
import os
import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.entries.entries import is_by_others, registered_entry
from leaderboard.entries.entry import Entry, EntryError, TrainingRun
from leaderboard.evaluation import comparison, evaluate, store
from leaderboard.evaluation.provenance import describe_environment
from leaderboard.evaluation.results import RUN, Result, content_digest
from leaderboard.evaluation.task_files import to_json_types, with_paths
from leaderboard.evaluation.tasks import Task, load_task
from leaderboard.evaluation.test_data import RecordedDrive, simulate_drives
from leaderboard.metrics.bootstrap import REPRODUCIBLE, interquartile_mean
from leaderboard.metrics.registry import SCORES
from leaderboard.sandbox.client import ONE_TRAINING
from leaderboard.sandbox.guest import MachineError
from leaderboard.sandbox.launch import twice
from leaderboard.sandbox.retest import NOT_CAUSAL, NOT_RETESTED, REMEMBERS
from road_envs.core.artifacts import Kind, NewerFormatError
from road_envs.core.atomic_io import exclusive_lock
from road_envs.core.config import ConfigError, Settings, build

_DEFINITION = Kind("task", 1)
_VERIFICATION = Kind("verification", 2)

SHARE = 0.1  # share of the drives of a task that are run again
_BY_CHANCE = (*NOT_CAUSAL, REMEMBERS, ONE_TRAINING)
"""What a judge may find out about an entry by chance, and not again."""

_DECIDE_DIGITS = ("numpy", "scipy", "numba", "torch", "processor", "blas")
"""Parts of the environment of a result that decide its last digits."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verified(Settings):
    """A row and what its drives had when they were run again on the machine `kernels`.

    `ranks_by` is the ranking score, by the word of the folder, of what was compared.
    `distance` is the largest of the `runs` (drives times training seeds), that of `score`,
    `typical` the median of the largest of each run, and `shift` that of the interquartile means of
    the ranking score, by which boards rank. With a `reason` the row was not run again or failed;
    where `is_false`, it says something else than was found on this `share` of the drives.
    """

    task: str
    estimator: str
    content: str = ""  # digest of the row
    ranks_by: str = ""
    kernels: str = ""
    tolerance: float = comparison.OTHER_KERNELS
    runs: int = 0
    score: str = ""
    distance: float = 0.0
    typical: float = 0.0
    shift: float = 0.0
    reason: str = ""
    is_false: bool = False
    share: float = 0.0
    drives: str = ""  # words on number, length and design that the shipped task has otherwise

    @property
    def compares_all(self) -> bool:
        """Whether all scores were compared, not those alone that kernels hardly move."""
        return self.tolerance <= comparison.SAME_KERNELS

    @property
    def agrees(self) -> bool:
        """Whether every run is within the tolerance, half of them far within, and their mean."""
        return self.runs > 0 and not self.reason and not self.is_far

    @property
    def is_far(self) -> str:
        """Words on the scores that are too far from those of the row; "" if none is.

        Any row can name another machine and have the wide tolerance: its mean may still move by no
        more than one run, whose weight is up to 2 / `runs`.
        """
        near = min(self.tolerance, REPRODUCIBLE)  # so no row is moved as a whole
        mean = near + 2.0 * self.tolerance / max(self.runs, 1)
        if self.distance > self.tolerance:
            return "more than the tolerance"
        if self.typical > near:
            return f"half of its runs by {self.typical:.1e} or more, of {near:.0e} allowed"
        return f"its mean by {self.shift:.1e}, of {mean:.0e} allowed" if self.shift > mean else ""


def kernels_of(environment: Mapping[str, str]) -> str:
    """Return processor and BLAS kernel of an environment, whose number of cores decides nothing."""
    processor = environment.get("processor", "unknown processor").rpartition(", ")
    return f"{processor[0] or processor[2]}, {environment.get('blas', 'unknown BLAS')}"


def save_definition(task: Task, out: Path) -> None:
    """Write a task under its digest, so that its results can be verified."""
    path = out / "definitions" / f"{task.digest}.json"
    if not path.exists():
        plain = with_paths(to_json_types(task), os.path.abspath)
        _DEFINITION.write(path, {"task": plain}, task.digest)


def _load_definitions(out: Path) -> tuple[list[Task], list[ConfigError]]:
    """Tasks of a folder of results, by name, and what is wrong with those that cannot be read."""
    tasks, errors = list[Task](), list[ConfigError]()
    for path in sorted((out / "definitions").glob("*.json")):
        try:
            data, _ = _DEFINITION.read(path)
            task = build(Task, data["task"], str(path))
            if task.digest != path.stem:
                raise ConfigError(
                    f"{path}: the task {task.name}, or a file that it names, is not the one that "
                    "was run; verify where it is"
                )
            if task.is_public:
                made, own = load_task(task.name), task.test  # as commands can make it
                if made.has_several_test_drives:
                    made = made if own.design else made.with_test_drives(own.number)
                    made = made.with_test_length(own.length) if own.length else made
                if task.digest != made.digest:
                    raise ConfigError(f"{path}: its {task.name} is not that of this package")
            tasks.append(task)
        except ConfigError as error:
            errors.append(error)
    return sorted(tasks, key=lambda task: (task.name, task.digest)), errors


def load_verified(out: Path) -> dict[str, list[Verified]]:
    """Verified rows of a folder, by the digest of their content; none if nothing was verified.

    Raises NewerFormatError, and ConfigError if its file is damaged: what was found false stays so.
    """
    path = out / "verified.json"
    by_row: dict[str, list[Verified]] = {}
    if not path.exists():
        return by_row
    try:
        data, _ = _VERIFICATION.read(path)
        rows = [build(Verified, row, str(path)) for row in data["rows"]]
    except NewerFormatError:
        raise
    except (ConfigError, LookupError, TypeError) as error:
        raise ConfigError(
            f"what `verify` found cannot be read, and is not overwritten: {error}; restore "
            f"{path}, or remove it to verify all rows anew"
        ) from None
    for row in rows:
        by_row.setdefault(row.content, []).append(row)
    return by_row


def save_verified(found: Iterable[Verified], out: Path) -> list[Verified]:
    """Add to what was verified in a folder, and return what is known of the `found` rows.

    What differed once on the same kernels does so for good: a part of the drives may agree. Raises
    ConfigError as `load_verified`, and then writes nothing.
    """
    known = []
    with exclusive_lock(out / ".verified.lock", math.inf):  # another command may end now
        rows = {(x.content, x.kernels): x for old in load_verified(out).values() for x in old}
        for row in found:
            key, was_run = (row.content, row.kernels), row.is_false or not row.reason
            if was_run and not (key in rows and _outweighs(rows[key], row)):
                rows[key] = row
            known.append(row if row.reason or row.is_false or rows[key].agrees else rows[key])
        content = {"rows": [dataclasses.asdict(row) for row in rows.values()]}
        _VERIFICATION.write(out / "verified.json", content)
    return known


def _outweighs(earlier: Verified, row: Verified) -> bool:
    """Whether what was found of a row before stands against what was found now."""
    if earlier.is_false:  # on as many drives it would be found again, if it was not by chance
        return earlier.share > row.share
    if earlier.agrees != row.agrees:
        return row.agrees
    return earlier.ranks_by == row.ranks_by and earlier.runs > row.runs


def verify_folder(
    out: Path,
    run: evaluate.EntryRunner,
    entries: Sequence[Entry] = (),
    *,
    tasks: Sequence[Task] | None = None,
    share: float = SHARE,
    seed: int | None = None,
    limits: tuple[float, float] = (math.inf, math.inf),
    simulate: Callable[..., Iterator[RecordedDrive]] = simulate_drives,
    report: Callable[[str, float], None] = lambda text, share: None,
) -> list[Verified]:
    """Run a random `share` of the drives of each of `tasks` again, with all its rows under `out`.

    The tasks are by default those that `out` defines. `entries` are those of other packages;
    `limits` [s], [GiB] those of `run`, within which a row of wider ones is not false if it fails;
    `report` is called with each step as it begins and the share of the rows that are done. Raises
    ConfigError if there is nothing to be verified.
    """
    tasks, unread = _load_definitions(out) if tasks is None else (tasks, [])
    stored = [(task, row) for task in tasks for row in store.load_rows(out, task)]
    rows = [(task, row) for task, row in stored if row.task_digest == task.digest]
    given = {entry.name: entry for entry in entries}
    if not rows:
        raise [*unread, ConfigError(f"{out}: no results with the task that they were made with")][0]
    known, current = {task.name for task in tasks}, {row.identity for _, row in rows}
    others = {row.identity: (task, row) for task, row in stored if row.identity not in current}
    found = [_without_runs(*x, "it is of another task than defined here") for x in others.values()]
    why = f"its task is not defined here{''.join(f', and {error}' for error in unread[:1])}"
    for file in sorted((out / "results").glob("*/[!.]*.json")):
        if file.parent.name not in known:
            found.append(Verified(task=file.parent.name, estimator=file.stem, reason=why))
    rng = np.random.default_rng(seed)
    for task in tasks:
        drives = sorted({(label, drive) for label, drive, _ in _drives(task)})
        count = math.ceil(share * len(drives))
        chosen = {drives[k] for k in rng.choice(len(drives), count, replace=False)}
        data = {}
        for condition in task.conditions:
            if picked := {drive for label, drive in chosen if label == condition.label}:
                report(f"{task.name}: simulating, {condition.label}", len(found) / len(rows))
                some = partial(simulate, chosen=picked)
                data[condition] = evaluate.simulate_condition(task, condition, some)
        for row in [row for known, row in rows if known is task]:
            name = row.estimator
            report(f"{task.name}: {name}", len(found) / len(rows))
            entry = given.get(name) or registered_entry(name, task.trains_on_test_road)
            if entry is None:
                unknown = "not of this package: give it with --estimator"
                found.append(_without_runs(task, row, row.stale_reason(task) or unknown))
            elif reason := entry.failure or row.stale_reason(task, entry):
                found.append(_without_runs(task, row, reason))
            else:
                wider = "; its row was made within {:g} s, {:g} GiB".format(*row.limits)
                wider = wider if any(np.less(limits, row.limits)) else ""
                how = run if row.failure else partial(_run_twice, run, wider)
                again = (
                    evaluate.evaluate_entry(task, *x, entry, row.seeds, how) for x in data.items()
                )
                try:
                    if row.failure is None:
                        now = _verify_row(task, row, entry, again)
                    else:
                        now = _verify_failure(task, row, again, count)
                except ConfigError as error:
                    now = _without_runs(task, row, str(error))
                found.append(dataclasses.replace(now, share=count / len(drives)))
    return found


def _run_twice(run: evaluate.EntryRunner, wider: str, *asked: Any) -> list[TrainingRun]:
    """Run an entry once or twice. Raises EntryError; ConfigError if machine or limits excuse it."""
    excused = EntryError if wider else MachineError
    try:
        return twice(lambda: [*run(*asked)])
    except excused as error:
        raise ConfigError(f"{error}{wider}") from None


def _verify_row(task: Task, row: Result, entry: Entry, again: Iterable[Result]) -> Verified:
    """Run an entry again on the drives of each condition and compare with its row."""
    found = _without_runs(task, row)
    if reason := other_drives(row, task) or _other_seeds(row):
        return dataclasses.replace(found, reason=reason, is_false=True)
    stored = comparison.scores_by_run(row.scores)
    ranks_by = found.ranks_by
    some = [ranks_by, "bound_nrmse", "attainable_nrmse"]  # the last two are of all rows
    compared = SCORES if found.compares_all else some
    pairs: list[tuple[dict[str, float], dict[str, float]]] = []
    ranked: list[tuple[float, float]] = []
    notes, busy = {*_not_retested(row), *(f"{row.estimator}: {x}" for x in _BY_CHANCE)}, ""
    for made in again:
        if made.failure is not None:  # ours may lack a library here
            return dataclasses.replace(found, reason=made.failure, is_false=is_by_others(entry))
        busy = busy or "".join(_not_retested(made)[: not _not_retested(row)])
        if reason := _other_claim(row, made):
            return dataclasses.replace(found, reason=reason, is_false=True)
        notes.update(made.notes)
        own = comparison.scores_by_run(made.scores)
        driven = {x[:-1] for x in own}  # of which the row may have runs of further seeds
        if len(own) == len(driven):  # on these drives no training seed changes anything
            by_drive = {x[:-1]: scores for x, scores in own.items()}
            own |= {x: by_drive[x[:-1]] for x in stored if x[:-1] in driven}
        here = [(stored.get(x, {}), own.get(x, {})) for x in stored | own if x[:-1] in driven]
        pairs += here
        both = [(a[ranks_by], b[ranks_by]) for a, b in here if ranks_by in a and ranks_by in b]
        ranked += both * (len(row.seeds) if len(own) == len(driven) else 1)  # as on a board
    if (more := [note for note in row.notes if note not in notes]) and len(pairs) >= len(stored):
        reason = f"its note is not found here: {more[0]}"
        return dataclasses.replace(found, reason=reason, is_false=True)
    if not pairs:
        return found
    distances = [comparison.largest_distance(row, own, compared) for row, own in pairs]
    worst = max(distances, key=lambda x: x.value)
    means = interquartile_mean(np.array(ranked).reshape(-1, 2), axis=0)
    found = dataclasses.replace(
        found, runs=len(pairs), score=worst.score, distance=worst.value,
        typical=statistics.median_low([x.value for x in distances]),
        shift=comparison.distance(ranks_by, *means.tolist()) if ranked else 0.0,
    )  # fmt: skip
    return dataclasses.replace(found, reason=busy) if busy and found.agrees else found


def _verify_failure(task: Task, row: Result, again: Iterable[Result], count: int) -> Verified:
    """Run an entry on `count` drives whose row says that it failed; on others it may have."""
    found = _without_runs(task, row, f"failed: {row.failure}")
    if not count or any(made.failure is not None for made in again):
        return found
    reason = f"it does not fail on these drives; its row says: {row.failure}"
    return dataclasses.replace(found, reason=reason, is_false=count == len(_drives(task)))


def _drives(task: Task) -> set[tuple[str, int, int]]:
    """Return condition, index and seed of the road of each test drive of a task."""
    return {
        (condition.label, index, seed)
        for condition in task.conditions
        for index, _, seed in task.drives_of(task.test, condition)
    }


def other_drives(row: Result, task: Task) -> str | None:
    """Return why drives or traces of a row are not those of its task; None if they are."""
    if [trace.condition for trace in row.traces] != [x.label for x in task.conditions]:
        return "it has not one trace of each condition"
    table = row.scores[list(RUN)].drop_duplicates().drop(columns="road")  # one road for each run
    seeds = table.groupby("condition", observed=True)["seed"].unique()  # of some, one may do
    runs = sorted(table.itertuples(index=False, name=None))
    expected = sorted((*run, seed) for run in _drives(task) for seed in seeds.get(run[0], [0]))
    if runs != expected or row.scores.duplicated([*RUN, "score"]).any():
        return "its drives are not those of its task, once with each training seed"
    order = [x.label for x in task.conditions if x.label in seeds]  # boards take them by places
    in_order = table["condition"].unique().tolist() == order
    return None if in_order else "its conditions are not in the order of its task"


def _other_seeds(row: Result) -> str | None:
    """Return which training seeds a row was made with that no board chooses; None if it has not."""
    if row.seeds and row.seeds == tuple(range(1, len(row.seeds) + 1)):
        return None
    if not row.seeds:
        return "it has no training seeds"
    return f"its training seeds are {', '.join(map(str, row.seeds))}, not 1 to {len(row.seeds)}"


def _other_claim(row: Result, made: Result) -> str | None:
    """Return what a row says otherwise of its entry than was found; None if nothing.

    That it looks ahead may have been found by chance, and that it could not be asked again, here
    or there.
    """
    said = _not_retested(row) or {f"{row.estimator}: {x}" for x in NOT_CAUSAL} & set(row.notes)
    chance = row.causal is False if said else bool(_not_retested(made))
    for name in ("role", "causal", "lag", "calibrates", "code", "settings"):
        if getattr(row, name) != getattr(made, name) and not (name == "causal" and chance):
            return f"its {name} is {getattr(made, name)}, the row says {getattr(row, name)}"
    one = f"{row.estimator}: {ONE_TRAINING}"  # of these drives
    known = {*row.notes, *_not_retested(made), one}
    missing = [note for note in made.notes if note not in known]
    return f"it lacks the note: {missing[0]}" if missing else None


def _not_retested(row: Result) -> list[str]:
    """Return the notes of a row that it could not be asked again, each with its reason."""
    begins = f"{row.estimator}: {NOT_RETESTED}: "
    notes = row.notes if row.role == "entry" else ()
    return [note for note in notes if note.startswith(begins) and ";" not in note]


@lru_cache(maxsize=1)
def _unlike_shipped(task: Task) -> str:
    """Return in words what differs from the shipped task of this name; "" if nothing does."""
    own, names = vars(task.test), ("number", "length", "design")
    shipped = vars(load_task(task.name).test) if task.is_public else own
    return ", ".join(f"{x} {own[x] or 'not given'}" for x in names if own[x] != shipped[x])


def _without_runs(task: Task, row: Result, reason: str = "") -> Verified:
    here = describe_environment()
    same = all(row.environment.get(name) == here.get(name) for name in _DECIDE_DIGITS)
    return Verified(
        task=task.name, estimator=row.estimator, content=content_digest(row), reason=reason,
        ranks_by=task.board_definition.ranks_by, kernels=kernels_of(here),
        tolerance=comparison.SAME_KERNELS if same else comparison.OTHER_KERNELS,
        drives=_unlike_shipped(task),
    )  # fmt: skip
