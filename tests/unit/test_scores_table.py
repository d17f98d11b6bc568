"""Scores as a long table of runs, and as arrays for the statistics."""

import numpy as np
from fake_results import result_of, results_by_fakes, run_scores, runs_of, with_runs

from leaderboard.evaluation.results import RUN, score_arrays, scores_table


def test_the_table_of_several_results_has_a_row_for_every_score_of_every_run():
    table = scores_table(results_by_fakes())
    found = dict(zip(table[["estimator", *RUN, "score"]].itertuples(index=False, name=None),
                     table["value"], strict=True))  # fmt: skip
    expected = {
        (result.estimator, *run, name): value
        for result in results_by_fakes()
        if result.scores is not None
        for run, scores in runs_of(result).items()
        for name, value in scores.items()
    }
    assert found == expected and len(table) == len(expected) > 1000
    assert scores_table([result_of("broken")]).empty


def test_an_array_has_roads_conditions_and_seeds_wherever_the_runs_stand():
    table = result_of("learner").scores
    expected = run_scores(result_of("learner"), "nrmse")
    assert expected.shape == (5, 2, 3)
    by_road = table.sort_values(["drive", "seed"], ascending=[False, True], kind="stable")
    np.testing.assert_array_equal(score_arrays(by_road, ["nrmse"])[0], expected)
    for (label, drive, _, _, seed), scores in runs_of(result_of("learner")).items():
        condition = list(dict.fromkeys(table["condition"])).index(label)
        assert expected[drive, condition, seed - 1] == scores["nrmse"]


def test_a_run_that_is_missing_leaves_an_undefined_place():
    result = result_of("learner")
    fewer = with_runs(result, dict(list(runs_of(result).items())[1:]))
    found, whole = (run_scores(r, "nrmse") for r in (fewer, result))
    assert found.shape == whole.shape and np.isnan(found).sum() == 1
