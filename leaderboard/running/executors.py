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
from leaderboard.sandbox.guest import Guest
from leaderboard.sandbox.launch import start_host_process
from road_envs.core.atomic_io import TempFolder
from road_envs.core.config import ConfigError, build

_ATTEMPTS = 2  # to run an entry whose evaluation process ends meanwhile


class Executor(Protocol):
    """Executor of jobs."""

    workers: int  # number of jobs that run at a time

    def run(self, jobs: Sequence[Job], out: Path) -> Iterator[JobDone]:
        """Run jobs, store results under `out` and yield each summary in completion order."""


class EvaluatorError(Exception):
    """The evaluation code has failed, independently of the entry."""


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

    A process of this machine runs them and stores their results in `out`. Entries that have
    `failed`, by task and name, are skipped.
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
        self._process: Guest | None = None
        self._folder: TempFolder | None = None  # of the process
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
            processes.kill(process.pid)

    def _run_entry(self, job: Job) -> JobDone:
        """Run a job of one entry. Raises ConfigError, EvaluatorError."""
        text = np.frombuffer(jobs.to_text(job).encode(), np.uint8)
        for _ in range(_ATTEMPTS):
            if self._process is None and not self._stopped:
                self._process = self._start()
            if self._process is None or self._stopped:
                raise EvaluatorError("the run was stopped")
            try:
                head, _ = self._process.call(messages.encode({"do": "run"}, [text]))
                break
            except EntryError as error:
                reason = str(error)
                self._close(ended=True)
        else:
            head = {"done": dataclasses.asdict(jobs.record_crash(job, reason, self._out))}
        if "error" in head:
            raise ConfigError(head["error"])
        if "failure" in head:
            raise EvaluatorError(head["failure"])
        done = build(JobDone, head["done"], "a job")
        if done.failure is not None:
            self._failed.add((done.task, done.entry))
        return done

    def _start(self) -> Guest:
        self._folder = TempFolder()
        try:
            return start_host_process(jobs.__name__, self._folder.path / "home", self._out)
        except EntryError as error:
            raise EvaluatorError(str(error)) from None

    def _close(self, *, ended: bool = False) -> None:
        """End the process, and what is left of an `ended` one."""
        process, self._process = self._process, None
        if process is not None:
            if not ended:
                with suppress(EntryError):
                    process.call(messages.encode({"do": "close"}))
            process.close()
        if self._folder is not None:
            self._folder.close()
