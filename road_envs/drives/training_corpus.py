"""Corpus of simulated drives for pretraining, with domain randomisation.

Drive k of a corpus has its own random generator, so that drives can be simulated in any order and
reproduced individually. The corpus is disjoint from the tasks of the benchmark: its roads have
seeds that no task can have.

    roads    ISO 8608 with a waviness of 1.6 to 2.4, some with varying roughness; Belgian pavings
             of varying height; bumps, humps and potholes on smoother roads
    speed    log-uniform
    modes    half of the drives in ride or handling, a fifth mixed front to rear, the rest any of
             the sixteen combinations
    vehicles two thirds: masses, stiffness, damping and friction deviate by up to 10-20 %; the
             scale of the deviation is random too, so that most are close to the nominal vehicle.
             The others: individuals of the grades S1 to S3 (`vehicle/perturbed_vehicle.py`), with
             their manufacture, structure and sensor faults, of seeds that no task can have
    sensors  noise from a third to twice the nominal one; gains deviate by about 1 %
"""

import dataclasses
import hashlib
import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np

from road_envs.core.config import Count, Settings
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Profile, Record
from road_envs.records.roughness import CLASSES
from road_envs.roads import Belgian, Bumps, Defects, Iso8608, Potholes, Road, Scaled, Superposed
from road_envs.roads.iso8608 import RoughnessVariation
from road_envs.roads.obstacles import LAYOUTS, Defect
from road_envs.sensing.data_logger import load_instruments
from road_envs.sensing.perturbed_vehicle import load_plant_mismatch
from road_envs.simulation.drive import SimulationError
from road_envs.vehicle.axles import Axle
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.struts import CoilSpring, Strut
from road_envs.vehicle.suspension import MODES
from road_envs.vehicle.tolerances import scale_parameters

SEED_STREAM = 0x7EAC4  # first entry of the seed of every drive; no task uses it

GRADE_SHARES = {"S0": 0.66, "S1": 0.06, "S2": 0.14, "S3": 0.14}
"""Shares of the grades. The odometer of S0 to S2 is exact; that of S3 is off by up to 0.2 m."""

WHEEL_PATHS: tuple[Literal["left", "right", "both"], ...] = ("left", "right", "both", "both")
ATTEMPTS = 10  # number of drives that are tried if the simulation fails


