"""Executor of jobs in this process, without isolation."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from estimators import make_estimator
from estimators.api import Estimator
from leaderboard.entries.entry import Entry, TrainingRun
from leaderboard.evaluation import evaluate
from leaderboard.evaluation.evaluate import ConditionData
from leaderboard.evaluation.test_data import DriveSimulation, simulate_drives
from leaderboard.running import jobs
from leaderboard.running.jobs import Job, JobDone


class InProcessExecutor:
    """Runs jobs in this process.

    `estimators` are used by name of the entry; others are constructed from their entry.
    """

    workers = 1

    def __init__(
        self,
        simulate: DriveSimulation = simulate_drives,
        estimators: Mapping[str, Estimator | None] | None = None,
    ):
        self._simulate, self._estimators = simulate, estimators or {}

    def run(self, jobs_: Sequence[Job], out: Path) -> Iterator[JobDone]:
        """Run jobs one after the other; skip further conditions of an entry that failed."""
        failed: set[tuple[str, str]] = set()
        for job in jobs_:
            entries = [e for e in job.entries if (job.task.name, e.name) not in failed]
            condition = job.task.conditions[job.condition]
            data = evaluate.simulate_condition(job.task, condition, self._simulate)
            left = dataclasses.replace(job, entries=tuple(entries))
            for done in jobs.run_job(left, data, out, self._run_entry):
                if done.failure is not None:
                    failed.add((done.task, done.entry))
                yield done

    def _run_entry(
        self, entry: Entry, data: ConditionData, seeds: Sequence[int]
    ) -> Iterator[TrainingRun]:
        estimator = self._estimators.get(entry.name)
        estimator = estimator or make_estimator(entry.reference, **entry.settings)
        yield from evaluate.in_process(estimator)(entry, data, seeds)
