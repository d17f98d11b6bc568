"""Generic cars of a class: descriptions for those who know little of their vehicle.

A class is a vehicle file with middle values of published ranges and tolerances as wide as the
fleet. `fitted_vehicle` scales it to a mass, a wheelbase and a track; `with_class_tolerances` lends
its tolerances to a file that states none.
"""

import math
from dataclasses import replace

from road_envs.core import config
from road_envs.core.config import ConfigError
from road_envs.vehicle.parameters import Tolerance, VehicleParameters, check_plausible, load_vehicle
from road_envs.vehicle.tolerances import scale_parameters, stated_values

CLASSES = ("compact", "saloon", "suv", "van")  # generic cars, vehicle files as all others
SCALES = {"mass": (0.6, 1.7, "kg"), "wheelbase": (0.75, 1.35, "m"), "track": (0.85, 1.15, "m")}
"""Least and greatest ratio of a car's value to that of its class, and the unit of the value."""

KNOWN_MASS = Tolerance(relative=0.07, source="assumed; passengers and load")  # of a stated mass


def fitted_vehicle(
    name: str, car_class: str, mass: float, wheelbase: float, track: float
) -> VehicleParameters:
    """Return the generic car of a class with the `mass` [kg] of the whole car ready to drive, its
    `wheelbase` and its `track` [m]. Raises ConfigError, also of a value that no such car has.

    Natural frequencies, damping ratios and the share of the load in front are those of the class:
    masses, stiffnesses and forces grow with the mass, lengths with lengths, moments of inertia with
    mass and lengths squared.
    """
    base = load_vehicle(config.validate_choice("class of vehicle", car_class, list(CLASSES)))
    own = {"mass": mass, "wheelbase": wheelbase, "track": track}
    usual = _dimensions(base)
    for key, (low, high, unit) in SCALES.items():
        if not low <= own[key] / usual[key] <= high:
            raise ConfigError(
                f"a {key} of {own[key]:g} {unit} is that of no {car_class}: "
                f"{low * usual[key]:.4g} to {high * usual[key]:.4g} {unit} are plausible, "
                "or choose another class"
            )
    q, length, width = (own[key] / usual[key] for key in SCALES)
    factors = {"m_b": q, "I_xx": q * width**2, "I_yy": q * length**2, "side.I_zz": q * length**2}
    factors["side.C_alpha"] = q
    for axle in ("front", "rear"):
        each = {"x": length, "y_t": width, "m": q, "k_t": q, "c_t": q, "k_roll": q * width**2}
        factors |= {f"{axle}.{key}": value for key, value in each.items()}
        for part in ("spring.k", "damper", "friction", "bump_stop"):
            factors[f"strut.{axle}.{part}"] = q
    source = f"computed from {car_class} for {mass:g} kg, {wheelbase:g} m and {track:g} m"
    sources = {path: f"{source}; {text}" for path, text in base.sources.items()}
    tolerances = base.tolerances | {"m_b": KNOWN_MASS}
    scaled = scale_parameters(base, factors)
    car = replace(scaled, name=name, sources=sources, tolerances=tolerances)
    check_plausible(car, name)
    return car


def with_class_tolerances(car: VehicleParameters) -> VehicleParameters:
    """Return a passive car that states no tolerances with those of the class of nearest mass,
    wheelbase and track, which `tolerances_of` names; any other as it is.
    """
    if car.tolerances or not car.is_passive:
        return car
    own = _dimensions(car)

    def distance(generic: VehicleParameters) -> float:
        usual = _dimensions(generic)
        return sum(math.log(own[key] / usual[key]) ** 2 for key in SCALES)

    nearest = min(map(load_vehicle, CLASSES), key=distance)
    stated = stated_values(car, nearest.tolerances)
    return replace(car, tolerances=stated, tolerances_of=nearest.name)


def _dimensions(car: VehicleParameters) -> dict[str, float]:
    """Return mass of the whole car [kg], wheelbase and mean track [m]."""
    return {
        "mass": car.m_b + car.front.m + car.rear.m,
        "wheelbase": car.wheelbase,
        "track": car.front.y_t + car.rear.y_t,
    }
