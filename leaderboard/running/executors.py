"""Executors of jobs: their interface, and several processes of this machine.

`dask_executor.py` runs jobs on a Dask cluster.
"""

import contextlib
import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Protocol

from leaderboard.entries.entry import Entry
from leaderboard.evaluation import evaluate
from leaderboard.running import jobs
from leaderboard.running.jobs import Job, JobDone
from leaderboard.sandbox import processes
from leaderboard.sandbox.guest import describe_exit
from leaderboard.sandbox.limits import THREAD_VARIABLES
from road_envs.core.atomic_io import TempFolder
from road_envs.core.config import ConfigError, build


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


class JobProcess:
    """A process of this machine that runs one job after the other and stores results in `out`."""

    def __init__(self, out: Path) -> None:
        self._folder = TempFolder()
        path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)
        with (self._folder.path / "stderr.txt").open("wb") as stderr:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", jobs.__name__, str(out)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                encoding="utf-8",
                errors="surrogateescape",  # in the paths of job files
                env=os.environ | dict.fromkeys(THREAD_VARIABLES, "1") | {"PYTHONPATH": path},
                start_new_session=True,
            )

    def run(self, job: Job) -> Iterator[JobDone]:
        """Run a job; the iterator also ends if the process does. Raises ConfigError."""
        spec = self._folder.path / "spec.json"
        spec.write_text(jobs.to_text(job), encoding="utf-8")
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended: there is no reply
            self._process.stdin.write(f"{spec}\n")
            self._process.stdin.flush()
        for line in self._process.stdout:
            data = json.loads(line)
            if "error" in data:
                raise ConfigError(data["error"])
            if not data:  # the end of the job
                return
            yield build(JobDone, data, "a job")

    def kill(self) -> None:
        """Kill the process and its group."""
        processes.kill_group(self._process.pid)

    def close(self) -> tuple[int, str]:
        """Let the process end; return its exit status, negative for a signal, and its last words.

        All that is left of its group is killed.
        """
        with contextlib.suppress(BrokenPipeError):
            self._process.communicate()
        self.kill()
        stderr = (self._folder.path / "stderr.txt").read_text(encoding="utf-8")[-4000:]
        self._folder.close()
        return self._process.returncode, stderr


class ProcessExecutor:
    """Runs jobs in processes of this machine, up to `workers` at a time.

    Jobs with entries of this package only share `workers` processes, which load the libraries once;
    others have a process each. If the process of a job dies, the entry that was running is run
    again alone, and fails if that process dies too. Further conditions of an entry that failed on a
    task are skipped.
    """

    def __init__(self, workers: int):
        if workers < 1:
            raise ConfigError(f"the number of workers must be at least 1, got {workers}")
        self.workers = workers
        self._processes: set[JobProcess] = set()
        self._idle: list[JobProcess] = []
        self._stopped, self._lock = False, Lock()

    def run(self, jobs_: Sequence[Job], out: Path) -> Iterator[JobDone]:
        """Run all jobs. Raises the first ConfigError, OSError or EvaluatorError of a job."""
        queue: SimpleQueue[JobDone | BaseException | None] = SimpleQueue()
        failed: set[tuple[str, str]] = set()
        pool, self._stopped = ThreadPoolExecutor(self.workers), False
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
            with self._lock:
                self._stopped = True
                for process in self._processes.difference(self._idle):
                    process.kill()
            pool.shutdown(wait=True)
            while self._idle:
                self._close(self._idle.pop())

    def _run_job(
        self, job: Job, out: Path, failed: set[tuple[str, str]], put: Callable[..., None]
    ) -> None:
        try:
            remaining = {entry.name: entry for entry in without_failed(job, failed).entries}
            suspect = ""  # the entry that was running when a process died
            while remaining:
                tried = [remaining[suspect]] if suspect else remaining.values()
                status = self._run_process(_with_entries(job, tried), out, failed, put, remaining)
                if suspect and (entry := remaining.pop(suspect, None)) is not None:
                    put(record_crash(job, entry, describe_exit(status), out))
                suspect = "" if suspect else next(iter(remaining), "")
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

        Return the exit status, negative for a signal, 0 also of a process that is kept for further
        jobs. Raises EvaluatorError for a positive one.
        """
        process = self._take(out)
        try:
            for done in process.run(job):
                remaining.pop(done.entry, None)
                if done.failure is not None:
                    failed.add((done.task, done.entry))
                put(done)
        except BaseException:
            process.kill()
            self._close(process)
            raise
        if jobs.are_ours(job.entries) and not remaining:
            with self._lock:
                self._idle.append(process)
            return 0
        status, stderr = self._close(process)
        if status > 0:
            raise EvaluatorError(stderr)
        return status

    def _take(self, out: Path) -> JobProcess:
        """Return an idle process or a new one. Raises EvaluatorError after the end of the run."""
        with self._lock:
            if self._stopped:
                raise EvaluatorError("the run was stopped")
            process = self._idle.pop() if self._idle else JobProcess(out)
            self._processes.add(process)
            return process

    def _close(self, process: JobProcess) -> tuple[int, str]:
        with self._lock:
            self._processes.discard(process)
        return process.close()


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
