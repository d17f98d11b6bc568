"""Jobs: some entries on one condition of one task, run from a self-contained file: on any machine,
any number of times, in any order.

    road-recon run-job spec.json --out FOLDER

The process that runs a job simulates the drives, holds the truth, runs every entry in a separate
process, scores the estimates and stores the results. A `ProcessExecutor` runs jobs by the protocol
of a guest, with `make_handler`. The guests of such a process, which have loaded the libraries that
estimators of this package use, stay for the jobs that follow.
"""

import contextlib
import dataclasses
import json
import traceback
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from leaderboard.entries import entry_files
from leaderboard.entries.entries import is_by_others, is_from_outside
from leaderboard.entries.entry import Entry, EntryError, TrainingRun
from leaderboard.evaluation import evaluate, store
from leaderboard.evaluation.provenance import package_code, package_version, read_package_code
from leaderboard.evaluation.results import RESULT, content_digest, evaluation_version
from leaderboard.evaluation.task_files import digest_of, files_of, to_json_types, with_paths
from leaderboard.evaluation.tasks import Task
from leaderboard.metrics import heights
from leaderboard.sandbox import messages
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs.core.atomic_io import remove_stale_temp
from road_envs.core.config import ConfigError, Settings, build
from road_envs.core.reading import parsing, regular

_FOLDER = "files"
"""Folder of copies of the files that a job needs besides its text, beside the file of the job."""


@dataclass(frozen=True, kw_only=True)
class Job(Settings):
    """Entries that are evaluated on the same drives."""

    task: Task
    condition: int
    entries: tuple[Entry, ...]
    seeds: tuple[int, ...]
    limits: Limits = field(default_factory=Limits)
    task_digest: str = ""
    evaluation_code: str = ""  # version of the code, with its weights, that planned the job
    files: str = ""  # folder with copies of all files that the job needs; "": they are elsewhere


@dataclass(frozen=True, kw_only=True)
class JobDone(Settings):
    """Summary of a stored result."""

    identity: str
    task: str
    entry: str
    condition: str
    content_digest: str
    failure: str | None = None


def result_identity(task: Task, condition: int | None, entry: Entry, seeds: Sequence[int]) -> str:
    """Return the digest of all inputs of a result; of a whole row if `condition` is None."""
    return RESULT.identity(
        task.digest,
        None if condition is None else task.conditions[condition].label,
        [entry.name, entry.reference, entry.settings, entry.code, evaluation_version()],
        list(entry.imports),
        package_code() if is_by_others(entry) else "",
        list(seeds),
        package_version(),
        heights.VERSION,
    )


def to_text(job: Job) -> str:
    """Return the content of a job file."""
    return json.dumps(_to_spec(job), indent=1) + "\n"


def to_packed_text(job: Job) -> tuple[str, dict[str, Path]]:
    """Return the content of a file of a job that needs no file of this machine.

    It names copies, by the digest of their content. Also returns the files to be copied, by the
    path of the copy relative to that of the job. Raises ConfigError if one cannot be read.
    """
    spec = _to_spec(job)
    sources: dict[str, Path] = {}

    def copy(path: str) -> str:
        folder = f"{_FOLDER}/{digest_of(path)}"
        sources.update({f"{folder}/{file.name}": file for file in files_of(path)})
        return f"{folder}/{Path(path).name}"

    try:
        packed = {**spec, "task": with_paths(spec["task"], copy), "files": _FOLDER}
        for entry in filter(is_from_outside, job.entries):
            for source, name in entry_files.list_files(entry.reference):
                sources[f"{_FOLDER}/{entry.code}/{name}"] = source
    except (OSError, EntryError) as error:
        raise ConfigError(f"a file of the job cannot be read: {error}") from None
    return json.dumps(packed, indent=1) + "\n", sources


def _code_here() -> str:
    return f"{evaluation_version()}+{read_package_code()}"  # of which no file of weights is a part


def _to_spec(job: Job) -> dict[str, Any]:
    planned = dataclasses.replace(job, task_digest=job.task.digest, evaluation_code=_code_here())
    spec = to_json_types(planned)
    return _locate(spec, Path())  # the process that runs it has another working folder


