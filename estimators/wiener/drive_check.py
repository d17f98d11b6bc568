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
from estimators.wiener.segments import dominant_modes, split_segments
from estimators.wiener.spectral_model import (
    SensedVehicle,
    active_sensors,
    fit_hyperparameters,
    signal_psd,
    windowed_spectrum,
)
from estimators.wiener.tuning import TUNING
from road_envs.core.config import ConfigError
from road_envs.records.record import F_C, Record
from road_envs.sensing.instruments import Instruments, instruments_of
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.side_values import side_values

# Units in which a speed may be given without a word, and their factors to m/s
_SPEED_UNITS = {"km/h": 1.0 / 3.6, "mph": 0.44704}


@dataclass(frozen=True)
class _Alternative:
    """Another reading of a drive: what is `different` about its `record`, and what to do."""

    different: str
    remedy: str
    record: Record


def check_notes(
    record: Record, car: VehicleParameters, instruments: str, *, speed_known: bool = False
) -> tuple[str, ...]:
    """Return a note if the `record` of a drive of a `car` fits another description better.

    A drive that changes the state of its struts, or has few channels, is not checked. With
    `speed_known`, the speed is not doubted. Raises ConfigError, RecordError.
    """
    if record.is_switched or len(record.channels) < TUNING.least_channels:
        return ()
    part = _middle(record)
    described = deviance(part, car, instruments)
    others = list(_other_modes(part, car))
    if described[1] > TUNING.doubted_scale:
        others += _other_readings(part, speed_known)
    pairs = [(part, car), *((other.record, car) for other in others)]
    best, gain = _best_description(pairs, described, instruments, TUNING.check_gain)
    if not best:
        return ()
    other = others[best - 1]
    return (
        f"the record fits {other.different} better: {other.remedy} (deviance lower by "
        f"{gain:.2f} per spectral line)",
    )


_Deviance = tuple[float, float, float]


def _best_description(
    pairs: Sequence[tuple[Record, VehicleParameters]],
    described: _Deviance,
    instruments: str,
    least: float,
) -> tuple[int, float]:
    """Return the number of the record and vehicle that fit a drive better than the first of the
    `pairs`, which is `described`, with obstacles and without, and by how much; 0 if none do.
    """
    gains = [_clear_gain(described, deviance(*pair, instruments), least) for pair in pairs[1:]]
    best = 1 + int(np.argmax(gains)) if any(gains) else 0
    own, other = (
        deviance(_without_obstacles(record), car, instruments)
        for record, car in (pairs[0], pairs[best])
    )
    return (best, gains[best - 1]) if best and _clear_gain(own, other, least) else (0, 0.0)


def _clear_gain(described: _Deviance, other: _Deviance, least: float) -> float:
    """Return by how much the deviance is lower, per line and noise scale, 0 if not clearly."""
    smaller = max(1.0, min(described[1], other[1]))
    gain = (described[0] - other[0]) / (described[2] * smaller)
    return gain if gain > least * (2.0 if smaller > TUNING.far_scale else 1.0) else 0.0


def side_notes(record: Record, car: VehicleParameters, instruments: str) -> tuple[str, ...]:
    """Return a note if a vehicle that is held sideways in another way fits a drive better.

    Only where the description leaves little unexplained otherwise, and three sensors or more tell
    roll from heave and pitch. Raises ConfigError, RecordError.
    """
    if record.is_switched or len(record.channels) < TUNING.least_channels:
        return ()
    part = _middle(record)
    described = deviance(part, car, instruments)
    if described[1] > TUNING.doubted_scale:
        return ()
    others = list(_other_side_motions(car))
    pairs = [(part, car), *((part, other) for _, other in others)]
    best, gain = _best_description(pairs, described, instruments, TUNING.side_gain)
    if not best:
        return ()
    remedy = (
        "the IRI may be up to a fifth too low: give the vehicle's file its `side`"
        if car.side is None
        else "the mean of the wheel paths is not affected"
    )
    return (
        f"the record fits {others[best - 1][0]} better: left and right are not told apart as well "
        f"as the intervals say, {remedy} (deviance lower by {gain:.2f} per spectral line)",
    )


def _other_side_motions(car: VehicleParameters) -> Iterator[tuple[str, VehicleParameters]]:
    """Yield what holds a vehicle sideways in another way than described, and that vehicle. A
    passive car whose file has no `side` is noted without a trial.
    """
    if car.side is None:
        if not car.is_passive:
            yield "tyres that hold the vehicle sideways", replace(car, side=side_values(car))
        return
    yield "tyres that slide sideways", car.sliding
    (C_front, C_rear), (h_front, h_rear) = car.side.C_alpha, car.side.roll_centre
    for f in TUNING.side_factors:
        with suppress(ConfigError):  # beyond what any vehicle has
            stiff = replace(car.side, C_alpha=(f * C_front, f * C_rear))
            yield f"tyres that hold it sideways {f:g} times as stiffly", replace(car, side=stiff)
        with suppress(ConfigError):
            high = replace(car.side, roll_centre=(f * h_front, f * h_rear))
            yield f"roll centres {f:g} times as high", replace(car, side=high)


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
            other = replace(
                record,
                spring_stiff=np.full_like(record.spring_stiff, stiff),
                damper_high=np.full_like(record.damper_high, high),
            )
            yield _Alternative(f"the mode {name}", f"{names} is described (--mode)", other)


def _other_readings(record: Record, speed_known: bool = False) -> Iterator[_Alternative]:
    """Yield a record with other units of its speed, other signs, and exchanged channels."""
    for unit, factor in _SPEED_UNITS.items():
        if not speed_known:
            slower = replace(
                record,
                v=factor * record.v,
                s=factor * (record.s - record.s[0]),
                length=factor * record.length,
            )
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


def deviance(
    record: Record, car: VehicleParameters, instruments: str
) -> tuple[float, float, float]:
    """Return deviance, mean noise scale and number of independent lines of a record."""
    sensors: Instruments = instruments_of(record, instruments)
    (segment,) = split_segments(mask_record(record, sensors), np.inf, 0.0)
    model = fit_hyperparameters(SensedVehicle.of(car, sensors), segment)
    used, band = active_sensors(segment), (model.f > TUNING.f_low) & (model.f < F_C)
    y = windowed_spectrum(model, segment)[band][:, used]
    C = signal_psd(model, model.noise_psd())[band][:, used][:, :, used]
    misfit = np.real(np.sum(y.conj() * np.linalg.solve(C, y), axis=(1, 2)))
    # densities over frequency, not over distance: those of other speeds are compared
    log_det = np.linalg.slogdet(C)[1] - used.size * np.log(segment.v)
    independent = segment.a.shape[1] / model.size  # the circle is longer than the segment
    total = 2.0 * independent * float(np.sum(log_det + misfit))
    return total, float(np.mean(model.noise_scale)), float(independent * band.sum())


def _middle(record: Record) -> Record:
    """Return `checked_length` in the middle of a record, from station 0 on."""
    reach = 0.5 * TUNING.checked_length
    middle = 0.5 * (record.s[0] + record.s[-1])
    inside = np.flatnonzero(np.abs(record.s - middle) <= reach)
    part = record.select(slice(int(inside[0]), int(inside[-1]) + 1))
    s = part.s - part.s[0]
    return replace(part, t=part.t - part.t[0], s=s, length=float(s[-1]))
