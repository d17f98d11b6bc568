"""Check of a described drive: does its record fit another description better?

The accelerations are a Gaussian process under the vehicle linearised in a state of its struts
(`spectral_model.py`), with road level, spectral shape and noise fitted to them. The deviance of a
description is minus twice its log-likelihood by Whittle's approximation. Other modes of the
vehicle and, where much noise is left unexplained, speeds in other units, channels with the opposite
sign and exchanged channels are tried on 150 m in the middle of the drive, some tenths of a second
each.

Where the description explains the drive otherwise, vehicles that are held sideways in another way
are tried, too: three accelerometers can be explained by two wheel paths whatever the vehicle, but
not with the same likelihood.

Obstacles, where wheels lift off, are no part of a Gaussian process: a doubt has to be as clear
without what is beyond four standard deviations, and its surroundings.

The difference of the deviance is divided by the number of spectral lines, and by the smaller noise
scale of the two where that is above 1: a vehicle that is not the one described changes the deviance
of every description, and leaves more noise unexplained under each.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.stats import median_abs_deviation

from estimators.preprocessing import mask_record
from estimators.wiener import spectral_model
from estimators.wiener.segments import dominant_modes, split_segments
from estimators.wiener.tuning import TUNING
from road_envs.core.config import ConfigError
from road_envs.records.record import F_C, Record
from road_envs.sensing.instruments import instruments_of
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.side_values import side_values

# Units in which a speed may be given without a word, and their factors to m/s
_SPEED_UNITS = {"km/h": 1.0 / 3.6, "mph": 0.44704}


@dataclass(frozen=True)
class _Alternative:
    """Another description of a drive: what is `different` about its `record` or, if given, its
    `car`, and what to do.
    """

    different: str
    remedy: str
    record: Record
    car: VehicleParameters | None = None


_Deviance = tuple[float, float, float]  # deviance, mean noise scale, number of independent lines


def check_notes(
    record: Record, car: VehicleParameters, instruments: str, *, speed_known: bool = False
) -> tuple[str, ...]:
    """Return a note if the `record` of a drive of a `car` fits another description better.

    A drive that changes the state of its struts, or has few channels, is not checked. With
    `speed_known`, the speed is not doubted. Raises ConfigError, RecordError.
    """
    if (part := _middle(record)) is None:
        return ()
    described = _deviance(part, car, instruments)
    others = list(_other_modes(part, car))
    if described[1] > TUNING.doubted_scale:
        others += _other_readings(part, speed_known)
    return _note_on_best(part, car, instruments, described, others, TUNING.check_gain)


def side_notes(record: Record, car: VehicleParameters, instruments: str) -> tuple[str, ...]:
    """Return a note if a vehicle that is held sideways in another way fits a drive better.

    Only where the description leaves little unexplained otherwise, and three sensors or more tell
    roll from heave and pitch. Raises ConfigError, RecordError.
    """
    if (part := _middle(record)) is None:
        return ()
    described = _deviance(part, car, instruments)
    if described[1] > TUNING.doubted_scale:
        return ()
    others = list(_other_side_motions(part, car))
    return _note_on_best(part, car, instruments, described, others, TUNING.side_gain)


def _note_on_best(
    record: Record,
    car: VehicleParameters,
    instruments: str,
    described: _Deviance,
    others: Sequence[_Alternative],
    least: float,
) -> tuple[str, ...]:
    """Return a note on that of the `others` which fits best, if it fits a drive better than its
    description, with obstacles and without.
    """
    gains = [
        _clear_gain(described, _deviance(other.record, other.car or car, instruments), least)
        for other in others
    ]
    if not any(gains):
        return ()
    best = others[int(np.argmax(gains))]
    own = _deviance(_without_obstacles(record), car, instruments)
    other = _deviance(_without_obstacles(best.record), best.car or car, instruments)
    if not _clear_gain(own, other, least):
        return ()
    return (
        f"the record fits {best.different} better: {best.remedy} (deviance lower by "
        f"{max(gains):.2f} per spectral line)",
    )


def _clear_gain(described: _Deviance, other: _Deviance, least: float) -> float:
    """Return by how much the deviance is lower, per line and noise scale, 0 if not clearly."""
    smaller = max(1.0, min(described[1], other[1]))
    gain = (described[0] - other[0]) / (described[2] * smaller)
    return gain if gain > least * (2.0 if smaller > TUNING.far_scale else 1.0) else 0.0


def _other_side_motions(record: Record, car: VehicleParameters) -> Iterator[_Alternative]:
    """Yield a drive of vehicles that are held sideways in another way than described. A passive
    car whose file has no `side` is noted without a trial.
    """
    blurred = "left and right are not told apart as well as the intervals say, "
    if car.side is None:
        if not car.is_passive:
            remedy = "the IRI may be up to a fifth too low: give the vehicle's file its `side`"
            held = replace(car, side=side_values(car))
            yield _Alternative(
                "tyres that hold the vehicle sideways", blurred + remedy, record, held
            )
        return
    remedy = blurred + "the mean of the wheel paths is not affected"
    yield _Alternative("tyres that slide sideways", remedy, record, car.sliding)
    (C_front, C_rear), (h_front, h_rear) = car.side.C_alpha, car.side.roll_centre
    for f in TUNING.side_factors:
        with suppress(ConfigError):  # beyond what any vehicle has
            stiff = replace(car, side=replace(car.side, C_alpha=(f * C_front, f * C_rear)))
            different = f"tyres that hold it sideways {f:g} times as stiffly"
            yield _Alternative(different, remedy, record, stiff)
        with suppress(ConfigError):
            high = replace(car, side=replace(car.side, roll_centre=(f * h_front, f * h_rear)))
            yield _Alternative(f"roll centres {f:g} times as high", remedy, record, high)


def _without_obstacles(record: Record) -> Record:
    """Return a record whose samples about obstacles are lost."""
    near, a = obstacle_samples(record), record.a.copy()
    if near.mean() < TUNING.most_left_out:
        a[:, near] = np.nan
    return replace(record, a=a)


def obstacle_samples(record: Record) -> np.ndarray:
    """Return which samples (N,) of a record are about obstacles."""
    a = np.where(np.isfinite(record.a), record.a, 0.0)
    a -= np.median(a, axis=1, keepdims=True)
    std = median_abs_deviation(a, axis=1, scale="normal")
    far = (np.abs(a) > TUNING.far_out * std[:, None]).any(axis=0)
    return np.asarray(maximum_filter1d(far, 2 * round(TUNING.surroundings * record.fs) + 1))


def _other_modes(record: Record, car: VehicleParameters) -> Iterator[_Alternative]:
    """Yield a record in the other modes of its car."""
    described = dominant_modes(record, np.arange(record.t.size), car.modes)
    names = " and ".join(dict.fromkeys(described.values()))
    for name, (stiff, high) in car.modes.items():
        if set(described.values()) != {name}:
            springs = np.full_like(record.spring_stiff, stiff)
            dampers = np.full_like(record.damper_high, high)
            other = replace(record, spring_stiff=springs, damper_high=dampers)
            yield _Alternative(f"the mode {name}", f"{names} is described (--mode)", other)


def _other_readings(record: Record, speed_known: bool = False) -> Iterator[_Alternative]:
    """Yield a record with other units of its speed, other signs, and exchanged channels."""
    for unit, factor in _SPEED_UNITS.items():
        if not speed_known:
            v, s = factor * record.v, factor * (record.s - record.s[0])
            slower = replace(record, v=v, s=s, length=factor * record.length)
            given = f"{3.6 * np.median(record.v):.0f} km/h"
            yield _Alternative(
                f"a speed of {3.6 * factor * np.median(record.v):.0f} km/h",
                f"{given} is described; is the speed in {unit} (--units v={unit})?",
                slower,
            )
    for k, name in enumerate(record.channels):
        sign = np.where(np.arange(len(record.channels)) == k, -1.0, 1.0)
        column = f"a_{name.lower()}"
        yield _Alternative(
            f"the opposite sign of {name}",
            f"does its axis point down (--invert {column})?",
            replace(record, a=sign[:, None] * record.a),
        )
    pairs = combinations(range(len(record.channels)), 2)
    for i, j in pairs if len(record.channels) <= TUNING.max_exchanged else ():
        order = np.arange(len(record.channels))
        order[[i, j]] = j, i
        yield _Alternative(
            f"{record.channels[i]} and {record.channels[j]} exchanged",
            "check which column is which (--columns)",
            replace(record, a=record.a[order]),
        )


def _deviance(record: Record, car: VehicleParameters, instruments: str) -> _Deviance:
    """Return the deviance of a record under the description of its `car`."""
    sensors = instruments_of(record, instruments)
    (segment,) = split_segments(mask_record(record, sensors), np.inf, 0.0)
    vehicle = spectral_model.SensedVehicle.of(car, sensors)
    model = spectral_model.fit_hyperparameters(vehicle, segment)
    used = spectral_model.active_sensors(segment)
    band = (model.f > TUNING.f_low) & (model.f < F_C)
    y = spectral_model.windowed_spectrum(model, segment)[band][:, used]
    C = spectral_model.signal_psd(model, model.noise_psd())[band][:, used][:, :, used]
    misfit = np.real(np.sum(y.conj() * np.linalg.solve(C, y), axis=(1, 2)))
    # densities over frequency, not over distance: those of other speeds are compared
    log_det = np.linalg.slogdet(C)[1] - used.size * np.log(segment.v)
    independent = segment.a.shape[1] / model.size  # the circle is longer than the segment
    total = 2.0 * independent * float(np.sum(log_det + misfit))
    return total, float(np.mean(model.noise_scale)), float(independent * band.sum())


def _middle(record: Record) -> Record | None:
    """Return `checked_length` in the middle of a record, from station 0 on; None if the state of
    the struts changes or the channels are few, as such a record is not checked.
    """
    if record.is_switched or len(record.channels) < TUNING.least_channels:
        return None
    reach = 0.5 * TUNING.checked_length
    middle = 0.5 * (record.s[0] + record.s[-1])
    inside = np.flatnonzero(np.abs(record.s - middle) <= reach)
    part = record.select(slice(int(inside[0]), int(inside[-1]) + 1))
    s = part.s - part.s[0]
    return replace(part, t=part.t - part.t[0], s=s, length=float(s[-1]))
