"""Jobs: some entries on one condition of one task, run from a self-contained file.

Jobs can be run on any machine, any number of times, in any order.

    road-recon run-job spec.json --out FOLDER

The process that runs a job simulates the drives, holds the truth, runs every entry in a separate
process, scores the estimates and stores the results. `python -m leaderboard.running.jobs FOLDER`
runs one job after the other: it reads the path of a job file from each line of standard input, and
prints a JSON line for each result and at the end of each job. Its guests, which have loaded the
libraries that estimators of this package use, stay for the jobs that follow.
"""

import contextlib
import dataclasses
import json
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from leaderboard.entries.entry import Entry, TrainingRun
from leaderboard.evaluation import evaluate, store
from leaderboard.evaluation.evaluate import (
    ConditionData,
    EntryRunner,
    evaluate_entry,
    simulate_condition,
)
from leaderboard.evaluation.provenance import package_version
from leaderboard.evaluation.results import RESULT, Result, content_digest, evaluation_version
from leaderboard.evaluation.tasks import Task
from leaderboard.evaluation.test_data import DriveSimulation, simulate_drives
from leaderboard.json_values import to_json_types
from leaderboard.metrics import heights
from leaderboard.running import job_files
from leaderboard.sandbox import processes
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs.core.atomic_io import remove_stale_temp
from road_envs.core.config import ConfigError, Settings, build


@dataclass(frozen=True, kw_only=True)
class Job(Settings):
    """Entries that are evaluated on the same drives."""

    task: Task
    condition: int
    entries: tuple[Entry, ...]
    seeds: tuple[int, ...]
    limits: Limits = field(default_factory=Limits)
    task_digest: str = ""
    evaluation_code: str = ""  # version of the evaluation code that planned the job
    files: str = ""  # folder with copies of all files that the job needs; "": they are elsewhere


@dataclass(frozen=True, kw_only=True)
class JobDone(Settings):
    """Summary of a stored result."""

    identity: str
    task: str
    entry: str
    condition: str
    content_digest: str
    isolation: str
    failure: str | None = None


def result_identity(task: Task, condition: int | None, entry: Entry, seeds: Sequence[int]) -> str:
    """Return the digest of all inputs of a result; of a whole row if `condition` is None."""
    return RESULT.identity(
        task.digest,
        None if condition is None else task.conditions[condition].label,
        [entry.name, entry.reference, entry.settings, entry.code],
        list(seeds),
        package_version(),
        heights.VERSION,
    )


def to_text(job: Job) -> str:
    """Return the content of a job file."""
    return json.dumps(_to_spec(job), indent=1) + "\n"


def to_packed_text(job: Job) -> tuple[str, dict[str, Path]]:
    """Return the content of a file of a job that needs no file of this machine.

    Also returns the files to be copied, by the path of the copy relative to that of the job. Raises
    ConfigError.
    """
    spec, sources = job_files.pack(_to_spec(job), job.entries)
    return json.dumps(spec, indent=1) + "\n", sources


def _to_spec(job: Job) -> dict[str, Any]:
    evaluation_code = evaluation_version()
    return to_json_types(
        dataclasses.replace(job, task_digest=job.task.digest, evaluation_code=evaluation_code)
    )


def from_text(text: str, where: str, folder: Path = Path()) -> Job:
    """Parse a job file; copies of files are looked for in its `folder`.

    Raises ConfigError, also if the job was planned by another version.
    """
    try:
        data = json.loads(text)
    except ValueError as error:
        raise ConfigError(f"{where}: damaged, not valid JSON: {error}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: not a job")
    if data.get("files") and isinstance(data["files"], str):
        data = job_files.locate(data, folder)
    job = build(Job, data, where)
    if not 0 <= job.condition < len(job.task.conditions):
        raise ConfigError(f"{where}: {job.task.name} has no condition {job.condition}")
    if job.evaluation_code != evaluation_version():
        raise ConfigError(f"{where}: planned by another version of the code; plan it again")
    if job.task_digest != job.task.digest:
        raise ConfigError(
            f"{where}: the task {job.task.name} or one of its files differs here; plan it again"
        )
    return job


def run_job(
    job: Job, out: Path, run: EntryRunner, simulate: DriveSimulation = simulate_drives
) -> Iterator[JobDone]:
    """Evaluate the entries of a job one by one and store each result. Raises ConfigError."""
    condition = job.task.conditions[job.condition]
    data = simulate_condition(job.task, condition, simulate)
    for entry in job.entries:
        result = evaluate_entry(job.task, condition, data, entry, job.seeds, run)
        yield store_result(result, job, entry, out)


def store_result(result: Result, job: Job, entry: Entry, out: Path) -> JobDone:
    """Store the result of an entry of a job."""
    identity = result_identity(job.task, job.condition, entry, job.seeds)
    result = dataclasses.replace(result, identity=identity)
    store.save_part(store.to_text(result), out, identity)
    return JobDone(
        identity=identity,
        task=job.task.name,
        entry=entry.name,
        condition=job.task.conditions[job.condition].label,
        content_digest=content_digest(result),
        isolation=result.isolation,
        failure=result.failure,
    )


def in_sandbox(sandbox: SandboxClient) -> EntryRunner:
    """Return a runner that trains and runs each entry in a guest."""

    def run(entry: Entry, data: ConditionData, seeds: Sequence[int]) -> Iterable[TrainingRun]:
        training, car = evaluate.training_pairs(data), data.task.vehicle_of(data.condition)
        records = [test.record for test in data.tests]
        return sandbox.reconstruct(
            entry, training, records, car, seeds,
            calibrations=evaluate.calibrations(data), retest=True,
        )  # fmt: skip

    return run


def run_job_file(spec: Path, out: Path) -> Iterator[JobDone]:
    """Run the job of a file in this process, each entry in a separate one.

    Raises ConfigError, OSError.
    """
    remove_stale_temp()
    yield from filter(None, serve([spec], out))


def are_ours(entries: Iterable[Entry]) -> bool:
    """Return whether all entries are of this package: such jobs may share a process."""
    return not any(job_files.is_from_outside(entry) for entry in entries)


def serve(specs: Iterable[Path], out: Path) -> Iterator[JobDone | None]:
    """Run the jobs of some files; yield each result, and None at the end of each job.

    Jobs after the first must have entries of this package only. Raises ConfigError, OSError.
    """
    with contextlib.ExitStack() as stack:
        sandbox: SandboxClient | None = None
        for spec in specs:
            job = from_text(spec.read_text(encoding="utf-8"), str(spec), spec.parent)
            if sandbox is None:
                code = job_files.code_folders(job.files, job.entries)
                guests = SandboxClient(job.limits, owns_all_children=True, code=code)
                sandbox = stack.enter_context(guests)
            yield from run_job(job, out, in_sandbox(sandbox))
            yield None


def main() -> None:
    """Run the jobs of standard input; print a JSON line for each result, or one with the error."""
    processes.die_with_parent()
    remove_stale_temp()
    specs = (Path(os.fsdecode(line.removesuffix(b"\n"))) for line in sys.stdin.buffer)
    try:
        for done in serve(specs, Path(sys.argv[1])):
            _print_json_line({} if done is None else dataclasses.asdict(done))
    except (ConfigError, OSError) as error:
        _print_json_line({"error": " ".join(str(error).split())})


def _print_json_line(data: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(data) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
