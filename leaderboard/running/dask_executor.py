"""Execution of jobs on a Dask cluster: jobs and their files are sent, results are returned as text.

Workers need the same version of this package and nothing else: surfaces, vehicles, instruments and
the code of entries travel through the scheduler, as do the results. The scheduler reassigns a job
whose worker dies.
"""

import asyncio
import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from leaderboard.evaluation import store
from leaderboard.running import jobs
from leaderboard.running.executors import ProcessExecutor
from leaderboard.running.jobs import Job, JobDone
from road_envs.core.atomic_io import TempFolder, remove_stale_temp
from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import

LOCAL = "local"
"""In place of an address: a cluster of processes of this machine, for the time of a run."""

SCHEDULER_TIMEOUT = 4.0  # timeout [s] for connecting to the scheduler, and for its first worker


class DaskExecutor(contextlib.ExitStack):
    """Runs jobs on the cluster whose scheduler has `address`, such as "tcp://host:8786".

    With LOCAL it starts `workers` processes of this machine, which end with it.
    """

    def __init__(self, address: str, workers: int = 1):
        """Raises ConfigError if the scheduler does not answer or has no worker.

        Raises MissingExtraError without Dask.
        """
        super().__init__()
        with optional_import("running on a cluster"):
            from distributed import Client, LocalCluster
        if address == LOCAL:
            cluster = self.enter_context(LocalCluster(
                n_workers=workers, threads_per_worker=1, memory_limit=None, dashboard_address=None
            ))  # fmt: skip
            client = Client(cluster, set_as_default=False)
        else:
            _check_address(address)
            client = Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
        self._client = self.enter_context(client)
        try:
            self._client.wait_for_workers(1, timeout=SCHEDULER_TIMEOUT)
        except TimeoutError:
            raise ConfigError(
                f"the Dask scheduler at {address!r} has no worker; start one with `dask worker`"
            ) from None
        self.workers = sum(self._client.nthreads().values())
        self._sent: dict[str, Any] = {}

    def run(self, jobs_: Sequence[Job], out: Path) -> Iterator[JobDone]:
        """Run all jobs and store their results. Raises ConfigError, EvaluatorError of a job."""
        from distributed import KilledWorker, as_completed

        submitted = {self._submit(job): job for job in jobs_}
        futures = as_completed(submitted, loop=self._client.loop)
        for future in futures:
            job = submitted.pop(future)
            try:
                results = future.result()
            except KilledWorker:  # the job killed several workers: run its entries one at a time
                if len(job.entries) == 1:
                    yield jobs.record_crash(job, "its worker died", out)
                for entry in job.entries if len(job.entries) > 1 else ():
                    alone = dataclasses.replace(job, entries=(entry,))
                    submitted[again := self._submit(alone)] = alone
                    futures.add(again)
                continue
            for done, text in results:
                store.save_part(text, out, done.identity)
                yield done

    def _submit(self, job: Job) -> Any:
        text, sources = jobs.to_packed_text(job)
        for name, source in sources.items():
            if name not in self._sent:  # a task, unlike scattered data, outlives its worker
                self._sent[name] = self._client.submit(bytes, source.read_bytes(), key=name)
        contents = [self._sent[name] for name in sources]
        return self._client.submit(_run_remote_job, text, list(sources), *contents, pure=False)


def _check_address(address: str) -> None:
    """Raise ConfigError if no Dask scheduler answers at an address.

    A client that could not connect would wait for a minute when it is discarded.
    """
    from distributed.core import connect

    async def probe() -> None:
        await (await connect(address, timeout=SCHEDULER_TIMEOUT)).close()

    try:
        asyncio.run(probe())
    except Exception as error:  # a server of another protocol may answer anything
        reason = " ".join(str(error).split())
        raise ConfigError(f"no Dask scheduler answers at {address!r}: {reason}") from None


def _run_remote_job(spec: str, names: Sequence[str], *contents: bytes) -> list[tuple[JobDone, str]]:
    """Run a packed job on a Dask worker; return the summary and text of each result.

    `names` are the paths of its files relative to that of the job.
    """
    remove_stale_temp()
    with TempFolder() as folder, TempFolder() as out:
        for name, content in zip(names, contents, strict=True):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        job = jobs.from_text(spec, "a job", folder)
        return [
            (done, store.part_path(out, done.identity).read_text(encoding="utf-8"))
            for done in ProcessExecutor(1).run([job], out)
        ]
