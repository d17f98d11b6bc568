"""Groups of the runs of a task."""

import dataclasses
from itertools import pairwise

import numpy as np

from leaderboard.evaluation.tasks import load_task
from leaderboard.report.run_groups import FRAME_BANDS, run_groups
from leaderboard.report.site import _drive_counts
from road_envs.sensing.perturbed_vehicle import perturb_vehicle


def test_runs_are_grouped_by_the_frequency_of_the_frame():
    task = load_task("field")
    R, C = len(task.test.roads_and_seeds), len(task.conditions)
    scores = np.arange(R * C, dtype=float).reshape(R, C, 1)
    found: list[float] = []
    for name, part in run_groups(task)["frame"].items():
        low, high = (float(x) for x in name.removeprefix("frame ").split(" Hz")[0].split(" to "))
        assert (low, high) in list(pairwise(FRAME_BANDS))
        members = scores[part]
        assert members.ndim == 3
        found += members.ravel().tolist()
        for value in members.ravel().astype(int):
            road, condition = divmod(value, C)
            assert task.conditions[condition].grade in ("S2", "S3")
            seed = np.random.SeedSequence(task.test.roads_and_seeds[road][1])
            frame = perturb_vehicle(task.vehicle, "S3", seed).car.variation.frame
            assert low <= frame.f < high
    assert len(found) == len(set(found)) == R * C // 2


def test_a_task_without_flexible_cars_has_no_group_of_frames():
    assert "frame" not in run_groups(load_task("new_road"))


def test_a_group_of_a_condition_has_the_roads_that_are_driven_under_it():
    """Others would be drawn by a bootstrap, and tell nothing."""
    task = load_task("new_road")
    scores = np.full((len(task.test.roads_and_seeds), len(task.conditions), 1), np.nan)
    for k, condition in enumerate(task.conditions):
        for drive, _, _ in task.drives_of(task.test, condition):
            scores[drive, k] = k
    for k, part in enumerate(run_groups(task)["condition"].values()):
        members = scores[part]
        assert members.shape == (len(task.test.design[k]), 1, 1) and (members == k).all()


def test_a_page_tells_how_many_drives_a_condition_has():
    task = load_task("new_road")
    assert "conditions: 7, each with 10 training and 2 test drives;" in _drive_counts(task, [])
    design = (task.test.design[0][:1], *task.test.design[1:], task.test.design[0][1:])
    test = dataclasses.replace(task.test, design=design)
    conditions = (*task.conditions, dataclasses.replace(task.conditions[0], speed_kmh=33.0))
    uneven = dataclasses.replace(task, test=test, conditions=conditions)
    assert "conditions: 8, each with 10 training and 1 to 2 test drives;" in (
        _drive_counts(uneven, [])
    )
