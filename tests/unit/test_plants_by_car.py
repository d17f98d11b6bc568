"""Scores of the board of foreign plants by plant and car."""

import pandas as pd
import pytest

from leaderboard.evaluation.tasks import load_task
from studies.plants_by_car import SCORES, TASKS, by_car


def test_scores_are_those_of_the_drives_of_a_plant_and_a_car():
    table = pd.DataFrame(
        {
            "task": name, "estimator": entry, "condition": condition.label,
            "score": score, "value": value + shift,
        }
        for name in TASKS
        for k, condition in enumerate(load_task(name).conditions)
        for score, value in zip(SCORES, (0.1, 0.2, 0.3, 0.4), strict=True)
        for entry, shift in (("one", 10.0 * k), ("another", 500.0))
    )  # fmt: skip
    found = by_car(table, "one")
    conditions = load_task("plants_known").conditions
    assert {condition.plant for condition in conditions} == {"mujoco", "commonroad"}
    for k, condition in enumerate(conditions):
        row = found.loc["plants_known", condition.plant, condition.car]
        assert row.tolist() == pytest.approx([10 * k + x for x in (0.1, 0.2, 0.3, 0.4)])
    own = [k for k, condition in enumerate(conditions) if condition.plant == "commonroad"]
    middle = 10.0 * sum(own) / len(own) + 0.1  # four conditions in a row
    assert found.loc["plants_known", "commonroad", "all"]["nrmse"] == pytest.approx(middle)
