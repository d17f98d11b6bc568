"""Estimators for fake drives, whose first two "accelerometers" measure the wheel paths.

A guest loads this module for each of them, so that it imports no more than an estimator needs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from estimators.api import CalibrationDrive, CalibrationError, NotFittedError
from road_envs.records.record import Estimate, Profile, Record, profile_stations


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
class Picky(Learner):
    """Its error is low at a low speed, where its training depends on `seeds`, else high."""

    seeds: tuple[int, ...] = (1, 2, 3)

    def fit(self, records: Sequence[Record], truths: Sequence[Profile], car, seed: int):
        twin, slow = replace(self), records[0].v[0] < 10.0
        gain = 0.9 + 1e-9 * seed * (seed in self.seeds) if slow else 0.5
        object.__setattr__(twin, "gain", gain)
        return twin


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
            case "masked":
                z = np.ma.array(z, mask=False)
                z[:, ::3] = np.ma.masked
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
