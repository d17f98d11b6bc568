"""The estimate of a record, or of several passes over one road, in one call."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estimators.api import Estimator, check_estimate
from estimators.common.blas import single_blas_thread
from estimators.common.explained import mark_impossible
from estimators.common.gaps import mark_gaps
from estimators.common.manoeuvres import mark_manoeuvres
from estimators.common.odometer import calibrate_odometer
from estimators.lookup import resolve_estimator, training_notes
from estimators.passes import estimate_passes
from road_envs.core.config import ConfigError
from road_envs.records.record import Estimate, Record
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.suspension import check_modes, friction_peaks

_HELD = 1.25
"""RMS of the accelerations over what friction passes on, below which the struts hold mostly.

Below it are classes A up to 54 km/h, and B at 14.5 in ride and mixed states and at 36 in ride. Of
described and field cars (seeds 9700 and 9701) `map_smoother` errs there by 0.15 to 0.66 times the
road and `kalman_lag` by 0.33 to 4.7 times, with 47 to 95 % of the errors inside 90 %.
"""


@single_blas_thread()  # threads that wait for each other take two thirds more processor time
def estimate(
    estimator: str | Path | Estimator,
    record: Record | Sequence[Record],
    vehicle: str | Path | VehicleParameters | Sequence[Any] = "land_rover_defender_110",
    **settings: Any,
) -> Estimate:
    """Reconstruct both wheel paths from a record, or from those of several passes over one road
    (`estimators.passes`), each with a `vehicle` of its own or one for all. `estimator` is an
    object, or what `make_estimator` takes with its `settings`; `vehicle` is the described car, by
    name, YAML file or parameters. The estimate keeps the median speed of the record, which decides
    the band in which it can be scored, and the standard deviation of its stations where the
    positions wander. Raises ConfigError, EstimateError, NotFittedError if the estimator must be
    trained first, and TypeError for arguments of another kind.
    """
    given = [record] if isinstance(record, Record) else record
    if not isinstance(given, Sequence) or not all(isinstance(each, Record) for each in given):
        raise TypeError(
            "estimate takes an estimator, then a Record or several in a list, then the vehicle; "
            f"the second argument is a {type(record).__name__}"
        )
    if not isinstance(record, Record):
        return estimate_passes(estimator, record, vehicle, **settings)
    if not isinstance(vehicle, str | Path | VehicleParameters):
        raise ConfigError(f"one record needs one vehicle, got {len(vehicle)}")
    estimator = resolve_estimator(estimator, settings)
    car = vehicle if isinstance(vehicle, VehicleParameters) else load_vehicle(vehicle)
    check_modes(record, car)
    found = estimator.estimate(record, car)
    check_estimate(found, record)
    notes = *friction_note(record, car), *found.notes, *training_notes(estimator, record, car)
    if car.is_passive and car.side is None:
        notes += (
            f"{car.name} has no side motion in its file: on cars of other simulators a model "
            "without it took half of the difference between the wheel paths for another and IRI "
            "7 to 13 % low (docs/plants.md); add `side` (road-recon new-vehicle writes one)",
        )
    if car.tolerances_of:
        notes += (
            f"{car.name} states no tolerances: those of the class {car.tolerances_of} are assumed; "
            "state your own in its file, or identify it",
        )
    speed = float(np.nanmedian(record.v))
    found = dataclasses.replace(found, notes=notes, speed=speed)
    if found.s_std is None:  # of an estimator that takes the stations as they are
        odometer = calibrate_odometer(record, estimator.causal)
        found = odometer.describe(found) if odometer.s_std is not None else found
    found = mark_gaps(found, record, car.wheelbase)
    found = mark_manoeuvres(found, record, car.wheelbase)
    return mark_impossible(found, record, car, estimator)


def friction_note(record: Record, car: VehicleParameters) -> tuple[str, ...]:
    """Return a note where the accelerations are below _HELD times what dry friction passes on.

    A strut slides once the force on it exceeds the peak of its friction. Four struts that hold pass
    on accelerations of the body up to the sum of these peaks over its mass; below it the body
    follows the road on its tyres, and what a strut would have taken out of a wave does not show.
    """
    low, high = friction_peaks(car)
    peaks = np.where(record.damper_high.mean(axis=0) > 0.5, high, low)
    passed = float(peaks.sum() / car.m_b)
    driven = float(np.sqrt(np.nanmean(np.nanvar(record.a, axis=1))))
    if driven >= _HELD * passed:
        return ()
    return (
        "friction holds the struts of the vehicle for much of the drive (it passes on "
        f"{passed:.2f} m/s², {driven:.2f} were measured): heights are uncertain; drive faster, or "
        "on a rougher road as well",
    )
