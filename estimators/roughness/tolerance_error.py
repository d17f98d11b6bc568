"""Deviation of the roughness of a drive by what the tolerances of a vehicle leave open.

An estimate with the described vehicle makes of each frequency what that vehicle would need for the
measured acceleration. Vehicles within the tolerances accelerate the sensors more or less on a road
of the drive's level; the root of their power over that of the described one, weighted as an index
of roughness does, is the factor on that index. Weighted as the golden car does, its deviation is
near 0.06 where dampers rule, and 0.1 to 0.2 at 50 km/h on class A, where friction does, which is
the least known (`studies/phone_reports.py` with seed 110: an IRI that is 19 % high is 2 % high with
the individual's own parameters).
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from estimators.wiener.spectral_model import SensedVehicle
from estimators.wiener.structure_search import CalmDrive, Spectra
from road_envs.analysis.information_bound import equivalent_damping
from road_envs.records.record import Record
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.tolerances import parameter_space

_DRAWS = 24  # vehicles that are drawn


def roughness_std(
    record: Record,
    car: VehicleParameters,
    instruments: str,
    weight: Callable[[np.ndarray], np.ndarray],
) -> float:
    """Return the relative standard deviation of the roughness of a drive by the tolerances of
    `car`; 0 where it has none, and of drives that are too short or never calm. `weight` gives the
    share of each spatial frequency (F,) [cycles/m] in the square of the index. Raises ConfigError.
    """
    used = {k: x for k, x in car.tolerances.items() if not k.startswith("side.")}  # straight road
    drive = CalmDrive.of(record, car, instruments)
    if not used or not drive.tells(record):
        return 0.0
    described = drive.on_fitted_level(SensedVehicle.of(car, drive.sensors), 2.0)
    weights = weight(drive.f / drive.v)
    space, rng = parameter_space(replace(car, tolerances=used)), np.random.default_rng(0)
    factors = []
    for _ in range(_DRAWS):
        vehicle = SensedVehicle.of(space.draw(rng), drive.sensors)
        damping = equivalent_damping(vehicle.plant, drive.mode, drive.v, described.prior)
        other = Spectra.of(vehicle, damping, described.prior, drive, described.D)
        ratio = other.of_channels.sum(axis=0) / described.of_channels.sum(axis=0)
        factors.append(0.5 * np.log(np.average(ratio.mean(axis=0), weights=weights)))
    return float(np.std(factors))
