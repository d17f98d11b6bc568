"""Drives of foreign plants over roads, as records with their true profiles."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.plants.commonroad_car import CommonRoadCar
from road_envs.plants.mujoco_car import MujocoCar
from road_envs.records.record import Profile, Record, profile_stations
from road_envs.roads import Road, realise_road
from road_envs.roads.surface import Surface, enveloped
from road_envs.sensing.data_logger import DataLogger
from road_envs.sensing.instruments import Instruments, load_instruments
from road_envs.vehicle.parameters import NOMINAL, VehicleParameters, load_vehicle

PLANTS: dict[str, Callable[..., Any]] = {"mujoco": MujocoCar, "commonroad": CommonRoadCar}
RUN_IN = 5.0  # level road [m] before and behind the surface, on which a drive begins and ends
MAX_SPEED_KMH = 150.0  # greatest speed of a drive [km/h]
_NOISE = 0  # random stream of the noise


def simulate_on_plant(
    plant: str,
    road: str | Path | Mapping[str, Any] | Road | Surface,
    *,
    speed_kmh: float,
    seed: int = 1,
    vehicle: str | Path | VehicleParameters,
    instruments: str | Path | Instruments = "paper",
    length: float | None = None,
) -> tuple[Record, Profile]:
    """Drive a foreign `plant` over a road; return its record and the true profile.

    Arguments as of `recording.simulate_record`; the vehicle needs passive struts, and no variation
    but the contact length of its tyres. Raises ConfigError, MissingExtraError, ArithmeticError.
    """
    config.validate_choice("plant", plant, PLANTS)
    if not 0.0 < speed_kmh <= MAX_SPEED_KMH:
        raise ConfigError(
            f"the speed must be above 0 and at most {MAX_SPEED_KMH:g} km/h, got {speed_kmh:g} km/h"
        )
    surface = road if isinstance(road, Surface) else realise_road(road, seed, length)
    car = vehicle if isinstance(vehicle, VehicleParameters) else load_vehicle(vehicle)
    if not isinstance(instruments, Instruments):
        instruments = load_instruments(instruments)
    _check(plant, car)
    step, v = 1.0 / instruments.fs, speed_kmh / 3.6
    noise = np.random.SeedSequence(seed, spawn_key=(_NOISE,))  # the road has the numbers of `seed`
    logger = DataLogger(instruments, car, step, np.random.default_rng(noise))
    contact = car.variation.contact_length
    driven = enveloped(surface, contact) if contact > 0.0 else surface
    duration = (surface.end + car.wheelbase + 2.0 * RUN_IN) / v
    motion = PLANTS[plant](car, logger.locations).drive(driven, -RUN_IN, v, duration, step)
    a = logger.digitise(motion)
    t = step * np.arange(a.shape[1])
    s = logger.odometer(v * t) - RUN_IN
    settings, speed = np.zeros((t.size, 4), dtype=bool), np.full(t.size, logger.speed_gain * v)
    record = Record(t, a, speed, s, settings, settings, surface.length, instruments.layout)
    stations = profile_stations(surface.length)
    return record, Profile(stations, surface.height(stations))


def _check(plant: str, car: VehicleParameters) -> None:
    """Raise ConfigError on what foreign plants do not have."""
    if not car.is_passive:
        raise ConfigError(
            f"{car.name} has struts that are switched; the plant {plant} needs passive struts"
        )
    own = {name: value for name, value in vars(car.variation).items() if name != "contact_length"}
    if changed := [name for name, value in own.items() if value != getattr(NOMINAL, name)]:
        raise ConfigError(f"{car.name}: the plant {plant} knows no variation.{changed[0]}")
