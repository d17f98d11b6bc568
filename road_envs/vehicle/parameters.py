"""Vehicle parameters as frozen dataclasses; each field carries its unit and meaning.

Axes after ISO 8855: x ahead, y left, z up. Symbols as in the literature; `equations.py` maps them
to the letters of the paper (Ngwangwa, Heyns, Breytenbach & Els).

A front or rear suspension is a solid axle or a pair of independent wheels. The struts of a vehicle
are 4S4 struts, which can be switched, or passive ones.
"""

import json
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import yaml
from pydantic import Field

from road_envs.core import config
from road_envs.core.atomic_io import write_text
from road_envs.core.config import Finite, Fraction, NonNegative, Positive, Settings
from road_envs.vehicle import struts
from road_envs.vehicle.axles import AnyAxle, Axle, IndependentWheels, SideMotion
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.struts import NO_VALVE, AnyStruts, PassiveStruts, Strut, Valve

GRAVITY = 9.81  # gravitational acceleration used throughout [m/s²]
DEFAULT_STEP, STEP_LIMIT = 0.001, 0.01  # default and longest step [s] of the fixed-step integrator

Step = Annotated[float, Field(gt=0, le=STEP_LIMIT), "s", "step of the integrator"]
PerWheel = tuple[Positive, Positive, Positive, Positive]
UNIT_FACTORS: PerWheel = (1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class TorsionalFrame(Settings):
    """A torsionally flexible body: two halves of equal roll inertia, which meet at the centre of
    mass, joined by spring and damper.
    """

    f: Annotated[Positive, "Hz", "frequency of the free body's torsion mode"]
    zeta: Annotated[NonNegative, "", "its damping ratio"]


@dataclass(frozen=True, kw_only=True)
class BendingMode(Settings):
    """First vertical bending mode of the body, which sensors measure (`body_bending`)."""

    f: Annotated[Positive, "Hz", "frequency"]
    zeta: Annotated[Fraction, "", "its damping ratio"]
    length: Annotated[Positive, "m", "of the beam, centred at the body's centre of mass"]


@dataclass(frozen=True, kw_only=True)
class VehicleVariation(Settings):
    """Deviation of one manufactured vehicle; tuples of four are factors per wheel (FL ... RR)."""

    gas: Annotated[PerWheel, "", "of the struts' gas pressure or spring force"] = UNIT_FACTORS
    damper: Annotated[PerWheel, "", "of the dampers' forces"] = UNIT_FACTORS
    friction: Annotated[PerWheel, "", "of the struts' friction"] = UNIT_FACTORS
    bushing: Annotated[PerWheel, "", "of the bushings' forces"] = UNIT_FACTORS
    tyre: Annotated[PerWheel, "", "of the tyres' stiffness"] = UNIT_FACTORS
    tyre_progression: Annotated[
        NonNegative, "1/m", "a, of a tyre whose secant stiffness at the compression x is "
        "k_t (1 + a (x - delta)), with delta its deflection at the origin"
    ] = 0.0  # fmt: skip
    roll_stiffness: Annotated[
        tuple[NonNegative, NonNegative], "N m/rad", "of the bushings between body and each axle"
    ] = (0.0, 0.0)
    contact_length: Annotated[
        NonNegative, "m", "of the tyres' contact, over which they envelop the road; 0: a point"
    ] = 0.0
    frame: TorsionalFrame | None = None
    bending: BendingMode | None = None


NOMINAL = VehicleVariation()  # no deviation from the parameters


@dataclass(frozen=True, kw_only=True)
class Tolerance(Settings):
    """Standard deviation of a parameter among vehicles of one description; `about` is for one that
    the description leaves out (a frame) or sets to 0.
    """

    relative: Annotated[float, Field(gt=0, le=1), "", "standard deviation of the logarithm"]
    about: Annotated[Positive, "", "median, in the parameter's unit"] | None = None
    source: str


TYRE_DEFLECTION, WHEEL_HOP = (0.003, 0.1), (3.0, 40.0)
"""Plausible static deflections of a tyre [m], and frequencies of an axle on its tyres [Hz]."""


@dataclass(frozen=True, kw_only=True)
class VehicleParameters(Settings):
    """A two-axle vehicle with solid axles or independent wheels, and 4S4 or passive struts."""

    name: str
    m_b: Annotated[Positive, "kg", "sprung mass"]
    I_xx: Annotated[Positive, "kg m²", "roll inertia of the body"]
    I_yy: Annotated[Positive, "kg m²", "pitch inertia of the body"]
    h_cg: Annotated[Positive, "m", "height of the centre of mass"]
    roll_centre: Annotated[Finite, "m", "height of the body's roll axis in turns"]
    pitch_centre: Annotated[Finite, "m", "height of its pitch axis when braking"]
    front: AnyAxle
    rear: AnyAxle
    strut: AnyStruts
    tyre_static_deflection: Annotated[
        Literal["equilibrium"] | NonNegative, "m", "deflection at the origin of the coordinates"
    ]
    sources: dict[str, str]
    valve: Annotated[Valve, "", "of 4S4 struts; a car with passive struts has none"] = NO_VALVE
    side: Annotated[SideMotion | None, "", "side motion; none: free to slide"] = None
    variation: VehicleVariation = NOMINAL
    tolerances: dict[str, Tolerance] = field(default_factory=dict)
    tolerances_of: Annotated[str, "", "class whose tolerances these are; empty: the car's own"] = ""

    def __post_init__(self):
        super().__post_init__()
        if not self.front.x > 0 > self.rear.x:
            raise ValueError(
                "the front axle must be ahead of the centre of mass and the rear axle behind it, "
                f"got front.x = {self.front.x}, rear.x = {self.rear.x}"
            )
        if (self.valve == NO_VALVE) != self.is_passive:
            raise ValueError(
                "passive struts have no valve: leave out the key valve"
                if self.is_passive
                else "4S4 struts need the key valve: delay, lag, equalisation"
            )

    @property
    def is_passive(self) -> bool:
        """True if the struts are passive, so that there is nothing to switch."""
        return isinstance(self.strut, PassiveStruts)

    @property
    def modes(self) -> struts.Modes:
        """Modes of the struts; the first is the default."""
        return struts.PASSIVE_MODES if self.is_passive else struts.MODES

    @property
    def bump_stops(self) -> tuple[Curve, Curve]:
        """Bump stops (front, rear): force [N] over the extension [m] at the wheel or at y_s."""
        if isinstance(self.strut, Strut):
            return self.strut.bump_stop.front, self.strut.bump_stop.rear
        front, rear = self.strut.front, self.strut.rear
        return front.at_wheel(front.bump_stop), rear.at_wheel(rear.bump_stop)

    @property
    def free_travel(self) -> np.ndarray:
        """Extensions (4, 2) [m] of each strut between which its bump stop exerts no force, or 0."""
        stops = [stop for stop in self.bump_stops for _ in range(2)]
        free = [[x for x, F in zip(stop.x, stop.F, strict=True) if F == 0.0] for stop in stops]
        return np.array([(min(x, default=0.0), max(x, default=0.0)) for x in free])

    @property
    def rigid(self) -> "VehicleParameters":
        """The vehicle without a flexible frame; itself if it has none."""
        if self.variation.frame is None:
            return self
        return replace(self, variation=replace(self.variation, frame=None))

    @property
    def sliding(self) -> "VehicleParameters":
        """The vehicle without side motion, free to slide sideways; itself if it has none."""
        if self.side is None:
            return self
        rest = {k: t for k, t in self.tolerances.items() if k.partition(".")[0] != "side"}
        return replace(self, side=None, tolerances=rest)

    @property
    def axles(self) -> tuple[Axle | IndependentWheels, Axle | IndependentWheels]:
        return self.front, self.rear

    @property
    def wheelbase(self) -> float:
        """Distance between the axles [m]."""
        return self.front.x - self.rear.x

    @property
    def pitch_lever(self) -> float:
        """Height [m] of the centre of mass above wheels that go fore and aft as the body pitches,
        as links keep them below it; 0 without such motion (`SideMotion.fore_and_aft`).
        """
        if self.side is None or not self.side.fore_and_aft:
            return 0.0
        return self.h_cg - self.side.wheel_radius

    @property
    def pitch_inertia(self) -> float:
        """Inertia [kg m²] that pitch accelerates: of the body, of axles that go fore and aft."""
        return self.I_yy + (self.front.m + self.rear.m) * self.pitch_lever**2

    @property
    def strut_loads(self) -> tuple[float, float]:
        """Static load [N] of one front and of one rear strut, by the lever arms of the body."""
        weight = self.m_b * GRAVITY / self.wheelbase
        return -0.5 * weight * self.rear.x, 0.5 * weight * self.front.x

    @property
    def tyre_loads(self) -> tuple[float, float]:
        """Static load [N] of one front and of one rear tyre."""
        front, rear = self.strut_loads
        return front + 0.5 * self.front.m * GRAVITY, rear + 0.5 * self.rear.m * GRAVITY

    @property
    def tyre_deflections(self) -> tuple[float, float]:
        """Deflection [m] of a front and of a rear tyre at the origin of the coordinates."""
        if self.tyre_static_deflection != "equilibrium":
            return self.tyre_static_deflection, self.tyre_static_deflection
        front, rear = self.tyre_loads
        return front / self.front.k_t, rear / self.rear.k_t


def load_vehicle(name: str | Path) -> VehicleParameters:
    """Load a vehicle by shipped name or YAML path. Raises ConfigError. A passive car whose file
    states no tolerances has those of its class (`generic_cars`).
    """
    from road_envs.vehicle.generic_cars import with_class_tolerances  # which loads its classes

    car = config.load(VehicleParameters, "vehicles", name)
    check_plausible(car, str(name))
    return with_class_tolerances(car)


def check_plausible(car: VehicleParameters, where: str) -> None:
    """Raise ConfigError if tyres or axles are those of no road vehicle, as by a wrong unit."""
    for end, axle, load in zip(("front", "rear"), car.axles, car.tyre_loads, strict=True):
        deflection = load / axle.k_t
        if not TYRE_DEFLECTION[0] <= deflection <= TYRE_DEFLECTION[1]:
            raise config.ConfigError(
                f"{where}: {end}.k_t = {axle.k_t:g} N/m lets a tyre give way by {deflection:.3g} m "
                f"under its static load of {load:.0f} N; {TYRE_DEFLECTION[0]:g} to "
                f"{TYRE_DEFLECTION[1]:g} m are plausible: check units and masses"
            )
        hop = math.sqrt(2.0 * axle.k_t / axle.m) / (2.0 * math.pi)
        if not WHEEL_HOP[0] <= hop <= WHEEL_HOP[1]:
            raise config.ConfigError(
                f"{where}: the {end} axle of m = {axle.m:g} kg hops at {hop:.3g} Hz on its tyres; "
                f"{WHEEL_HOP[0]:g} to {WHEEL_HOP[1]:g} Hz are plausible: check units and masses"
            )
    if car.side is None:
        return
    for end, h in zip(("front", "rear"), car.side.roll_centre, strict=True):
        if not h < car.h_cg:
            raise config.ConfigError(
                f"{where}: the roll centre of the {end} axle, {h:g} m, is above the centre of mass "
                f"at h_cg = {car.h_cg:g} m; 0 to 0.2 m of independent wheels and 0.3 to 0.6 m of "
                "solid axles are usual"
            )
    low, high = abs(car.I_yy - car.I_xx), car.I_yy + car.I_xx
    if not low <= car.side.I_zz <= high:
        raise config.ConfigError(
            f"{where}: side.I_zz = {car.side.I_zz:g} kg m² is the yaw inertia of no rigid body "
            f"with I_xx = {car.I_xx:g} and I_yy = {car.I_yy:g}: theirs is from {low:g} to "
            f"{high:g}; it is that of the body, without axles"
        )


def write_vehicle(path: Path, car: VehicleParameters, comment: str = "") -> None:
    """Write a vehicle as YAML, with a `comment` of one or more lines at the head."""
    has = {"valve": not car.is_passive, "side": car.side, "tolerances_of": car.tolerances_of}
    data = {k: v for k, v in json.loads(json.dumps(asdict(car))).items() if has.get(k, True)}
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, default_flow_style=None)
    write_text(path, head + text)
