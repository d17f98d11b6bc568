"""Scores of results as one table, a row for each run, and as arrays for the statistics.

A run is one estimate: of an estimator, under a condition, on a test drive, after one training.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from leaderboard.evaluation.results import Result
from leaderboard.metrics.registry import SCORES

if TYPE_CHECKING:
    import pandas as pd


def scores_table(results: Iterable[Result]) -> "pd.DataFrame":
    """Table of the scores of all runs: estimator, condition, drive, road, road_seed, seed, SCORES.

    Scores are as computed, not scaled for printing; NaN where one is undefined.
    """
    import pandas as pd  # slow to load: only where a table is made

    runs = [(result.estimator, drive) for result in results for drive in result.drives]
    columns: dict[str, list] = {"estimator": [name for name, _ in runs]}
    for name in ("condition", "drive", "road", "road_seed", "seed"):
        columns[name] = [getattr(drive, name) for _, drive in runs]
    scores = [[drive.scores.get(name, np.nan) for name in SCORES] for _, drive in runs]
    values = np.array(scores, dtype=float).reshape(len(runs), len(SCORES))
    return pd.DataFrame(columns).join(pd.DataFrame(values, columns=list(SCORES)))


def score_arrays(runs: "pd.DataFrame", scores: Sequence[str] = tuple(SCORES)) -> np.ndarray:
    """Scores (K, R, C, S) of the runs of one estimator: roads, conditions, training seeds.

    Roads are in the order of the task. NaN where a road was not driven under a condition and where
    a score is undefined.
    """
    roads, at_road = np.unique(runs["drive"], return_inverse=True)
    at_condition, conditions = runs["condition"].factorize()
    at_seed, seeds = runs["seed"].factorize()
    arrays = np.full((len(scores), len(roads), len(conditions), len(seeds)), np.nan)
    arrays[:, at_road, at_condition, at_seed] = runs[list(scores)].to_numpy().T
    return arrays
