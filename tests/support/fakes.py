"""Fake drives and estimators for tests of the evaluation.

The first two "accelerometers" measure the heights of the wheel paths, so that the error of an
estimator can be chosen and a drive takes a millisecond.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from estimators.api import CalibrationDrive, CalibrationError, NotFittedError
from leaderboard.evaluation.tasks import Condition, DriveSet, Task
from leaderboard.evaluation.test_data import RecordedDrive
from road_envs.config import build
from road_envs.data.record import Estimate, Profile, Record, profile_stations

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


@dataclass(frozen=True, kw_only=True)
class Reader:
    """Estimates the truth times `gain`."""

    causal: ClassVar[bool] = False

    gain: float = 0.9

    def estimate(self, record, car) -> Estimate:
        stations = profile_stations(record.length)
        return Estimate(stations, self.gain * record.interpolate(stations, record.a[:2]))


@dataclass(frozen=True, kw_only=True)
class Learner:
    """Its gain is drawn in training with standard deviation `spread`."""

    causal: ClassVar[bool] = False

    spread: float = 0.2
    gain: float = field(default=np.nan, init=False)

    def fit(self, records: Sequence[Record], truths: Sequence[Profile], car, seed: int):
        twin = replace(self)
        drawn = 1.0 + self.spread * np.random.default_rng(seed).standard_normal()
        object.__setattr__(twin, "gain", drawn)
        return twin

    def estimate(self, record, car) -> Estimate:
        return Reader(gain=self.gain).estimate(record, car)

    def weights(self) -> dict[str, np.ndarray]:
        if np.isnan(self.gain):
            raise NotFittedError("call fit() first")
        return {"gain": np.array([self.gain])}

    def with_weights(self, weights: Mapping[str, np.ndarray]):
        return self


@dataclass(frozen=True, kw_only=True)
class CalibratedReader(Reader):
    """Its gain is the greatest height of the last measured road, or else the number of drives."""

    how: str = "works"

    def calibrate(self, drives: Sequence[CalibrationDrive], car):
        if self.how == "raises":
            raise CalibrationError(f"{drives[0].name}: too smooth")
        gain = float(len(drives))
        for drive in drives:
            if drive.profile is not None:
                gain = float(np.abs(drive.profile.z).max()) + drive.survey_std
        return replace(self, gain=gain)


@dataclass(frozen=True, kw_only=True)
class Doubtful:
    """Estimates zero heights with the standard deviation `std`."""

    causal: ClassVar[bool] = False

    std: float

    def estimate(self, record, car) -> Estimate:
        stations = profile_stations(record.length)
        z = np.zeros((stations.size, 2)).T  # Fortran order, as some numpy code returns
        return Estimate(stations, z, np.full_like(z, self.std))


@dataclass(frozen=True, kw_only=True)
class Broken:
    """Fails in the way given by `how`."""

    causal: ClassVar[bool] = True

    how: str

    def estimate(self, record, car) -> Estimate:
        stations = profile_stations(record.length)
        z = np.zeros((2, stations.size))
        match self.how:
            case "raises":
                raise RuntimeError("no idea")
            case "exits":
                raise SystemExit(3)
            case "nan":
                z[1, 5] = np.nan
            case "short":
                stations, z = stations[:-1], z[:, :-1]
            case "one path":
                z = z[0]
            case "scribbles":
                record.a[:] = 0.0
            case "text":
                return "a road"
            case "absurd":
                z[:] = 1e200 * np.sin(stations)
        return Estimate(stations, z)
