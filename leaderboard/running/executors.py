"""Where jobs are run: in this process, or each in a process of this machine, several at a time.

`cluster.py` has the third: on the workers of a Dask cluster.
"""

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Protocol

from estimators.api import Estimator
from leaderboard.evaluation import evaluate
from leaderboard.evaluation.entries import make_estimator
from leaderboard.evaluation.entry import Entry, TrainingRun
from leaderboard.evaluation.evaluate import ConditionData
from leaderboard.evaluation.test_data import DriveSimulation, simulate_drives
from leaderboard.running import jobs
from leaderboard.running.jobs import Job, JobDone
from leaderboard.sandbox import processes
from leaderboard.sandbox.client import describe_exit
from leaderboard.sandbox.limits import THREAD_VARIABLES
from road_envs._atomic_io import TempFolder
from road_envs.config import ConfigError, build


class Executor(Protocol):
    """Runs jobs and stores their results under `out`; hears of each as it is done, in any order."""

    @property
    def workers(self) -> int:
        """How many jobs it runs at a time."""
        ...

    def run(self, jobs: Sequence[Job], out: Path) -> Iterator[JobDone]: ...


class EvaluatorError(Exception):
    """The judge itself has failed, which is no entry's fault."""


class InProcessExecutor:
    """In this process, without any isolation: for tests, and for looking for one's own mistakes.

    `made` estimators are taken as they are, by name; others are made from their entry.
    """

    workers = 1

    def __init__(
        self,
        drive: DriveSimulation = simulate_drives,
        made: Mapping[str, Estimator | None] | None = None,
    ):
        self._simulate, self._estimators = drive, made or {}

    def run(self, jobs_: Sequence[Job], out: Path) -> Iterator[JobDone]:
        """Run one after the other; what is left of an entry that failed is not run."""
        failed: set[tuple[str, str]] = set()
        for job in jobs_:
            for done in jobs.run_job(
                _without_failed(job, failed), out, self._run_entry, self._simulate
            ):
                if done.failure is not None:
                    failed.add((done.task, done.entry))
                yield done

    def _run_entry(
        self, entry: Entry, condition_data: ConditionData, seeds: Sequence[int]
    ) -> Iterator[TrainingRun]:
        made = self._estimators.get(entry.name) or make_estimator(entry.reference, entry.settings)
        yield from evaluate.in_process(made)(entry, condition_data, seeds)


class ProcessExecutor:
    """Each job in a process of this machine, up to `workers` at a time, fed by threads.

    The entry that ran when the process of a job died is tried again alone; if that process dies
    too, it has failed. Where an entry has failed, what is left of it on that task is not run.
    """

    def __init__(self, workers: int):
        if workers < 1:
            raise ConfigError(f"at least one worker is wanted, got {workers}")
        self.workers = workers
        self._running: set[subprocess.Popen[str]] = set()

    def run(self, jobs_: Sequence[Job], out: Path) -> Iterator[JobDone]:
        """Run all. Raises ConfigError, OSError or JudgeError as soon as a job meets one."""
        queue: SimpleQueue[JobDone | BaseException | None] = SimpleQueue()
        failed: set[tuple[str, str]] = set()
        pool = ThreadPoolExecutor(self.workers)
        try:
            for job in jobs_:
                pool.submit(self._run_job, job, out, failed, queue.put)
            left = len(jobs_)
            while left:
                found = queue.get()
                if isinstance(found, BaseException):
                    raise found
                if found is None:
                    left -= 1
                else:
                    yield found
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in list(self._running):
                processes.kill_group(process.pid)
            pool.shutdown(wait=True)

    def _run_job(
        self, job: Job, out: Path, failed: set[tuple[str, str]], put: Callable[..., None]
    ) -> None:
        try:
            left = {entry.name: entry for entry in _without_failed(job, failed).entries}
            while left:
                self._run_process(_with_entries(job, left.values()), out, failed, put, left)
                if left:  # the process died, while it ran the first that is left
                    suspect = next(iter(left.values()))
                    status = self._run_process(
                        _with_entries(job, [suspect]), out, failed, put, left
                    )
                    if left.pop(suspect.name, None) is not None:
                        put(record_crash(job, suspect, describe_exit(status), out))
        except BaseException as error:
            put(error)
        else:
            put(None)

    def _run_process(
        self,
        job: Job,
        out: Path,
        failed: set[tuple[str, str]],
        put: Callable[..., None],
        left: dict[str, Entry],
    ) -> int:
        """Run a process on a job, pass on what it has done, and take that out of `left`."""
        with (
            TempFolder() as folder,
            start_job(job, folder, out) as process,
        ):
            self._running.add(process)
            try:
                assert process.stdout is not None
                for line in process.stdout:
                    data = json.loads(line)
                    if "error" in data:
                        raise ConfigError(data["error"])
                    done = build(JobDone, data, "a job")
                    left.pop(done.entry, None)
                    if done.failure is not None:
                        failed.add((done.task, done.entry))
                    put(done)
                status = process.wait()
            finally:
                self._running.discard(process)
                processes.kill_group(process.pid)
            if status > 0:
                raise EvaluatorError((folder / "said.txt").read_text(encoding="utf-8")[-4000:])
        return status


def start_job(job: Job, folder: Path, out: Path) -> subprocess.Popen[str]:
    """A process that runs a job; `folder` gets its file, and what it says on standard error."""
    spec = folder / "spec.json"
    spec.write_text(jobs.to_text(job), encoding="utf-8")
    path = os.pathsep.join(os.path.abspath(place) for place in sys.path)
    with (folder / "said.txt").open("wb") as stderr:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "leaderboard.running.jobs", str(spec), str(out)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            env=os.environ | dict.fromkeys(THREAD_VARIABLES, "1") | {"PYTHONPATH": path},
            start_new_session=True,
        )


def _with_entries(job: Job, entries: Iterable[Entry]) -> Job:
    return dataclasses.replace(job, entries=tuple(entries))


def _without_failed(job: Job, failed: set[tuple[str, str]]) -> Job:
    """A job without the entries that have failed on its task."""
    return _with_entries(job, (e for e in job.entries if (job.task.name, e.name) not in failed))


def record_crash(job: Job, entry: Entry, by: str, out: Path) -> JobDone:
    """Store that the judge's own process did not outlive an entry, and what ended it."""
    condition = job.task.conditions[job.condition]
    why = f"{condition.label}, the judge's process was ended twice by {by} while it ran"
    result = evaluate.evaluate_entry(
        job.task, condition, why, entry, job.seeds, evaluate.in_process(None)
    )
    return jobs.store_result(result, job, entry, out)
