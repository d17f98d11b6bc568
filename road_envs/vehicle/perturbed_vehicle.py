"""The field car: a second, richer plant, on which estimators are tested and never train.

It takes the place of the paper's unpublished measurements: one manufactured individual at a time,
driven with the same force laws, that departs from the training car where the paper says its own
model was wrong. Every grade has all of the grade before it, in the same individual:

| grade | what it adds |
|---|---|
| S0 | nothing: the training car, to the bit |
| S1 | manufacture: masses, inertias, friction; each strut's gas, damper, friction and bushing |
| S2 | structure: tyres envelop the road, stiffen as they deflect, differ in pressure; bushings |
|    | have a roll stiffness; the frame twists |
| S3 | instruments: place, tilt, gain, offset, speed error, clock jitter, lost samples |

By how much stands in `configs/field/*.yaml`, where it is labelled as assumed. From S1 on the
integrator's step is finer than the training car's, so that no estimator meets its own errors.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np

from road_envs import config
from road_envs.roads.surface import Surface, enveloped
from road_envs.sensing.sensor_faults import NO_FAULTS, PerSensor, SensorFaults
from road_envs.vehicle.equations import Plant, build_plant
from road_envs.vehicle.parameters import (
    NOMINAL,
    Axle,
    PerWheel,
    TorsionalFrame,
    VehicleParameters,
    VehicleVariation,
)

GRADES = ("S0", "S1", "S2", "S3")

Range = tuple[float, float]
MANUFACTURE_STREAM, STRUCTURE_STREAM, INSTRUMENT_STREAM = 1, 2, 3
PERTURBATION_STREAM = 9
"""First key of the streams of random numbers that draw an individual; the second is one of the
three above. Instruments draw their noise from the seed itself, whatever the grade."""


def _check_relative(owner: object, *names: str) -> None:
    for name in names:
        value = getattr(owner, name)
        low, high = value if isinstance(value, tuple) else (0.0, value)
        if not 0 <= low <= high < 1:
            raise ValueError(f"{name} must be within [0, 1), the least first, got {value}")


@dataclass(frozen=True, kw_only=True)
class ManufacturingTolerances:
    """Relative departures of one car from the drawing."""

    __pydantic_config__ = config.STRICT

    mass: Annotated[Range, "", "of the body and of each axle"]
    inertia: Annotated[Range, "", "of the same"]
    friction: Annotated[Range, "", "of all struts alike"]
    strut_gas: Annotated[float, "", "of each strut's gas pressure"]
    strut_damper: Annotated[float, "", "of each damper's force"]
    strut_friction: Annotated[float, "", "of each strut's friction, beside that of all"]
    strut_bushing: Annotated[float, "", "of each bushing's force"]

    def __post_init__(self):
        _check_relative(self, *self.__dataclass_fields__)


@dataclass(frozen=True, kw_only=True)
class UnmodelledStructure:
    """What the training car's equations leave out."""

    __pydantic_config__ = config.STRICT

    contact_length: Annotated[float, "m", "of the tyres on the road"]
    tyre_progression: Annotated[float, "1/m", "as in `vehicle.VehicleVariation`"]
    tyre_pressure: Annotated[float, "", "relative departure of each tyre's pressure"]
    tyre_pressure_effect: Annotated[float, "", "relative stiffness by relative pressure"]
    roll_stiffness: Annotated[tuple[float, float], "N m/rad", "of the bushings, front and rear"]
    frame: TorsionalFrame | None

    def __post_init__(self):
        _check_relative(self, "tyre_pressure")
        for name in ("contact_length", "tyre_progression", "tyre_pressure_effect"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not self.tyre_pressure * self.tyre_pressure_effect < 1:
            raise ValueError("tyre_pressure times tyre_pressure_effect must be below 1")


@dataclass(frozen=True, kw_only=True)
class SensorFaultLimits:
    """Greatest departures of the instruments; the last four are as they stand."""

    __pydantic_config__ = config.STRICT

    place: Annotated[float, "m", "of each accelerometer, ahead and to the left"]
    tilt: Annotated[float, "rad", "of its axis from the vertical"]
    gain: Annotated[float, "", "relative, of its sensitivity"]
    offset: Annotated[float, "m/s²", "of its reading"]
    speed: Annotated[float, "", "relative, of the speed signal, constant over a drive"]
    position_fix_length: Annotated[
        float, "m", "way in which position fixes bring the odometer back by 63 %"
    ]
    jitter: Annotated[float, "s", "standard deviation of the instants of the samples"]
    dropout_rate: Annotated[float, "", "share of the samples that are lost"]
    dropout_length: Annotated[int, "samples", "mean length of a loss"]

    def __post_init__(self):
        _check_relative(self, "gain", "speed")
        for name in ("place", "tilt", "offset"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        SensorFaults(
            jitter=self.jitter,
            dropout_rate=self.dropout_rate,
            dropout_length=self.dropout_length,
            position_fix_length=self.position_fix_length,
        )


@dataclass(frozen=True, kw_only=True)
class PlantMismatch:
    """By how much field cars depart from the training car."""

    __pydantic_config__ = config.STRICT

    name: str
    step: Annotated[float, "s", "of the integrator"]
    manufacture: ManufacturingTolerances
    structure: UnmodelledStructure
    instruments: SensorFaultLimits
    sources: dict[str, str]

    def __post_init__(self):
        if not 0 < self.step <= 0.01:
            raise ValueError(f"step must be within (0, 0.01] s, got {self.step}")


@dataclass(frozen=True)
class PerturbedVehicle:
    """One individual: its description, what is beyond it, its instruments' faults and its step.

    `step` [s] is the longest that the integrator may take. A `contact_length` [m] of 0 is a point
    follower.
    """

    grade: str
    car: VehicleParameters
    variation: VehicleVariation = NOMINAL
    contact_length: float = 0.0
    faults: SensorFaults = NO_FAULTS
    step: float = np.inf

    @cached_property
    def plant(self) -> Plant:
        """What the kernels need of it."""
        return build_plant(self.car, variation=self.variation)

    def enveloped(self, surface: Surface) -> Surface:
        """The surface as its tyres follow it; the truth stays what it is."""
        return enveloped(surface, self.contact_length) if self.contact_length > 0.0 else surface


def load_plant_mismatch(name: str | Path = "assumed") -> PlantMismatch:
    """Deviations by shipped name or YAML path. Raises ConfigError."""
    return config.load(PlantMismatch, "field", name)


def perturb_vehicle(
    car: VehicleParameters,
    grade: str,
    seed: int | np.random.SeedSequence,
    plant_mismatch: PlantMismatch | None = None,
) -> PerturbedVehicle:
    """The individual of a `grade` that `seed` draws; the same one under every grade.

    `plant_mismatch` are those shipped as "assumed" unless others are given. Raises ConfigError.
    """
    level = GRADES.index(config.validate_choice("grade", grade, list(GRADES)))
    if level == 0:
        return PerturbedVehicle(grade, car)
    by = load_plant_mismatch() if plant_mismatch is None else plant_mismatch
    one = _with_tolerances(PerturbedVehicle(grade, car, step=by.step), by.manufacture, seed)
    if level >= STRUCTURE_STREAM:
        one = _with_structure(one, by.structure, seed)
    if level >= INSTRUMENT_STREAM:
        one = replace(one, faults=_draw_sensor_faults(by.instruments, seed))
    return one


def _seed_sequence(seed: int | np.random.SeedSequence, group: int) -> np.random.SeedSequence:
    given = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.random.SeedSequence(
        given.entropy, spawn_key=(*given.spawn_key, PERTURBATION_STREAM, group)
    )


def _two_sided_factor(rng: np.random.Generator) -> Callable[..., float]:
    """Draws a factor that departs from 1 by `least` to `most`, up or down."""

    def factor(least: float, most: float) -> float:
        return 1.0 + float(rng.choice((-1.0, 1.0)) * rng.uniform(least, most))

    return factor


def _four_factors(rng: np.random.Generator, most: float) -> PerWheel:
    """Factors that depart from 1 by up to `most`."""
    a, b, c, d = (1.0 + rng.uniform(-most, most, 4)).tolist()
    return a, b, c, d


def _three_values(rng: np.random.Generator, most: float, middle: float = 0.0) -> PerSensor:
    """Values within `most` of `middle`."""
    a, b, c = (middle + rng.uniform(-most, most, 3)).tolist()
    return a, b, c


def _with_tolerances(
    one: PerturbedVehicle, by: ManufacturingTolerances, seed: int | np.random.SeedSequence
) -> PerturbedVehicle:
    rng = np.random.default_rng(_seed_sequence(seed, MANUFACTURE_STREAM))
    factor = _two_sided_factor(rng)

    def made(axle: Axle) -> Axle:
        return replace(axle, m=axle.m * factor(*by.mass), I_xx=axle.I_xx * factor(*by.inertia))

    car = replace(
        one.car,
        m_b=one.car.m_b * factor(*by.mass),
        I_xx=one.car.I_xx * factor(*by.inertia),
        I_yy=one.car.I_yy * factor(*by.inertia),
        front=made(one.car.front),
        rear=made(one.car.rear),
    )
    rubs, (a, b, c, d) = factor(*by.friction), _four_factors(rng, by.strut_friction)
    struts = VehicleVariation(
        gas=_four_factors(rng, by.strut_gas),
        damper=_four_factors(rng, by.strut_damper),
        friction=(rubs * a, rubs * b, rubs * c, rubs * d),
        bushing=_four_factors(rng, by.strut_bushing),
    )
    return replace(one, car=car, variation=struts)


def _with_structure(
    one: PerturbedVehicle, by: UnmodelledStructure, seed: int | np.random.SeedSequence
) -> PerturbedVehicle:
    rng = np.random.default_rng(_seed_sequence(seed, STRUCTURE_STREAM))
    variation = replace(
        one.variation,
        tyre=_four_factors(rng, by.tyre_pressure * by.tyre_pressure_effect),
        tyre_progression=by.tyre_progression,
        roll_stiffness=by.roll_stiffness,
        frame=by.frame,
    )
    return replace(one, variation=variation, contact_length=by.contact_length)


def _draw_sensor_faults(by: SensorFaultLimits, seed: int | np.random.SeedSequence) -> SensorFaults:
    stream = _seed_sequence(seed, INSTRUMENT_STREAM)
    rng = np.random.default_rng(stream)
    return SensorFaults(
        dx=_three_values(rng, by.place),
        dy=_three_values(rng, by.place),
        tilt=_three_values(rng, by.tilt),
        gain=_three_values(rng, by.gain, 1.0),
        offset=_three_values(rng, by.offset),
        speed=float(rng.uniform(-by.speed, by.speed)),
        position_fix_length=by.position_fix_length,
        jitter=by.jitter,
        dropout_rate=by.dropout_rate,
        dropout_length=by.dropout_length,
        seed=tuple(int(x) for x in stream.generate_state(4)),
    )
