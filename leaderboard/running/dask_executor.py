"""Jobs on the workers of a Dask cluster: what is known goes out as text, and results come back.

Workers need this package in the same version, and the surface files of tasks that have some; they
need not see the folder of results. A job whose worker dies is given to another one by the
scheduler.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from leaderboard.evaluation import store
from leaderboard.running import executors, jobs
from leaderboard.running.executors import ProcessExecutor
from leaderboard.running.jobs import Job, JobDone
from road_envs._atomic_io import TempFolder, remove_stale_temp
from road_envs._extras import optional_import
from road_envs.config import ConfigError

SCHEDULER_TIMEOUT = 20.0
"""Seconds in which the scheduler must answer, and then have a worker."""


class DaskExecutor:
    """Runs jobs on the cluster whose scheduler has `address`, such as "tcp://host:8786"."""

    def __init__(self, address: str):
        """Raises ConfigError if the scheduler does not answer or has no worker."""
        try:
            with optional_import("running on a cluster"):
                from distributed import Client
        except ImportError:
            raise ConfigError(
                "Dask is not installed; it comes with the extra: pip install 'road-envs[dask]'"
            ) from None
        try:
            self._client = Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            said = " ".join(str(error).split())
            raise ConfigError(f"no Dask scheduler answers at {address!r}: {said}") from None
        try:
            self._client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT)
        except TimeoutError:
            raise ConfigError(f"the Dask scheduler at {address!r} has no worker yet") from None
        self.workers = sum(self._client.nthreads().values())

    def run(self, jobs_: Sequence[Job], out: Path) -> Iterator[JobDone]:
        """Run all, and store what comes back. Raises ConfigError or JudgeError as a job does."""
        with optional_import("running on a cluster"):
            from distributed import KilledWorker, as_completed

        asked = {self._submit(job): job for job in jobs_}
        waiting = as_completed(asked, loop=self._client.loop)
        for future in waiting:
            job = asked.pop(future)
            try:
                found = future.result()
            except KilledWorker:  # several workers died of it: an entry at a time, then
                if len(job.entries) == 1:
                    yield executors.record_crash(
                        job, job.entries[0], "the death of its worker", out
                    )
                for entry in job.entries if len(job.entries) > 1 else ():
                    alone = dataclasses.replace(job, entries=(entry,))
                    again = self._submit(alone)
                    asked[again] = alone
                    waiting.add(again)
                continue
            for done, text in found:
                store.write_durable(store.part_path(out, done.identity), text)
                yield done

    def _submit(self, job: Job) -> Any:
        return self._client.submit(run_remote_job, jobs.to_text(job), pure=False)


def run_remote_job(spec: str) -> list[tuple[JobDone, str]]:
    """On a worker: run a job, and return what it has done with the text of each result."""
    job = jobs.from_text(spec, "a job")
    remove_stale_temp()
    with TempFolder() as out:
        return [
            (done, store.part_path(out, done.identity).read_text(encoding="utf-8"))
            for done in ProcessExecutor(1).run([job], out)
        ]
