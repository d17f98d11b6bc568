"""Fake drives for tests of the evaluation.

The first two "accelerometers" measure the heights of the wheel paths, so that the error of an
estimator can be chosen and a drive takes a millisecond.
"""

import numpy as np

from estimators import create
from estimators.api import Estimator
from leaderboard.evaluation.drive_set import DriveSet
from leaderboard.evaluation.tasks import Condition, Task
from leaderboard.evaluation.test_data import RecordedDrive
from leaderboard.metrics.baselines import ALL_BASELINES, MEMORY, TRUTH_PLUS_NOISE
from road_envs.core.config import build
from road_envs.records.record import Profile, Record, profile_stations

RATE = 400.0

SHORT_TASK = """
name: short
title: A short task
board: {title: Short}
version: 1
car: land_rover_defender_110
instruments: paper
conditions: [{mode: ride, speed_kmh: 36.0}]
training: {roads: [iso_d], seeds: [1], length: 20.0}
test: {roads: [iso_c], seeds: [1001], length: 20.0}
"""
"""A task file with one short drive, for commands in processes of their own."""


def task(name: str = "small", **changes) -> Task:
    """A task of two conditions on class-D roads of 40 m."""
    settings = {
        "name": name,
        "title": "Two short roads",
        "board": "new_road",
        "version": 1,
        "car": "land_rover_defender_110",
        "instruments": "paper",
        "conditions": [
            {"mode": "ride", "speed_kmh": 14.5},
            {"mode": {"front": "ride", "rear": "handling"}, "speed_kmh": 54.0},
        ],
        "training": {"roads": ["iso_d"], "seeds": [1, 2], "length": 40.0},
        "test": {"roads": ["iso_d"], "seeds": [11, 12, 13, 14, 15], "length": 40.0},
    }
    return build(Task, {**settings, **changes}, name)


def fake_drives(task: Task, drives: DriveSet, condition: Condition):
    """As `test_data.simulate_drives`, with sensors that measure the road itself."""
    for index, road, seed in task.drives_of(drives, condition):
        surface = road.realise(np.random.default_rng(seed))
        v = condition.speed_kmh / 3.6
        t = np.arange(int(surface.length / v * RATE) + 2) / RATE
        s = v * t
        noise = np.random.default_rng([seed, 1]).standard_normal((1, t.size))
        state = np.zeros((t.size, 4), dtype=bool)
        a = np.concatenate([surface.height(s), noise])
        record = Record(t, a, np.full(t.size, v), s, state, state, surface.length)
        stations = profile_stations(surface.length)
        truth = Profile(stations, surface.height(stations))
        yield RecordedDrive(index, surface.name, seed, record, truth, surface.notes)


def baselines() -> dict[str, Estimator | None]:
    """All baselines by name; None is one that the evaluation makes from the truth."""
    made = (TRUTH_PLUS_NOISE, MEMORY)
    return {name: None if name in made else create(name) for name in ALL_BASELINES}
