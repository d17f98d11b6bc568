"""Executors of jobs: their interface, and several processes of this machine.

`dask_executor.py` runs jobs on a Dask cluster.
"""

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Protocol

from leaderboard.evaluation import evaluate
from leaderboard.evaluation.entry import Entry
from leaderboard.running import jobs
from leaderboard.running.jobs import Job, JobDone
from leaderboard.sandbox import processes
from leaderboard.sandbox.guest import describe_exit
from leaderboard.sandbox.limits import THREAD_VARIABLES
from road_envs._atomic_io import TempFolder
from road_envs.config import ConfigError, build


class Executor(Protocol):
    """Executor of jobs."""

    @property
    def workers(self) -> int:
        """Number of jobs that run at a time."""
        ...

    def run(self, jobs: Sequence[Job], out: Path) -> Iterator[JobDone]:
        """Run jobs, store results under `out` and yield each summary in completion order."""
        ...


class EvaluatorError(Exception):
    """The evaluation code has failed, independently of the entry."""


class ProcessExecutor:
    """Runs each job in a process of this machine, up to `workers` at a time.

    If the process of a job dies, the entry that was running is run again alone, and fails if that
    process dies too. Further conditions of an entry that failed on a task are skipped.
    """

    def __init__(self, workers: int):
        if workers < 1:
            raise ConfigError(f"the number of workers must be at least 1, got {workers}")
        self.workers = workers
        self._running: set[subprocess.Popen[str]] = set()

    def run(self, jobs_: Sequence[Job], out: Path) -> Iterator[JobDone]:
        """Run all jobs. Raises the first ConfigError, OSError or EvaluatorError of a job."""
        queue: SimpleQueue[JobDone | BaseException | None] = SimpleQueue()
        failed: set[tuple[str, str]] = set()
        pool = ThreadPoolExecutor(self.workers)
        try:
            for job in jobs_:
                pool.submit(self._run_job, job, out, failed, queue.put)
            left = len(jobs_)
            while left:
                item = queue.get()
                if isinstance(item, BaseException):
                    raise item
                if item is None:  # the end of a job
                    left -= 1
                else:
                    yield item
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in list(self._running):
                processes.kill_group(process.pid)
            pool.shutdown(wait=True)

    def _run_job(
        self, job: Job, out: Path, failed: set[tuple[str, str]], put: Callable[..., None]
    ) -> None:
        try:
            remaining = {entry.name: entry for entry in without_failed(job, failed).entries}
            while remaining:
                self._run_process(
                    _with_entries(job, remaining.values()), out, failed, put, remaining
                )
                if remaining:  # the process died while running the first entry of `remaining`
                    suspect = next(iter(remaining.values()))
                    status = self._run_process(
                        _with_entries(job, [suspect]), out, failed, put, remaining
                    )
                    if remaining.pop(suspect.name, None) is not None:
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
        remaining: dict[str, Entry],
    ) -> int:
        """Run a job in a process, put its results and remove their entries from `remaining`.

        Return the exit status, negative for a signal. Raises EvaluatorError for a positive one.
        """
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
                    remaining.pop(done.entry, None)
                    if done.failure is not None:
                        failed.add((done.task, done.entry))
                    put(done)
                status = process.wait()
            finally:
                self._running.discard(process)
                processes.kill_group(process.pid)
            if status > 0:
                raise EvaluatorError((folder / "stderr.txt").read_text(encoding="utf-8")[-4000:])
        return status


def start_job(job: Job, folder: Path, out: Path) -> subprocess.Popen[str]:
    """Start a process that runs a job; `folder` receives the job file and standard error."""
    spec = folder / "spec.json"
    spec.write_text(jobs.to_text(job), encoding="utf-8")
    path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)
    with (folder / "stderr.txt").open("wb") as stderr:
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


def without_failed(job: Job, failed: set[tuple[str, str]]) -> Job:
    """Return a job without the entries that have failed on its task."""
    return _with_entries(job, (e for e in job.entries if (job.task.name, e.name) not in failed))


def record_crash(job: Job, entry: Entry, by: str, out: Path) -> JobDone:
    """Store a failure of an entry during which the process of the job was ended twice."""
    condition = job.task.conditions[job.condition]
    failure = f"{condition.label}, the evaluation process was ended twice by {by} while it ran"
    result = evaluate.evaluate_entry(
        job.task, condition, failure, entry, job.seeds, evaluate.in_process(None)
    )
    return jobs.store_result(result, job, entry, out)
