"""Perturbed vehicles with plant-model mismatch, for tests, and for training on other individuals.

It substitutes for the paper's unpublished measurements. A seed draws one manufactured vehicle with
the force laws of the nominal one and deviations where the paper found its own model wrong. The
grades are cumulative for the same seed:

| grade | adds |
|---|---|
| S0 | nothing: the nominal vehicle, bit for bit |
| S1 | manufacture: masses, inertias, friction; gas, damper, friction and bushing of each strut |
| S2 | structure: tyres that envelop the road, are progressive and differ in pressure; roll |
|    | stiffness of the bushings; a body that twists (`parameters.TorsionalFrame`) and bends |
|    | (`body_bending`), each at its own frequency |
| S3 | instruments: position, tilt, gain, offset, speed error, clock jitter, lost samples; |
|    | position fixes that wander as a receiver's where that is asked for (`position_noise`) |
| S4 | side motion: tyres that hold the body sideways, of which a vehicle's file may know nothing; |
|    | where the file has `side`, each of its numbers is another |

The magnitudes are in `configs/field/*.yaml` and assumed. From S1 on the integrator takes finer
steps than on the nominal vehicle, so that its error differs from that of an estimator's model.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from road_envs.core import config
from road_envs.core.config import Fraction, NonNegative, Positive, Settings, SmallestFirst
from road_envs.sensing import sensor_faults
from road_envs.sensing.sensor_faults import NO_FAULTS, PerSensor, SensorFaults
from road_envs.vehicle.axles import IndependentWheels, SideMotion
from road_envs.vehicle.equations import Plant, build_plant
from road_envs.vehicle.parameters import (
    BendingMode,
    PerWheel,
    Step,
    TorsionalFrame,
    VehicleParameters,
)
from road_envs.vehicle.suspension import WHEELS
from road_envs.vehicle.tolerances import scale_parameters

GRADES = ("S0", "S1", "S2", "S3", "S4")

Range = Annotated[tuple[Fraction, Fraction], SmallestFirst]
PositiveRange = Annotated[tuple[Positive, Positive], SmallestFirst]

MANUFACTURE_LEVEL, STRUCTURE_LEVEL, INSTRUMENT_LEVEL, SIDE_LEVEL = 1, 2, 3, 4
"""Index of the grade that adds each group of deviations, and second key of its random stream."""

POSITION_NOISE_KEY = 5  # that of the position noise, which no grade adds by itself
PERTURBATION_STREAM = 9
"""First key of the random streams of a perturbed vehicle. Sensor noise is drawn from the seed
itself, so that it is the same under every grade."""


@dataclass(frozen=True, kw_only=True)
class _ManufacturingTolerances(Settings):
    """Relative deviations of either sign: smallest and largest magnitude, or the largest alone."""

    mass: Annotated[Range, "", "of the body and of each axle"]
    inertia: Annotated[Range, "", "of the same"]
    friction: Annotated[Range, "", "common to all struts"]
    strut_gas: Annotated[Fraction, "", "of each strut's gas pressure"]
    strut_damper: Annotated[Fraction, "", "of each damper's force"]
    strut_friction: Annotated[Fraction, "", "of each strut's friction, in addition"]
    strut_bushing: Annotated[Fraction, "", "of each bushing's force"]


@dataclass(frozen=True, kw_only=True)
class _FrameRange(Settings):
    """Range of the frames of vehicles of one kind; frequencies are uniform in their logarithm."""

    f: Annotated[PositiveRange, "Hz", "of the torsion mode, as in `parameters.TorsionalFrame`"]
    zeta: Annotated[Range, "", "its damping ratio"]


@dataclass(frozen=True, kw_only=True)
class _BendingRange(_FrameRange):
    """Range of the vertical bending modes of bodies."""

    length: Annotated[Positive, "m", "of the beam, as in `body_bending.BendingMode`"]


@dataclass(frozen=True, kw_only=True)
class _UnmodelledStructure(Settings):
    """Structural effects that the nominal equations of motion leave out."""

    contact_length: Annotated[NonNegative, "m", "contact length of the tyres"]
    tyre_progression: Annotated[NonNegative, "1/m", "as in `parameters.VehicleVariation`"]
    tyre_pressure: Annotated[Fraction, "", "largest relative deviation of each tyre's pressure"]
    tyre_pressure_effect: Annotated[
        NonNegative, "", "relative change of stiffness per relative change of pressure"
    ]
    roll_stiffness: Annotated[
        tuple[NonNegative, NonNegative], "N m/rad", "of the bushings, front and rear"
    ]
    frame: _FrameRange | None
    bending: _BendingRange | None

    def __post_init__(self):
        super().__post_init__()
        if not self.tyre_pressure * self.tyre_pressure_effect < 1:
            raise ValueError(
                "tyre_pressure times tyre_pressure_effect must be below 1, "
                f"got {self.tyre_pressure} x {self.tyre_pressure_effect}"
            )


@dataclass(frozen=True, kw_only=True)
class SensorFaultLimits(Settings):
    """Largest magnitudes of faults; from `position_fix_length` on values, range of that noise."""

    place: Annotated[NonNegative, "m", "position of each accelerometer, in x and in y"]
    tilt: Annotated[NonNegative, "rad", "of its axis from the vertical"]
    gain: Annotated[Fraction, "", "relative error of its sensitivity"]
    offset: Annotated[NonNegative, "m/s²", "of its reading"]
    speed: Annotated[Fraction, "", "relative error of the speed signal, constant over a drive"]
    position_fix_length: sensor_faults.PositionFixLength
    jitter: sensor_faults.Jitter
    dropout_rate: sensor_faults.DropoutRate
    dropout_length: sensor_faults.DropoutLength
    position_correlation_time: sensor_faults.CorrelationTime = 30.0
    position_noise: Annotated[PositiveRange, "m", "standard deviation of the fixes"] = (1.0, 3.0)


@dataclass(frozen=True, kw_only=True)
class _SideMotionRange(Settings):
    """Ranges of the side motion of a vehicle whose file has none, and the scatter of one's own."""

    scatter: Annotated[Fraction, "", "largest relative deviation of each number of `side`"]
    yaw_inertia: Annotated[PositiveRange, "", "of the body, over its pitch inertia"]
    wheel_radius: Annotated[PositiveRange, "m", "height of the wheels' centres"]
    solid_roll_centre: Annotated[PositiveRange, "m", "height, of solid axles"]
    independent_roll_centre: Annotated[PositiveRange, "m", "height, of independent wheels"]
    C_alpha: Annotated[PositiveRange, "1/rad", "cornering stiffness over a tyre's static load"]
    relaxation: Annotated[PositiveRange, "m", "relaxation length of the tyres"]
    swing_arm: Annotated[PositiveRange, "m", "of independent wheels, seen from the front"]


