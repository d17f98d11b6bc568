"""A job: some entries on one condition of one task; from a file with all that it depends on to
results in the store. It can be run anywhere, any number of times, in any order.

    road-recon run-job spec.json --out FOLDER

The process that runs it is the judge: it drives, keeps the truth, has every entry run in a process
of its own, scores, and writes what came of it. On standard output it says what it has done, one
JSON a line.
"""

import dataclasses
import hashlib
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import estimators
from leaderboard.evaluation import evaluate, store
from leaderboard.evaluation.code_version import evaluation_version
from leaderboard.evaluation.entry import Entry, TrainingRun
from leaderboard.evaluation.evaluate import (
    ConditionData,
    EntryRunner,
    evaluate_entry,
    simulate_condition,
)
from leaderboard.evaluation.provenance import package_version
from leaderboard.evaluation.results import FORMAT, Result, content_digest
from leaderboard.evaluation.tasks import Task
from leaderboard.evaluation.test_data import DriveSimulation, simulate_drives
from leaderboard.metrics import heights
from leaderboard.sandbox import processes
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs._atomic_io import remove_stale_temp
from road_envs.config import STRICT, ConfigError, build
from road_envs.roads import KINDS

BUILTIN_CACHE = "ours"
"""Cache of kernels that the estimators of this package share; every guest has one of its own."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """Entries that are judged on the same drives."""

    __pydantic_config__ = STRICT

    task: Task
    condition: int
    entries: tuple[Entry, ...]
    seeds: tuple[int, ...]
    limits: Limits = field(default_factory=Limits)
    task_digest: str = ""
    judge: str = ""  # version of the code that planned it


@dataclass(frozen=True, kw_only=True)
class JobDone:
    """A result that now stands in the store."""

    __pydantic_config__ = STRICT

    identity: str
    task: str
    entry: str
    condition: str
    content_digest: str  # a digest of it
    isolation: str
    failure: str | None = None


def result_identity(task: Task, condition: int | None, entry: Entry, seeds: Sequence[int]) -> str:
    """Digest of all that a result depends on; of a whole row where `condition` is None."""
    known = {
        "format": FORMAT,
        "task": task.digest,
        "condition": None if condition is None else task.conditions[condition].label,
        "entry": [entry.name, entry.reference, entry.settings, entry.code],
        "seeds": list(seeds),
        "package": package_version(),
        "metrics": heights.VERSION,
        "judge": evaluation_version(),
    }
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()[:32]


def to_text(job: Job) -> str:
    """The file of a job."""
    known = dataclasses.replace(job, task_digest=job.task.digest, judge=evaluation_version())
    return json.dumps(_to_json_types(known), indent=1) + "\n"


def from_text(text: str, where: str) -> Job:
    """A job from its file. Raises ConfigError, also if it was planned for another version."""
    try:
        data = json.loads(text)
    except ValueError as error:
        raise ConfigError(f"{where}: damaged, not valid JSON: {error}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: not a job")
    job = build(Job, data, where)
    if not 0 <= job.condition < len(job.task.conditions):
        raise ConfigError(f"{where}: {job.task.name} has no condition {job.condition}")
    if job.judge != evaluation_version():
        raise ConfigError(f"{where}: planned by other code than this; plan it again")
    if job.task_digest != job.task.digest:
        raise ConfigError(f"{where}: {job.task.name} is another task here, or lacks its files")
    return job


def run_job(
    job: Job, out: Path, run: EntryRunner, drive: DriveSimulation = simulate_drives
) -> Iterator[JobDone]:
    """Judge the entries of a job one by one, and store what comes of each. Raises ConfigError."""
    condition = job.task.conditions[job.condition]
    condition_data = simulate_condition(job.task, condition, drive)
    for entry in job.entries:
        yield store_result(
            evaluate_entry(job.task, condition, condition_data, entry, job.seeds, run),
            job,
            entry,
            out,
        )


def store_result(result: Result, job: Job, entry: Entry, out: Path) -> JobDone:
    """Store the result of an entry of a job."""
    known = result_identity(job.task, job.condition, entry, job.seeds)
    result = dataclasses.replace(result, identity=known)
    store.write_durable(store.part_path(out, known), store.to_text(result))
    return JobDone(
        identity=known,
        task=job.task.name,
        entry=entry.name,
        condition=job.task.conditions[job.condition].label,
        content_digest=content_digest(result),
        isolation=result.isolation,
        failure=result.failure,
    )


def in_sandbox(sandbox: SandboxClient) -> EntryRunner:
    """Run an entry in a process of its own."""

    def run(
        entry: Entry, condition_data: ConditionData, seeds: Sequence[int]
    ) -> Iterable[TrainingRun]:
        return sandbox.reconstruct(
            entry.reference,
            entry.settings,
            evaluate.training_pairs(condition_data),
            [test.record for test in condition_data.tests],
            condition_data.task.vehicle,
            seeds,
            cache=BUILTIN_CACHE
            if entry.reference in estimators.REGISTRY
            else f"guest-{entry.name}",
        )

    return run


def run_job_file(spec: Path, out: Path) -> Iterator[JobDone]:
    """Run the job in a file in this process, and every entry in one of its own.

    Raises ConfigError, OSError.
    """
    remove_stale_temp()
    job = from_text(spec.read_text(encoding="utf-8"), str(spec))
    hidden = [out / "results", out / "jobs"]
    for folder in hidden:
        folder.mkdir(parents=True, exist_ok=True)
    with SandboxClient(job.limits, hidden, alone=True) as sandbox:
        yield from run_job(job, out, in_sandbox(sandbox))


def main() -> None:
    """Run a job for the process that started this one, which reads what is done, or an error."""
    processes.die_with_parent()
    try:
        for done in run_job_file(*map(Path, sys.argv[1:3])):
            _print_json_line(dataclasses.asdict(done))
    except (ConfigError, OSError) as error:
        _print_json_line({"error": " ".join(str(error).split())})


def _print_json_line(data: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(data) + "\n")
    sys.stdout.flush()


def _to_json_types(value: Any) -> Any:
    """`value` as JSON types from which `build` makes it again; a road carries its kind."""
    if dataclasses.is_dataclass(value):
        named = {
            f.name: _to_json_types(getattr(value, f.name))
            for f in dataclasses.fields(value)
            if f.init
        }
        kind = next((name for name, cls in KINDS.items() if type(value) is cls), None)
        return named if kind is None else {"kind": kind, **named}
    if isinstance(value, list | tuple):
        return [_to_json_types(item) for item in value]
    if isinstance(value, dict):
        return {key: _to_json_types(item) for key, item in value.items()}
    return value


if __name__ == "__main__":
    main()
