"""Groups of the runs of a task: by condition, family of roads, grade of car, frequency of frame."""

from itertools import pairwise

import numpy as np

from leaderboard.evaluation.tasks import Task

ScoreSlice = tuple[list[int] | slice | np.ndarray, list[int] | slice | np.ndarray]
"""Index of roads and of conditions into scores (R, C, S), which keeps both axes."""

FRAME_BANDS = (0.0, 10.0, 14.0, 100.0)  # limits of the groups of frames [Hz]


def run_groups(task: Task) -> dict[str, dict[str, ScoreSlice]]:
    """Return the groups of runs of a task by kind, if it has several, and name."""
    every, design = slice(None), task.test.design

    def runs(conditions: list[int]) -> ScoreSlice:  # of the roads that are driven under them
        if not design:
            return every, conditions
        roads = sorted({road for k in conditions for road in design[k]})
        return np.array(roads)[:, None], conditions

    def of_conditions(names: list[str]) -> dict[str, ScoreSlice]:
        return {name: runs([k for k, x in enumerate(names) if x == name]) for name in names}

    kinds: dict[str, dict[str, ScoreSlice]] = {
        "condition": of_conditions([c.label for c in task.conditions]),
        "family": {x: (task.test.indices_of_family(x), every) for x in task.test.families},
        "car": of_conditions([f"car {c.grade}" for c in task.conditions]),
        "frame": _frames(task),
    }
    return {kind: parts for kind, parts in kinds.items() if len(parts) > 1}


def _frames(task: Task) -> dict[str, ScoreSlice]:
    """Return the runs of vehicles whose frame twists, by its frequency in FRAME_BANDS."""
    flexible = [k for k, c in enumerate(task.conditions) if c.grade in ("S2", "S3", "S4")]
    if not flexible:
        return {}
    grade = task.conditions[flexible[0]].grade
    roads = range(len(task.test.roads_and_seeds))
    frames = {k: task.individual(k, grade).car.variation.frame for k in roads}
    known = {k: frame.f for k, frame in frames.items() if frame}
    groups = {
        f"frame {low:g} to {high:g} Hz": [k for k, f in known.items() if low <= f < high]
        for low, high in pairwise(FRAME_BANDS)
    }
    # column of roads against row of conditions: indexed together, they keep both axes
    at = np.array(flexible)
    return {name: (np.array(members)[:, None], at) for name, members in groups.items() if members}