def _locate(spec: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the JSON object of a job whose paths begin in `folder`, with absolute ones."""
    task = with_paths(spec.get("task"), lambda path: str(folder.resolve() / path))
    return {**spec, "task": task, "files": spec["files"] and str(folder.resolve() / spec["files"])}


def from_text(text: str, where: str, folder: Path = Path()) -> Job:
    """Parse a job file; copies of files are looked for in its `folder`.

    Raises ConfigError, also if the job was planned by another version.
    """
    with parsing(where, ConfigError, "damaged, not valid JSON"):
        data = json.loads(text)
        if not isinstance(data, dict):
            raise ConfigError("not a job")
        if data.get("files") and isinstance(data["files"], str):
            data = _locate(data, folder)
    job = build(Job, data, where)
    if not 0 <= job.condition < len(job.task.conditions):
        raise ConfigError(f"{where}: {job.task.name} has no condition {job.condition}")
    if job.evaluation_code != _code_here():
        raise ConfigError(f"{where}: planned by other code or weights; plan it again")
    if job.task_digest != job.task.digest:
        raise ConfigError(
            f"{where}: the task {job.task.name} or one of its files differs here; plan it again"
        )
    return job


def run_job(
    job: Job, data: evaluate.ConditionData | str, out: Path, run: evaluate.EntryRunner
) -> Iterator[JobDone]:
    """Evaluate the entries of a job on the drives `data` one by one and store each result.

    `data` may be the reason why there are none. Raises ConfigError if the code or weights of this
    program are no longer those that the job was planned with: guests read them when they start.
    """
    condition = job.task.conditions[job.condition]
    limits = job.limits.seconds, job.limits.memory
    for entry in job.entries:
        identity = result_identity(job.task, job.condition, entry, job.seeds)
        result = evaluate.evaluate_entry(job.task, condition, data, entry, job.seeds, run)
        if job.evaluation_code not in ("", _code_here()):
            raise ConfigError(f"{entry.name}: code or weights changed while it ran; run it again")
        result = dataclasses.replace(result, identity=identity, limits=limits)
        store.save_part(store.to_text(result), out, identity)
        yield JobDone(
            identity=identity, task=job.task.name, entry=entry.name, condition=condition.label,
            content_digest=content_digest(result), failure=result.failure,
        )  # fmt: skip


def record_crash(job: Job, reason: str, out: Path) -> JobDone:
    """Store a failure of a job of one entry during which its process has ended twice."""
    condition = job.task.conditions[job.condition]
    failure = f"{condition.label}, the evaluation process was ended twice while it ran: {reason}"
    (done,) = run_job(job, failure, out, evaluate.in_process(None))
    return done


def in_sandbox(sandbox: SandboxClient) -> evaluate.EntryRunner:
    """Return a runner that trains and runs each entry in a guest."""

    def run(
        entry: Entry, data: evaluate.ConditionData, seeds: Sequence[int]
    ) -> Iterable[TrainingRun]:
        training, records, car, drives = data.inputs
        return sandbox.reconstruct(
            entry, training, records, car, seeds, calibrations=drives, retest=True
        )

    return run


def run_job_file(spec: Path, out: Path) -> Iterator[JobDone]:
    """Run the job of a file in this process, each entry in a separate one.

    Raises ConfigError, OSError.
    """
    remove_stale_temp()
    job = from_text(regular(spec).read_text(encoding="utf-8"), str(spec), spec.parent)
    with _JobRunner(out) as runner:
        yield from runner.run(job)


def _code_folders(job: Job) -> dict[str, Path]:
    """Return the folder with the copied code, if any, of each entry from outside, by reference."""
    others = filter(is_from_outside, job.entries if job.files else ())
    return {entry.reference: Path(job.files, entry.code) for entry in others}


class _JobRunner(contextlib.ExitStack):
    """Runs jobs one after the other and stores their results in `out`; a context manager.

    Their limits are those of the first. Jobs of one condition that follow each other share drives.
    """

    def __init__(self, out: Path):
        super().__init__()
        self._out, self._code = out, dict[str, Path]()
        self._sandbox: SandboxClient | None = None
        self._simulated: tuple[tuple[str, int], evaluate.ConditionData | str] | None = None

    def run(self, job: Job) -> Iterator[JobDone]:
        """Run a job. Raises ConfigError, OSError."""
        self._code |= _code_folders(job)
        if self._sandbox is None:
            client = SandboxClient(job.limits, owns_all_children=True, code=self._code)
            self._sandbox = self.enter_context(client)
        drives = (job.task.digest, job.condition)
        if self._simulated is None or self._simulated[0] != drives:
            condition = job.task.conditions[job.condition]
            self._simulated = drives, evaluate.simulate_condition(job.task, condition)
        yield from run_job(job, self._simulated[1], self._out, in_sandbox(self._sandbox))


def make_handler(folder: str | None) -> messages.Handler:
    """Return the handler of a process that runs jobs and stores their results in the `folder`.

    run    the text of a job with one entry -> its summary `done`, or an `error` of the user
    close  nothing                          -> nothing; its guests and temporary files are gone
    """
    remove_stale_temp()
    assert folder is not None
    runner = _JobRunner(Path(folder))

    def handle(request: dict[str, Any], arrays: list[Any]) -> messages.Reply:
        if request["do"] == "close":
            runner.close()
            return {}, ()
        try:
            (done,) = runner.run(from_text(arrays[0].tobytes().decode(), "a job"))
        except (ConfigError, OSError) as error:
            return {"error": " ".join(str(error).split())}, ()
        except Exception:
            return {"failure": traceback.format_exc()[-4000:]}, ()
        return {"done": dataclasses.asdict(done)}, ()

    return handle