@dataclass(frozen=True, kw_only=True)
class Corpus(Settings):
    """Corpus of `number` drives of randomised variants of the `car` and the `instruments`."""

    number: Annotated[Count, "", "number of drives"] = 2000
    seed: int = 1
    car: str = "land_rover_defender_110"
    instruments: str = "paper"
    slowest_kmh: float = 5.0
    fastest_kmh: float = 72.0
    shortest: int = 100  # [m]
    longest: int = 200

    @cached_property
    def vehicle(self) -> VehicleParameters:
        """The nominal vehicle."""
        return load_vehicle(self.car)

    @property
    def digest(self) -> str:
        """Digest of settings, vehicle, deviations and instruments, by which weights name it."""
        # field names enter the digest: a renamed field detaches the shipped weights
        settings = (self, self.vehicle, self.sensors, load_plant_mismatch())
        parts = [dataclasses.asdict(x) for x in settings]
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:12]

    @cached_property
    def sensors(self) -> Any:
        """The nominal instruments."""
        return load_instruments(self.instruments)

    def simulate_drive(self, k: int, nominal: bool = False) -> tuple[Record, Profile, bool]:
        """Simulate drive `k`: record, true profile, and whether the body neither twists nor bends.

        Every call gives the same. With `nominal` the nominal vehicle and instruments drive over the
        same road in the same mode. Raises SimulationError if all attempts fail.
        """
        for attempt in range(ATTEMPTS):
            rng = np.random.default_rng([SEED_STREAM, self.seed, k, attempt])
            try:
                return self._simulate(rng, nominal)
            except SimulationError as error:
                last_error = error
        raise last_error

    def _simulate(self, rng: np.random.Generator, nominal: bool) -> tuple[Record, Profile, bool]:
        length = 10.0 * rng.integers(self.shortest // 10, self.longest // 10 + 1)
        surface = _draw_road(rng, length).realise(rng)
        front, rear = _draw_modes(rng)  # drawn for every car, so that seeds keep their roads
        mode = None if self.vehicle.is_passive else {"front": front, "rear": rear}
        grade = str(rng.choice(list(GRADE_SHARES), p=list(GRADE_SHARES.values())))
        deviation_scale = rng.uniform() if grade == "S0" else 0.0  # the others have their own
        noise = float(np.exp(rng.uniform(-1.0, 0.7)))
        if nominal:
            grade, deviation_scale, noise = "S0", 0.0, 1.0
        density = noise * self.sensors.noise_density
        instruments = dataclasses.replace(self.sensors, noise_density=density, speed_error=0.0)
        record, truth = simulate_record(
            surface,
            vehicle=_perturb_parameters(self.vehicle, rng, deviation_scale),
            speed_kmh=float(np.exp(rng.uniform(*np.log([self.slowest_kmh, self.fastest_kmh])))),
            mode=mode,
            instruments=instruments,
            grade=grade,
            seed=np.random.SeedSequence(rng.integers(2**32, size=4).tolist()),
        )
        gains = 1.0 + 0.01 * deviation_scale * rng.standard_normal((3, 1))
        return dataclasses.replace(record, a=gains * record.a), truth, grade in ("S0", "S1")


def drives_in_mode(
    corpus: Corpus,
    mode: str | Mapping[str, str],
    speeds_kmh: tuple[float, float],
    number: int,
    grade: str = "S0",
) -> list[tuple[Record, Profile]]:
    """Simulate `number` drives in one `mode` over roads of 100 m, each by an individual of `grade`.

    Roads as of a corpus, speeds log-uniform. Raises SimulationError if too many drives fail.
    """
    drives: list[tuple[Record, Profile]] = []
    shared: Any = {"vehicle": corpus.vehicle, "instruments": corpus.sensors, "grade": grade}
    for k in itertools.count():
        # the attempt number ATTEMPTS keeps this stream apart from that of `simulate_drive`
        rng = np.random.default_rng([SEED_STREAM, corpus.seed, k, ATTEMPTS])
        speed = float(np.exp(rng.uniform(*np.log(speeds_kmh))))
        road = _draw_road(rng, 100.0).realise(rng)
        try:
            drives.append(simulate_record(road, speed_kmh=speed, seed=k, mode=mode, **shared))
        except SimulationError:
            if k >= ATTEMPTS * number:
                raise
        if len(drives) == number:
            break
    return drives


def _draw_road(rng: np.random.Generator, length: float) -> Road:
    """Draw one of the roads of the module docstring, of about that length [m]."""
    kind = rng.uniform()
    low, high = np.log([0.7 * CLASSES["A"], 2.0 * CLASSES["E"]])
    plain = Iso8608(
        G_d0=float(np.exp(rng.triangular(low, np.log(CLASSES["D"]), high))),
        w=rng.uniform(1.6, 2.4),
        length=length,
    )
    if kind < 0.5:
        return plain
    if kind < 0.65:
        patch = RoughnessVariation(spread=rng.uniform(0.5, 1.0), patch=rng.uniform(20.0, 80.0))
        return dataclasses.replace(plain, variation=patch)
    if kind < 0.85:
        return Scaled(road=Belgian(length=length), height_factor=rng.uniform(0.5, 1.3))
    smooth = dataclasses.replace(plain, G_d0=float(rng.uniform(0.3, 1.0) * CLASSES["B"]))
    return Superposed(roads=(smooth, _draw_obstacles(rng, length)))


def _draw_obstacles(rng: np.random.Generator, length: float) -> Road:
    """Draw potholes, humps or the paper's bumps, of random sizes, on a level road."""
    kind = rng.uniform()
    if kind < 0.35:
        return Potholes(length=length, rate=rng.uniform(0.02, 0.1))
    if kind < 0.75:
        return Defects(length=length, defects=tuple(_hump(rng, length) for _ in range(6)))
    layouts = list(LAYOUTS)
    return Bumps(
        layout=layouts[rng.integers(len(layouts))],
        spacing=rng.uniform(6.0, 14.0),
        length_factor=rng.uniform(0.8, 1.3),
        height_factor=rng.uniform(0.5, 1.1),
        run_in=rng.uniform(5.0, 0.5 * length),
    )


def _hump(rng: np.random.Generator, length: float) -> Defect:
    size = float(np.exp(rng.uniform(np.log(0.3), np.log(4.0))))
    return Defect(
        shape="half_sine",
        at=rng.uniform(5.0, length - 5.0),
        length=size,
        height=float(rng.choice([-1.0, 1.0]) * rng.uniform(0.01, min(0.1, 0.12 * size))),
        side=WHEEL_PATHS[rng.integers(len(WHEEL_PATHS))],
    )


def _draw_modes(rng: np.random.Generator) -> tuple[str, str]:
    kind = rng.uniform()
    if kind < 0.5:
        same = "ride" if kind < 0.25 else "handling"
        return same, same
    if kind < 0.7:
        return ("handling", "ride") if kind < 0.6 else ("ride", "handling")
    front, rear = rng.choice(list(MODES), size=2)
    return str(front), str(rear)


def _perturb_parameters(
    car: VehicleParameters, rng: np.random.Generator, deviation_scale: float
) -> VehicleParameters:
    """Return a perturbed vehicle; the standard deviations are 6 to 15 % of the scale [assumed]."""

    def factor(std: float) -> float:
        return float(np.clip(1.0 + deviation_scale * std * rng.standard_normal(), 0.6, 1.4))

    load, damping, friction = factor(0.06), factor(0.10), factor(0.15)
    losses, factors = {"damper": damping, "friction": friction}, {"m_b": load}
    if isinstance(car.strut, Strut):
        # the gas pressure keeps the height of a heavier body
        factors |= {"strut.p_stat": load, "strut.x_1": factor(0.07), "strut.x_2": factor(0.07)}
        for name, common in losses.items():
            factors |= {f"strut.{name}.{m}": common * factor(0.05) for m in ("ride", "handling")}
    else:
        for end, strut in (("front", car.strut.front), ("rear", car.strut.rear)):
            rate = "k" if isinstance(strut.spring, CoilSpring) else "x"
            factors[f"strut.{end}.spring.{rate}"] = factor(0.07)
            for name, common in losses.items():
                factors[f"strut.{end}.{name}"] = common * factor(0.05)
    tyre = factor(0.08)
    for end, axle in zip(("front", "rear"), car.axles, strict=True):
        factors[f"{end}.m"] = factor(0.07)
        if isinstance(axle, Axle):
            factors[f"{end}.I_xx"] = factor(0.08)
        factors |= {f"{end}.k_t": factor(0.03), f"{end}.c_t": factor(0.15)}
    factors |= {name: factor(0.08) for name in ("I_xx", "I_yy")}
    return scale_parameters(scale_parameters(car, {"front.k_t": tyre, "rear.k_t": tyre}), factors)
