"""Estimators for `check-estimator`: a valid one, and one for each defect.

They are loaded by name in the process of an entry.
"""

import dataclasses
import time
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from estimators.api import CalibrationError
from road_envs.records.record import Estimate, profile_stations


@dataclass(frozen=True, kw_only=True)
class Valid:
    """Each wheel path is proportional to its rear acceleration; lost samples are interpolated."""

    causal: ClassVar[bool] = False

    def estimate(self, record, car):
        stations = profile_stations(record.length)
        a = np.array([_smoothed(_interpolated(record.t, x)) for x in record.a[1:]])
        return Estimate(stations, -0.01 * record.interpolate(stations, a))


def _interpolated(t, x):
    valid = np.isfinite(x)
    return np.interp(t, t[valid], x[valid])


def _smoothed(x):
    """The mean over about 20 ms before and after a sample, without that of the drive."""
    return np.convolve(x - x.mean(), np.full(17, 1.0 / 17.0), "same")


@dataclass(frozen=True, kw_only=True)
class PassesMissingSamples(Valid):
    """Returns NaN where samples were lost."""

    def estimate(self, record, car):
        z = -0.01 * record.interpolate(profile_stations(record.length), record.a[1:])
        return Estimate(profile_stations(record.length), z)


@dataclass(frozen=True, kw_only=True)
class RefusesSome(Valid):
    """Refuses untrained strut modes on purpose, and short roads by an unintended error."""

    def estimate(self, record, car):
        if record.damper_high[0, 0] != record.spring_stiff[0, 0]:
            raise ValueError("struts of this kind were never seen")
        if record.length < 10.0:
            return np.zeros(3)[int(record.t.size)]
        return super().estimate(record, car)


@dataclass(frozen=True, kw_only=True)
class BreaksWhenCalibrated(Valid):
    """Cannot be calibrated, by an unintended error."""

    def calibrate(self, drives, car):
        return {}["drives"]


@dataclass(frozen=True, kw_only=True)
class RefusesCalibration(Valid):
    """Refuses short drives of calibration on purpose, by the error that is meant for it."""

    def calibrate(self, drives, car):
        ((length, road),) = ((drive.record.length, drive.profile) for drive in drives)
        raise CalibrationError(f"{length:g} m of road are too short, {road is not None}")


@dataclass(frozen=True, kw_only=True)
class NotCausal(Valid):
    """Claims to be causal but filters forward and backward."""

    causal: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class InMillimetres(Valid):
    """Returns heights in millimetres."""

    def estimate(self, record, car):
        estimate = super().estimate(record, car)
        return dataclasses.replace(estimate, z=1000.0 * estimate.z)


@dataclass(frozen=True, kw_only=True)
class NonDeterministic(Valid):
    """Adds random noise without a seed."""

    def estimate(self, record, car):
        estimate = super().estimate(record, car)
        noise = 1e-6 * np.random.default_rng().standard_normal(estimate.z.shape)
        return dataclasses.replace(estimate, z=estimate.z + noise)


@dataclass(frozen=True, kw_only=True)
class Slow(Valid):
    """Takes 0.1 s for each record."""

    def estimate(self, record, car):
        time.sleep(0.1)
        return super().estimate(record, car)


@dataclass(frozen=True, kw_only=True)
class SlowLearner(Slow):
    """Needs training, from which it takes nothing."""

    def fit(self, records, truths, car, seed):
        return self

    def weights(self):
        return {"none": np.zeros(1)}

    def with_weights(self, weights):
        return self


@dataclass(frozen=True, kw_only=True)
class ArraySetting(Valid):
    taps: Any = field(default_factory=lambda: np.ones(3))


@dataclass(frozen=True, kw_only=True)
class InfiniteSetting(Valid):
    cutoff: float = np.inf


@dataclass(frozen=True, kw_only=True)
class TabSetting(Valid):
    separator: str = "\t"


@dataclass(frozen=True, kw_only=True)
class Broken(Valid):
    def estimate(self, record, car):
        raise RuntimeError("out of order")


@dataclass
class NotFrozen:
    causal: ClassVar[bool] = False

    def estimate(self, record, car): ...


@dataclass(frozen=True)
class IncompleteTrainable(Valid):
    def fit(self, records, truths, car, seed): ...


@dataclass(frozen=True)
class WrongSignature(Valid):
    def estimate(self, record): ...


@dataclass(frozen=True)
class NegativeLag(Valid):
    lag: ClassVar[float] = -1.0
