"""Executors of jobs: their interface, and several processes of this machine.

`dask_executor.py` runs jobs on a Dask cluster.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Protocol

import numpy as np

from leaderboard.entries.entries import is_from_outside
from leaderboard.entries.entry import EntryError
from leaderboard.running import jobs
from leaderboard.running.jobs import Job, JobDone
from leaderboard.sandbox import messages, processes
from leaderboard.sandbox.launch import start_host_process
from road_envs.core.atomic_io import TempFolder
from road_envs.core.config import ConfigError, build

_ATTEMPTS = 2
"""Number of times that an entry is run whose evaluation process ends meanwhile."""


class Executor(Protocol):
    """Executor of jobs."""

    workers: int  # number of jobs that run at a time

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
        if not ended:
            with suppress(EntryError):
                self._guest.call(messages.encode({"do": "close"}))
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

    def run(self, jobs_: Sequence[Job], out: Path) -> Iterator[JobDone]:
        """Run all jobs. Raises the first ConfigError, OSError or EvaluatorError of a job."""
        queue: SimpleQueue[JobDone | BaseException | None] = SimpleQueue()
        waiting, failed = iter(jobs_), set[tuple[str, str]]()
        count = min(self.workers, len(jobs_))
        lanes = [_Lane(waiting, failed, out, queue.put) for _ in range(count)]
        for lane in lanes:
            lane.start()
        try:
            for _ in lanes:
                while (item := queue.get()) is not None:  # the end of a lane
                    if isinstance(item, BaseException):
                        raise item
                    yield item
        finally:
            for lane in lanes:
                lane.stop()
            for lane in lanes:
                lane.join()


class _Lane(Thread):
    """Runs `waiting` jobs one after the other and puts each summary, then None or an exception.

    Entries that have `failed`, by task and name, are skipped.
    """

    def __init__(
        self,
        waiting: Iterator[Job],
        failed: set[tuple[str, str]],
        out: Path,
        put: Callable[[JobDone | BaseException | None], None],
    ):
        super().__init__()
        self._waiting, self._failed, self._out, self._put = waiting, failed, out, put
        self._process: JobProcess | None = None
        self._stopped = False

    def run(self) -> None:
        """Run jobs until none is waiting."""
        end: BaseException | None = None
        try:
            for job in self._waiting:
                for entry in job.entries:
                    if (job.task.name, entry.name) not in self._failed:
                        self._put(self._run_entry(dataclasses.replace(job, entries=(entry,))))
                if any(map(is_from_outside, job.entries)):
                    self._close()
        except BaseException as error:
            end = error
        self._close()
        self._put(end)

    def stop(self) -> None:
        """Let the lane end soon, whatever it does; called by another thread."""
        self._stopped = True
        if (process := self._process) is not None:
            process.kill()

    def _run_entry(self, job: Job) -> JobDone:
        """Run a job of one entry. Raises what `JobProcess.run` raises, but EntryError."""
        for _ in range(_ATTEMPTS):
            if self._process is None and not self._stopped:
                self._process = JobProcess(self._out)
            if self._process is None or self._stopped:
                raise EvaluatorError("the run was stopped")
            try:
                done = self._process.run(job)
                break
            except EntryError as error:
                reason = str(error)
                self._close(ended=True)
        else:
            done = jobs.record_crash(job, reason, self._out)
        if done.failure is not None:
            self._failed.add((done.task, done.entry))
        return done

    def _close(self, *, ended: bool = False) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.close(ended=ended)
