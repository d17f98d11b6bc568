"""Results of fake estimators on a small task, and their board."""

import dataclasses
from functools import cache

from fake_estimators import Broken, Learner, Reader
from fakes import fake_drives, task

from leaderboard.evaluation.comparison import scores_by_run
from leaderboard.evaluation.evaluate import run_task
from leaderboard.evaluation.results import make_table, score_arrays
from leaderboard.running.board import Board

ENTRIES = {
    "reader": Reader(),
    "learner": Learner(),
    "broken": Broken(how="nan"),
    "flat": Reader(gain=0.0),
    "truth_plus_noise": None,
}


@cache
def results_by_fakes():
    return tuple(run_task(task(), ENTRIES, (1, 2, 3), simulate=fake_drives))


def result_of(name):
    return next(r for r in results_by_fakes() if r.estimator == name)


def board():
    return Board((task(),), {"small": results_by_fakes()})


def run_scores(result, score):
    """One score (R, C, S) of the runs of a result: roads, conditions, training seeds."""
    return score_arrays(result.scores, [score])[0]


def runs_of(result):
    """Scores by name of each run of a result: (condition, drive, road, road_seed, seed)."""
    return scores_by_run(result.scores)


def with_runs(result, runs):
    """The result with the runs of a mapping as that of `runs_of`; None leaves a score out."""
    rows = [(*run, k, x) for run, own in runs.items() for k, x in own.items() if x is not None]
    return dataclasses.replace(result, scores=make_table(rows))


def with_last_run(result, change):
    """The result with `change(scores)` for the scores of its last run."""
    runs = runs_of(result)
    last = next(reversed(runs))
    return with_runs(result, {**runs, last: change(runs[last])})
