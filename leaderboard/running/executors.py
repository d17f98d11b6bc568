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
from leaderboard.evaluation.entries import make
from leaderboard.evaluation.entry import Entry, Outcome
from leaderboard.evaluation.evaluate import Session
from leaderboard.evaluation.test_data import DriveSource, simulated
from leaderboard.running import jobs
from leaderboard.running.jobs import Done, Job
from leaderboard.sandbox import processes
from leaderboard.sandbox.client import how
from leaderboard.sandbox.limits import PINNED
from road_envs._atomic_io import Scratch
from road_envs.config import ConfigError, build


class Executor(Protocol):
    """Runs jobs and stores their results under `out`; hears of each as it is done, in any order."""

    @property
    def workers(self) -> int:
        """How many jobs it runs at a time."""
        ...

    def run(self, jobs: Sequence[Job], out: Path) -> Iterator[Done]: ...


class JudgeError(Exception):
    """The judge itself has failed, which is no entry's fault."""


class Here:
    """In this process, without any isolation: for tests, and for looking for one's own mistakes.

    `made` estimators are taken as they are, by name; others are made from their entry.
    """

    workers = 1

    def __init__(
        self, drive: DriveSource = simulated, made: Mapping[str, Estimator | None] | None = None
    ):
        self._drive, self._made = drive, made or {}

    def run(self, jobs_: Sequence[Job], out: Path) -> Iterator[Done]:
        """Run one after the other; what is left of an entry that failed is not run."""
        failed: set[tuple[str, str]] = set()
        for job in jobs_:
            for done in jobs.perform(_without(job, failed), out, self._entry, self._drive):
                if done.failure is not None:
                    failed.add((done.task, done.entry))
                yield done

    def _entry(self, entry: Entry, session: Session, seeds: Sequence[int]) -> Iterator[Outcome]:
        made = self._made.get(entry.name) or make(entry.reference, entry.settings)
        yield from evaluate.here(made)(entry, session, seeds)


class Processes:
    """Each job in a process of this machine, up to `workers` at a time, fed by threads.

    The entry that ran when the process of a job died is tried again alone; if that process dies
    too, it has failed. Where an entry has failed, what is left of it on that task is not run.
    """

    def __init__(self, workers: int):
        if workers < 1:
            raise ConfigError(f"at least one worker is wanted, got {workers}")
        self.workers = workers
        self._running: set[subprocess.Popen[str]] = set()

    def run(self, jobs_: Sequence[Job], out: Path) -> Iterator[Done]:
        """Run all. Raises ConfigError, OSError or JudgeError as soon as a job meets one."""
        queue: SimpleQueue[Done | BaseException | None] = SimpleQueue()
        failed: set[tuple[str, str]] = set()
        pool = ThreadPoolExecutor(self.workers)
        try:
            for job in jobs_:
                pool.submit(self._perform, job, out, failed, queue.put)
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

    def _perform(
        self, job: Job, out: Path, failed: set[tuple[str, str]], put: Callable[..., None]
    ) -> None:
        try:
            left = {entry.name: entry for entry in _without(job, failed).entries}
            while left:
                self._attempt(_with(job, left.values()), out, failed, put, left)
                if left:  # the process died, while it ran the first that is left
                    suspect = next(iter(left.values()))
                    status = self._attempt(_with(job, [suspect]), out, failed, put, left)
                    if left.pop(suspect.name, None) is not None:
                        put(lost(job, suspect, how(status), out))
        except BaseException as error:
            put(error)
        else:
            put(None)

    def _attempt(
        self,
        job: Job,
        out: Path,
        failed: set[tuple[str, str]],
        put: Callable[..., None],
        left: dict[str, Entry],
    ) -> int:
        """Run a process on a job, pass on what it has done, and take that out of `left`."""
        with (
            Scratch() as folder,
            start(job, folder, out) as process,
        ):
            self._running.add(process)
            try:
                assert process.stdout is not None
                for line in process.stdout:
                    data = json.loads(line)
                    if "error" in data:
                        raise ConfigError(data["error"])
                    done = build(Done, data, "a job")
                    left.pop(done.entry, None)
                    if done.failure is not None:
                        failed.add((done.task, done.entry))
                    put(done)
                status = process.wait()
            finally:
                self._running.discard(process)
                processes.kill_group(process.pid)
            if status > 0:
                raise JudgeError((folder / "said.txt").read_text(encoding="utf-8")[-4000:])
        return status


def start(job: Job, folder: Path, out: Path) -> subprocess.Popen[str]:
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
            env=os.environ | dict.fromkeys(PINNED, "1") | {"PYTHONPATH": path},
            start_new_session=True,
        )


def _with(job: Job, entries: Iterable[Entry]) -> Job:
    return dataclasses.replace(job, entries=tuple(entries))


def _without(job: Job, failed: set[tuple[str, str]]) -> Job:
    """A job without the entries that have failed on its task."""
    return _with(job, (e for e in job.entries if (job.task.name, e.name) not in failed))


def lost(job: Job, entry: Entry, by: str, out: Path) -> Done:
    """Store that the judge's own process did not outlive an entry, and what ended it."""
    condition = job.task.conditions[job.condition]
    why = f"{condition.label}, the judge's process was ended twice by {by} while it ran"
    result = evaluate.judge(job.task, condition, why, entry, job.seeds, evaluate.here(None))
    return jobs.keep(result, job, entry, out)
