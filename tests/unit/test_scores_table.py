"""Scores as a table of runs, and as arrays for the statistics."""

import dataclasses

import numpy as np
from fake_results import result_of, results_by_fakes, run_scores

from leaderboard.evaluation.scores import score_arrays, scores_table
from leaderboard.metrics.registry import SCORES


def test_the_table_has_a_row_for_every_run_with_its_scores():
    results = results_by_fakes()
    table = scores_table(results)
    runs = [(result.estimator, drive) for result in results for drive in result.drives]
    for (name, drive), (_, row) in zip(runs, table.iterrows(), strict=True):
        found = row[["estimator", "condition", "drive", "road", "road_seed", "seed"]].tolist()
        place = [drive.condition, drive.drive, drive.road, drive.road_seed, drive.seed]
        assert found == [name, *place]
        assert row[[*SCORES]].dropna().to_dict() == drive.scores


def test_an_array_has_roads_conditions_and_seeds_wherever_the_runs_stand():
    table = scores_table([result_of("learner")])
    expected = run_scores(result_of("learner"), "nrmse")
    assert expected.shape == (5, 2, 3)
    by_road = table.sort_values(["drive", "seed"], ascending=[False, True], kind="stable")
    np.testing.assert_array_equal(score_arrays(by_road, ["nrmse"])[0], expected)


def test_a_run_that_is_missing_leaves_an_undefined_place():
    result = result_of("learner")
    fewer = dataclasses.replace(result, drives=result.drives[1:])
    found, whole = (run_scores(r, "nrmse") for r in (fewer, result))
    assert found.shape == whole.shape and np.isnan(found).sum() == 1
