"""Runs of a small task with fake drives, for tests of the board."""

import dataclasses
import functools
import shutil
import tempfile
from pathlib import Path

from fake_estimators import Learner, Reader
from fakes import fake_drives, task
from in_process import InProcessExecutor

from leaderboard.entries.entries import make_entry
from leaderboard.evaluation.results import to_plain
from leaderboard.metrics.baselines import BASELINES
from leaderboard.running.board import RunRequest, run_board

SHORT = {
    "training": {"roads": ["iso_d"], "seeds": [1], "length": 16.0},
    "test": {"roads": ["iso_d"], "seeds": [11, 12, 13], "length": 16.0},
}
"""Very short roads, since the scores do not matter here."""

ESTIMATORS = {"reader": Reader(), "learner": Learner()}
NAMES = {*ESTIMATORS, *BASELINES}
PARTS = 2 * len(NAMES)


@functools.cache
def small(**changes):
    return task(**{**SHORT, **changes})


def make_request(estimators=ESTIMATORS, t=None, **options):
    entries = [make_entry(name, estimator) for name, estimator in estimators.items()]
    return RunRequest([t or small()], entries, **{"seeds": (1, 2), **options})


class Counting(InProcessExecutor):
    """Runs jobs in this process and records them."""

    def __init__(self, estimators=ESTIMATORS, simulate=fake_drives):
        super().__init__(simulate, estimators)
        self.ran = []

    def run(self, jobs_, out):
        for done in super().run(jobs_, out):
            self.ran.append((done.entry, done.condition))
            yield done


def run(out, estimators=ESTIMATORS, **options):
    """Return the board, and the entries and conditions that were run."""
    executor = Counting(estimators)
    board = run_board(make_request(estimators, **options), out, executor)
    return board, executor.ran


def copy_of_run(out):
    """Put what `run` stores into a folder: it is made once."""
    shutil.copytree(_stored().name, out, dirs_exist_ok=True)


@functools.cache
def _stored():
    made = tempfile.TemporaryDirectory()
    run(Path(made.name))
    return made


def rows(board):
    """Return the results without timings and environment."""
    return {
        (name, r.estimator): to_plain(
            dataclasses.replace(r, train_seconds=(), estimate_ms_per_100m=None, environment={})
        )
        for name, results in board.results.items()
        for r in results
    }


def quick_scores(scored):
    error = (scored.a - scored.y).std()
    return {"nrmse": float(error / scored.y.std()), "r": scored.v, "lag": float("nan")}