@dataclass(frozen=True, kw_only=True)
class PlantMismatch(Settings):
    """Magnitudes of the deviations of perturbed vehicles from the nominal one."""

    name: str
    step: Step
    manufacture: _ManufacturingTolerances
    structure: _UnmodelledStructure
    instruments: SensorFaultLimits
    side: _SideMotionRange | None
    sources: dict[str, str]


@dataclass(frozen=True)
class PerturbedVehicle:
    """One perturbed vehicle: parameters, sensor faults, longest `step` [s] of the integrator."""

    car: VehicleParameters
    faults: SensorFaults = NO_FAULTS
    step: float = np.inf

    @cached_property
    def plant(self) -> Plant:
        """The vehicle as kernels read it."""
        return build_plant(self.car)


def load_plant_mismatch(name: str | Path = "assumed") -> PlantMismatch:
    """Load the magnitudes by shipped name or YAML path. Raises ConfigError."""
    return config.load(PlantMismatch, "field", name)


def perturb_vehicle(
    car: VehicleParameters,
    grade: str,
    seed: int | np.random.SeedSequence,
    plant_mismatch: PlantMismatch | None = None,
    accelerometers: int = 3,
    position_noise: bool = False,
) -> PerturbedVehicle:
    """Draw the perturbed vehicle of a `seed`, with the deviations up to `grade`.

    All grades of one seed share their random draws. `plant_mismatch`: magnitudes, by default the
    shipped "assumed" ones; `accelerometers`: their number; `position_noise`: the position fixes,
    which grades have from S3 on, wander. Raises ConfigError.
    """
    level = GRADES.index(config.validate_choice("grade", grade, list(GRADES)))
    if position_noise and level < INSTRUMENT_LEVEL:
        needed = "the position fixes of grade S3 or S4"
        raise config.ConfigError(f"position noise needs {needed}, got {grade}")
    if level == 0:
        return PerturbedVehicle(car)
    mismatch = load_plant_mismatch() if plant_mismatch is None else plant_mismatch
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)

    def stream(group: int) -> np.random.Generator:
        spawn_key = (*root.spawn_key, PERTURBATION_STREAM, group)
        return np.random.default_rng(np.random.SeedSequence(root.entropy, spawn_key=spawn_key))

    car, faults = _with_tolerances(car, mismatch.manufacture, stream(MANUFACTURE_LEVEL)), NO_FAULTS
    if level >= STRUCTURE_LEVEL:
        car = _with_structure(car, mismatch.structure, stream(STRUCTURE_LEVEL))
    if level >= INSTRUMENT_LEVEL:
        faults = _draw_sensor_faults(mismatch.instruments, stream(INSTRUMENT_LEVEL), accelerometers)
    if position_noise:
        std = float(stream(POSITION_NOISE_KEY).uniform(*mismatch.instruments.position_noise))
        time = mismatch.instruments.position_correlation_time
        faults = replace(faults, position_noise=std, position_correlation_time=time)
    if level >= SIDE_LEVEL and mismatch.side is not None:
        car = _with_side_motion(car, mismatch.side, stream(SIDE_LEVEL))
    return PerturbedVehicle(car, faults, mismatch.step)


