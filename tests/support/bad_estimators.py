"""Estimators for `check-estimator`: an honest one, and one for each vice. Loaded by name, in the
process of an entry.
"""

import dataclasses
import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from road_envs.data.record import Estimate, profile_stations
from road_envs.sensing.filters import preprocess_accelerations


@dataclass(frozen=True, kw_only=True)
class Valid:
    """Left is made of one rear accelerometer, right of the other, whatever was lost bridged."""

    causal: ClassVar[bool] = False

    def estimate(self, record, car):
        stations = profile_stations(record.length)
        a = np.array([_bridged(record.t, x) for x in record.a[1:]])
        return Estimate(
            stations, -0.01 * record.interpolate(stations, preprocess_accelerations(a, record.fs))
        )


def _bridged(t, x):
    here = np.isfinite(x)
    return np.interp(t, t[here], x[here])


@dataclass(frozen=True, kw_only=True)
class PassesMissingSamples(Valid):
    """Lets lost samples through."""

    def estimate(self, record, car):
        z = -0.01 * record.interpolate(profile_stations(record.length), record.a[1:])
        return Estimate(profile_stations(record.length), z)


@dataclass(frozen=True, kw_only=True)
class RefusesSome(Valid):
    """Says what it will not have; of a road that is short it only stumbles."""

    def estimate(self, record, car):
        if record.damper_high[0, 0] != record.spring_stiff[0, 0]:
            raise ValueError("struts of this kind were never seen")
        if record.length < 10.0:
            return np.zeros(3)[int(record.t.size)]
        return super().estimate(record, car)


@dataclass(frozen=True, kw_only=True)
class NotCausal(Valid):
    """Says that it is causal, and filters both ways."""

    causal: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class NonDeterministic(Valid):
    """Another answer each time."""

    def estimate(self, record, car):
        told = super().estimate(record, car)
        noise = 1e-6 * np.random.default_rng().standard_normal(told.z.shape)
        return dataclasses.replace(told, z=told.z + noise)


@dataclass(frozen=True, kw_only=True)
class Slow(Valid):
    """Takes 0.1 s for any record."""

    def estimate(self, record, car):
        time.sleep(0.1)
        return super().estimate(record, car)


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
