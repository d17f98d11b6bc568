"""Executors of jobs: their interface, and several processes of this machine.

`dask_executor.py` runs jobs on a Dask cluster.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Protocol

import numpy as np

from leaderboard.entries.entry import EntryError
from leaderboard.running import jobs
from leaderboard.running.jobs import Job, JobDone
from leaderboard.sandbox import messages, processes
from leaderboard.sandbox.launch import start_host_process
from road_envs.core.atomic_io import TempFolder
from road_envs.core.config import ConfigError, build

ATTEMPTS = 2
"""Number of times that an entry is run whose evaluation process ends meanwhile."""


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
        """Raises EvaluatorError if it cannot be started."""
        self._folder = TempFolder()
        try:
            self._guest = start_host_process(jobs.__name__, self._folder.path / "home", out)
        except EntryError as error:
            self._folder.close()
            raise EvaluatorError(str(error)) from None

    def run(self, job: Job) -> JobDone:
        """Run a job of one entry.

        Raises EntryError if the process ends, ConfigError, EvaluatorError.
        """
        text = np.frombuffer(jobs.to_text(job).encode(), np.uint8)
        head, _ = self._guest.call(messages.encode({"do": "run"}, [text]))
        if "error" in head:
            raise ConfigError(head["error"])
        if "failure" in head:
            raise EvaluatorError(head["failure"])
        return build(JobDone, head["done"], "a job")

    def kill(self) -> None:
        """Kill the process, which may be running a job in another thread."""
        processes.kill(self._guest.pid)

    def close(self, *, ended: bool = False) -> None:
        """End the process, and what is left of an `ended` one."""
        try:
            if not ended:
                self._guest.call(messages.encode({"do": "close"}))
        except EntryError:
            pass
        self._guest.close()
        self._folder.close()


class ProcessExecutor:
    """Runs jobs in processes of this machine, up to `workers` at a time.

    Jobs with entries of this package only share `workers` processes, which load the libraries once;
    others have a process each. An entry whose process ends is run again in another one, and fails
    if that ends too. Further conditions of an entry that failed on a task are skipped.
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
                self._discard(self._idle.pop())

    def _run_job(
        self, job: Job, out: Path, failed: set[tuple[str, str]], put: Callable[..., None]
    ) -> None:
        process: JobProcess | None = None
        try:
            for entry in job.entries:
                if (job.task.name, entry.name) in failed:
                    continue
                alone = dataclasses.replace(job, entries=(entry,))
                for attempt in range(ATTEMPTS):
                    process = process or self._take(out)
                    try:
                        done = process.run(alone)
                        break
                    except EntryError as error:
                        self._discard(process, ended=True)
                        process = None
                        if attempt == ATTEMPTS - 1:
                            done = jobs.record_crash(job, entry, str(error), out)
                if done.failure is not None:
                    failed.add((done.task, done.entry))
                put(done)
            if process is not None and jobs.are_ours(job.entries):
                with self._lock:
                    self._idle.append(process)
                    process = None
        except BaseException as error:
            put(error)
        else:
            put(None)
        finally:
            if process is not None:
                self._discard(process)

    def _take(self, out: Path) -> JobProcess:
        """Return an idle process or a new one. Raises EvaluatorError after the end of the run."""
        with self._lock:
            process = self._idle.pop() if self._idle else None
        process = process or JobProcess(out)
        with self._lock:
            self._processes.add(process)
            if not self._stopped:
                return process
        self._discard(process)
        raise EvaluatorError("the run was stopped")

    def _discard(self, process: JobProcess, *, ended: bool = False) -> None:
        with self._lock:
            self._processes.discard(process)
        process.close(ended=ended)