def _four_factors(rng: np.random.Generator, most: float) -> PerWheel:
    """Draw factors between 1 - `most` and 1 + `most`."""
    a, b, c, d = (1.0 + rng.uniform(-most, most, 4)).tolist()
    return a, b, c, d


def _with_tolerances(
    car: VehicleParameters, limits: _ManufacturingTolerances, rng: np.random.Generator
) -> VehicleParameters:
    def factor(least: float, most: float) -> float:
        return 1.0 + float(rng.choice((-1.0, 1.0)) * rng.uniform(least, most))

    mass, inertia = limits.mass, limits.inertia
    factors = {"m_b": factor(*mass), "I_xx": factor(*inertia), "I_yy": factor(*inertia)}
    for axle in ("front", "rear"):
        factors |= {f"{axle}.m": factor(*mass), f"{axle}.I_xx": factor(*inertia)}
        if isinstance(getattr(car, axle), IndependentWheels):  # it follows from the mass
            del factors[f"{axle}.I_xx"]
    common, friction = factor(*limits.friction), _four_factors(rng, limits.strut_friction)
    struts = {
        "gas": _four_factors(rng, limits.strut_gas),
        "damper": _four_factors(rng, limits.strut_damper),
        "friction": [common * one for one in friction],
        "bushing": _four_factors(rng, limits.strut_bushing),
    }
    for name, values in struts.items():
        factors |= {f"variation.{name}.{w}": x for w, x in zip(WHEELS, values, strict=True)}
    return scale_parameters(car, factors)


def _with_structure(
    car: VehicleParameters, limits: _UnmodelledStructure, rng: np.random.Generator
) -> VehicleParameters:
    variation = replace(
        car.variation,
        tyre=_four_factors(rng, limits.tyre_pressure * limits.tyre_pressure_effect),
        tyre_progression=limits.tyre_progression,
        roll_stiffness=limits.roll_stiffness,
        contact_length=limits.contact_length,
        frame=None if limits.frame is None else TorsionalFrame(**_draw_mode(rng, limits.frame)),
        bending=None
        if (b := limits.bending) is None
        else BendingMode(**_draw_mode(rng, b), length=b.length),
    )
    return replace(car, variation=variation)


def _with_side_motion(
    car: VehicleParameters, limits: _SideMotionRange, rng: np.random.Generator
) -> VehicleParameters:
    """Return the vehicle with another side motion than that of its file, or with one at all."""

    def scattered(value: float | tuple[float, float]) -> Any:
        factors = rng.uniform(1.0 - limits.scatter, 1.0 + limits.scatter, np.shape(value))
        new = (np.asarray(value) * factors).tolist()
        return tuple(new) if isinstance(value, tuple) else new

    def of_axles(limits: tuple[float, float]) -> Any:
        return tuple(rng.uniform(*limits, 2).tolist())

    if car.side is not None:
        values = {f.name: scattered(getattr(car.side, f.name)) for f in fields(car.side)}
        return replace(car, side=replace(car.side, **values))
    independent = isinstance(car.front, IndependentWheels)
    heights = limits.independent_roll_centre if independent else limits.solid_roll_centre
    stiffness: Any = np.multiply(of_axles(limits.C_alpha), car.tyre_loads).tolist()
    side = SideMotion(
        I_zz=car.I_yy * float(rng.uniform(*limits.yaw_inertia)),
        wheel_radius=float(rng.uniform(*limits.wheel_radius)),
        roll_centre=of_axles(heights),
        C_alpha=tuple(stiffness),
        relaxation=of_axles(limits.relaxation),
        swing_arm=of_axles(limits.swing_arm),
    )
    return replace(car, side=side)


def _draw_mode(rng: np.random.Generator, limits: _FrameRange) -> dict[str, float]:
    """Draw frequency and damping ratio of a mode."""
    f = float(np.exp(rng.uniform(*np.log(limits.f))))
    return {"f": f, "zeta": float(rng.uniform(*limits.zeta))}


def _draw_sensor_faults(
    limits: SensorFaultLimits, rng: np.random.Generator, k: int
) -> SensorFaults:
    """Draw the faults of `k` accelerometers."""

    def draw(most: float, centre: float = 0.0) -> PerSensor:
        return tuple((centre + rng.uniform(-most, most, k)).tolist())

    own = ("position_fix_length", "jitter", "dropout_rate", "dropout_length")
    return SensorFaults(
        dx=draw(limits.place),
        dy=draw(limits.place),
        tilt=draw(limits.tilt),
        gain=draw(limits.gain, 1.0),
        offset=draw(limits.offset),
        speed=float(rng.uniform(-limits.speed, limits.speed)),
        seed=tuple(rng.bit_generator.seed_seq.generate_state(4).tolist()),
        **{name: getattr(limits, name) for name in own},
    )
