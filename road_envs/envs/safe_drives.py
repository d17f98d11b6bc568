"""Drives of the benchmark `RoadRecon/Safe4S4-v1`: what a seed draws, and what a reset may fix.

A drive is a rough track whose ISO class changes on the way, with bumps, and two manoeuvres, a
severe and a gentle one. The ranges are in `configs/benchmarks/safe4s4_v1.yaml`: those of the group
"unseen" share no value with "known", and training draws "known" only.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal, cast

import numpy as np
from pydantic import Field

from road_envs.core import config
from road_envs.core.config import NonNegative, Positive, Settings, UnknownKeyError
from road_envs.roads import Concatenated, Defects, Iso8608, Road, Superposed
from road_envs.roads.iso8608 import RoadClass
from road_envs.roads.obstacles import Defect
from road_envs.roads.surface import Surface
from road_envs.sensing.perturbed_vehicle import load_plant_mismatch, perturb_vehicle
from road_envs.sensing.sensor_faults import NO_FAULTS, SensorFaults
from road_envs.simulation import manoeuvres
from road_envs.simulation.speed import SpeedProfile
from road_envs.vehicle.parameters import VehicleParameters

Side = Literal["left", "right"]
Severe = Literal["lane_change", "j_turn", "fishhook"]
Gentle = Literal["steady_turn", "slalom", "braking"]
Grade = Literal["S0", "S1", "S2", "S3"]
Group = Literal["known", "unseen"]
Range = Annotated[tuple[NonNegative, NonNegative], config.SmallestFirst]

TIME_QUANTUM = 0.1  # drives last a multiple of it [s], so that they end alike at every control rate
BUMP_LENGTH = 3.7  # length of a bump [m]: the 12 feet of a Watts profile, the common speed hump


@dataclass(frozen=True, kw_only=True)
class SafeDrive(Settings):
    """One drive; each field can be fixed by `reset(options=...)`, the others are drawn."""

    group: Annotated[Group, "", "ranges from which the others are drawn"] = "known"
    duration: Annotated[float, Field(ge=20, le=30), "s", "of the drive"]
    road: Annotated[RoadClass, "", "ISO class of the first part"]
    road_after: Annotated[RoadClass, "", "ISO class of the second part"]
    change: Annotated[float, Field(gt=0, lt=1), "", "share of the length before the change"]
    speed_kmh: Annotated[Positive, "km/h", "speed at the start"]
    severe: Annotated[Severe, "", "kind of the severe manoeuvre"]
    side: Annotated[Side, "", "to which the severe manoeuvre begins"]
    begin: Annotated[float, Field(ge=0, le=15), "s", "when the severe manoeuvre begins"]
    severity: Annotated[float, Field(gt=0, le=1.5), "", "factor on the a_y of a J-turn or fishhook"]
    gentle: Annotated[Gentle, "", "kind of the gentle manoeuvre, after the severe one"]
    gentle_side: Annotated[Side, "", "to which it begins"]
    gentle_severity: Annotated[float, Field(gt=0, le=1.5), "", "factor on its acceleration"]
    bumps: Annotated[int, Field(ge=0, le=3), "", "number of bumps"]
    bump_height: Annotated[Positive, "m", "their height"]
    grade: Annotated[Grade, "", "of the individual car, as in `perturbed_vehicle`"]
    payload: Annotated[NonNegative, "kg", "load above the rear axle"]
    faults: Annotated[bool, "", "whether the instruments have faults, with grade S3"]

    @property
    def mirrored(self) -> "SafeDrive":
        """The drive with both manoeuvres to the other side."""
        other: dict[str, Side] = {"left": "right", "right": "left"}
        return replace(self, side=other[self.side], gentle_side=other[self.gentle_side])

    @property
    def v(self) -> float:
        """Speed at the start [m/s]."""
        return self.speed_kmh / 3.6

    @property
    def speed_profile(self) -> SpeedProfile:
        """Speed over time; it falls where the gentle manoeuvre is braking."""
        if self.gentle != "braking":
            return SpeedProfile(t=(0.0,), v=(self.v,))
        stop, a = self._gentle_begin, BRAKING.a_x * self.gentle_severity
        # constant deceleration over the time that a trapezoid of the same impulse takes
        duration = BRAKING.hold + BRAKING.build_up
        end = max(self.v - a * duration, 3.0)
        return SpeedProfile(t=(0.0, stop, stop + duration), v=(self.v, self.v, end))

    @property
    def manoeuvre(self) -> manoeuvres.Manoeuvre:
        """Lateral acceleration of both manoeuvres; braking acts by the speed profile."""
        parts = [self._severe]
        if self.gentle != "braking":
            sign = self.gentle_severity * (1.0 if self.gentle_side == "left" else -1.0)
            shape = GENTLE[self.gentle]
            parts.append(replace(shape, a_y=sign * shape.a_y, begin=self._gentle_begin))
        return manoeuvres.Successive(tuple(parts))

    def realise_surface(self, rng: np.random.Generator, car: VehicleParameters) -> Surface:
        """Return the road: two ISO classes one after the other, and bumps on them."""
        distance, _, _ = self.speed_profile.at(np.array([self.duration]))
        # the drive starts 5 m before the road and must not leave it: a margin of a wheelbase
        length = float(np.ceil(distance[0] + car.wheelbase))
        first = round(self.change * length, 2)
        places = np.sort(rng.uniform(0.15, 0.95, self.bumps)) * length
        before = Iso8608(road_class=self.road, length=first)
        after = Iso8608(road_class=self.road_after, length=length - first)
        roads: list[Road] = [Concatenated(roads=(before, after))]
        if self.bumps:
            shape: Any = {"shape": "half_sine", "length": BUMP_LENGTH, "height": self.bump_height}
            bumps = tuple(Defect(at=float(at), **shape) for at in places)
            roads.append(Defects(length=length, defects=bumps))
        surface = Superposed(roads=tuple(roads)).realise(rng)
        surface.check_climbable()
        return surface

    def individual_car(
        self, car: VehicleParameters, seed: Any, k: int
    ) -> tuple[VehicleParameters, SensorFaults]:
        """Return the manufactured car, rigid, with its load, and faults of `k` accelerometers, with
        neither jitter nor lost samples: an interval of the environment holds whole samples.
        """
        mismatch = load_plant_mismatch()
        rigid = replace(mismatch, structure=replace(mismatch.structure, frame=None, bending=None))
        own = perturb_vehicle(car, self.grade, seed, rigid, k)
        faults = replace(own.faults if self.faults else NO_FAULTS, jitter=0.0, dropout_rate=0.0)
        return _loaded(own.car, self.payload), faults

    @property
    def _severe(self) -> Any:
        sign = self.severity * (1.0 if self.side == "left" else -1.0)
        if self.severe == "lane_change":  # of the standard's offset: the speed makes it severe
            offset = np.copysign(OFFSET, sign)
            return manoeuvres.LaneChange(v=self.v, begin=self.begin, offset=offset)
        shape, _ = SEVERE[self.severe]
        return replace(shape, a_y=sign * shape.a_y, begin=self.begin)

    @property
    def _gentle_begin(self) -> float:
        """Time at which the gentle manoeuvre begins: REST after the severe one."""
        if self.severe == "lane_change":
            return self.begin + sum(self._severe.sections) / self.v + REST
        return self.begin + SEVERE[self.severe][1] + REST


OFFSET = 3.5  # offset of the double lane change [m], ISO 3888-1:2018, table 1
SEVERE: dict[str, tuple[Any, float]] = {
    "j_turn": (manoeuvres.SteadyTurn(a_y=4.6, build_up=0.4, hold=2.5), 3.3),
    "fishhook": (manoeuvres.Fishhook(a_y=4.2, build_up=0.4, dwell=0.25, hold=2.0), 3.7),
}
"""Shapes of the severe manoeuvres, and how long they last [s]."""
GENTLE: dict[str, Any] = {
    "steady_turn": manoeuvres.SteadyTurn(a_y=2.0, build_up=1.0, hold=3.0),
    "slalom": manoeuvres.Slalom(a_y=2.0, period=3.0, periods=2.0),
}
BRAKING = manoeuvres.Braking(a_x=3.0, build_up=0.3, hold=1.5)
"""Shapes of the gentle manoeuvres; amplitudes are assumed."""
REST = 1.0  # time [s] before a gentle manoeuvre


@dataclass(frozen=True, kw_only=True)
class _DriveRanges(Settings):
    """Ranges from which the drives of a group are drawn."""

    road: tuple[RoadClass, ...]
    speed_kmh: Range
    severe: tuple[Severe, ...]
    gentle: tuple[Gentle, ...]
    severity: Range
    bump_height: Range
    payload: Range


@dataclass(frozen=True, kw_only=True)
class _SafeBenchmark(Settings):
    """Ranges of the drives; `groups` are the shares of the groups in each split."""

    name: str
    duration: Range
    known: _DriveRanges
    unseen: _DriveRanges
    groups: dict[str, dict[str, float]]
    sources: dict[str, str] = field(default_factory=dict)


def load_benchmark() -> _SafeBenchmark:
    """Load the ranges of the benchmark."""
    return config.load(_SafeBenchmark, "benchmarks", "safe4s4_v1")


def draw_drive(
    benchmark: _SafeBenchmark, split: str, rng: np.random.Generator, fixed: dict[str, Any]
) -> SafeDrive:
    """Draw a drive of a split; `fixed` fields replace what is drawn. Raises ConfigError."""
    known = [f.name for f in fields(SafeDrive)]
    if extra := fixed.keys() - set(known):
        raise UnknownKeyError(f"unknown reset options {sorted(extra)}; known: {', '.join(known)}")
    shares = benchmark.groups["test" if split == "sealed" else split]
    group = fixed.get("group", str(rng.choice(list(shares), p=list(shares.values()))))
    config.validate_choice("group", group, ["known", "unseen"])
    ranges: _DriveRanges = getattr(benchmark, group)
    sides = ("left", "right")
    # all draws are made, whatever is fixed: fixing one field leaves the others as they are
    drawn = {
        "group": group,
        "duration": round(rng.uniform(*benchmark.duration) / TIME_QUANTUM) * TIME_QUANTUM,
        "road": _choice(rng, ranges.road),
        "road_after": _choice(rng, ranges.road),
        "change": rng.uniform(0.3, 0.7),
        "speed_kmh": rng.uniform(*ranges.speed_kmh),
        "severe": _choice(rng, ranges.severe),
        "side": _choice(rng, sides),
        "begin": rng.uniform(3.0, 8.0),
        "severity": rng.uniform(*ranges.severity),
        "gentle": _choice(rng, ranges.gentle),
        "gentle_side": _choice(rng, sides),
        "gentle_severity": rng.uniform(0.6, 1.0),
        "bumps": int(rng.integers(0, 3)),
        "bump_height": rng.uniform(*ranges.bump_height),
        "grade": _choice(rng, ("S0", "S1", "S2", "S3")),
        "payload": rng.uniform(*ranges.payload),
    }
    drawn["faults"] = fixed.get("grade", drawn["grade"]) == "S3"
    return config.build(SafeDrive, drawn | fixed, "reset options")


def _choice(rng: np.random.Generator, choices: tuple[str, ...]) -> str:
    return choices[int(rng.integers(len(choices)))]


def _loaded(car: VehicleParameters, payload: float) -> VehicleParameters:
    """Return the car with a `payload` [kg] above its rear axle, at the height of its own mass."""
    if payload == 0.0:
        return car
    mass = car.m_b + payload
    back = -payload * car.rear.x / mass  # the centre of mass moves towards the rear axle
    front, rear = (cast(Any, replace)(axle, x=axle.x + back) for axle in car.axles)
    I_yy = car.I_yy + car.m_b * back**2 + payload * (car.rear.x + back) ** 2
    return replace(car, m_b=mass, I_yy=I_yy, front=front, rear=rear)
