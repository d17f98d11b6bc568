"""Results of fake estimators on a small task, and their board."""

from functools import cache

from fake_estimators import Broken, Learner, Reader
from fakes import fake_drives, task

from leaderboard.evaluation.evaluate import run_task
from leaderboard.evaluation.scores import score_arrays, scores_table
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
    return score_arrays(scores_table([result]), [score])[0]
