"""A task: a car on training roads and on test roads, under stated conditions, with all its seeds.

Tasks come from `configs/tasks/*.yaml`, or are made for a surface file. An estimator is trained
once per condition (mode and speed), on that condition's drives, as the paper trains one network
for each case scenario. Training and test never share a seed or a surface; where the paper itself
trains on altered copies of the road it tests on, the task has to say so (`trains_on_test_road`)
and the board prints it.
"""

import dataclasses
import hashlib
import json
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from road_envs import config
from road_envs.config import STRICT, ConfigError
from road_envs.roads import Road, with_length
from road_envs.roads.api import AnyRoad
from road_envs.roads.composite import NoisyCopy
from road_envs.roads.measured import Measured
from road_envs.sensing.data_logger import Instruments, load_instruments
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.perturbed_vehicle import load_plant_mismatch

BoardName = Literal["new_road", "field", "class", "measured", "paper"]
Grade = Literal["S0", "S1", "S2", "S3"]
StrutMode = Literal["ride", "handling", "soft_high", "stiff_low"]

SEED_STRIDE = 10_000
"""Between the seeds of one road of a list and those of the next."""

DESCRIPTIVE_FIELDS = frozenset(
    {"title", "source", "sources", "note", "claimed_level_error", "families"}
)
"""Fields for the reader, in which an edit voids no result."""


@dataclass(frozen=True, kw_only=True)
class AxleModes:
    """Another state of the struts in front than at the rear."""

    __pydantic_config__ = STRICT

    front: StrutMode
    rear: StrutMode


@dataclass(frozen=True, kw_only=True)
class Condition:
    """How the roads are driven."""

    __pydantic_config__ = STRICT

    mode: StrutMode | AxleModes
    speed_kmh: float
    grade: Grade = "S0"  # of the test vehicle (`perturbed_vehicle`); training uses S0

    def __post_init__(self):
        if not self.speed_kmh > 0:
            raise ValueError(f"speed_kmh must be positive, got {self.speed_kmh}")

    @property
    def label(self) -> str:
        """Such as "ride, 14.5 km/h", with the car if it is not that of the training."""
        mode = self.mode
        name = mode if isinstance(mode, str) else f"{mode.front} front, {mode.rear} rear"
        car = "" if self.grade == "S0" else f", car {self.grade}"
        return f"{name}, {self.speed_kmh:g} km/h{car}"

    @property
    def simulator_mode(self) -> str | dict[str, str]:
        """The mode as the simulator takes it."""
        return self.mode if isinstance(self.mode, str) else dataclasses.asdict(self.mode)


@dataclass(frozen=True, kw_only=True)
class DriveSet:
    """Every road at every seed; the first `number` of them, seed by seed, where it is given."""

    __pydantic_config__ = STRICT

    roads: tuple[AnyRoad, ...]
    seeds: tuple[int, ...]
    number: int | None = None
    length: float | None = None  # [m]; else each road's own
    step: float = 0.001  # [s] of the integrator
    noise: bool = True  # of the instruments
    families: tuple[str, ...] = ()  # to which each of the roads belongs, for a closer look

    def __post_init__(self):
        if not self.roads or not self.seeds:
            raise ValueError("at least one road and one seed are wanted")
        if self.families and len(self.families) != len(self.roads):
            raise ValueError(f"{len(self.roads)} families are wanted, got {len(self.families)}")
        if len(set(self.seeds)) < len(self.seeds) or min(self.seeds) < 0:
            raise ValueError(f"seeds must differ and not be negative, got {list(self.seeds)}")
        most = len(self.roads) * len(self.seeds)
        if self.number is not None and not 1 <= self.number <= most:
            raise ValueError(f"number of drives must be 1 to {most}, got {self.number}")
        if not self.step > 0:
            raise ValueError(f"step must be positive, got {self.step}")

    @property
    def roads_and_seeds(self) -> list[tuple[Road, int]]:
        """The roads to drive, each with the seed that realises it.

        Equal seeds would give related roads, so the k-th road of the list adds k x SEEDS_APART.
        """
        pairs = [
            (self._with_length(road), seed + k * SEED_STRIDE)
            for seed in self.seeds
            for k, road in enumerate(self.roads)
        ]
        return pairs[: self.number]

    @property
    def all_seeds(self) -> set[int]:
        """Every seed that `pairs` could hold."""
        return {seed + k * SEED_STRIDE for seed in self.seeds for k in range(len(self.roads))}

    def indices_of_family(self, family: str) -> list[int]:
        """Which of `pairs` belong to a family."""
        kinds = [self.families[k % len(self.roads)] for k in range(len(self.roads_and_seeds))]
        return [k for k, kind in enumerate(kinds) if kind == family]

    def _with_length(self, road: Road) -> Road:
        return road if self.length is None else with_length(road, self.length)


@dataclass(frozen=True, kw_only=True)
class Task:
    """What is driven, learnt from and judged; a changed task voids its results."""

    __pydantic_config__ = STRICT

    name: str
    title: str
    board: BoardName
    version: int
    car: str
    instruments: str
    conditions: tuple[Condition, ...]
    training: DriveSet
    test: DriveSet
    trains_on_test_road: bool = False
    bumps: bool = False  # score obstacles too
    claimed_level_error: float | None = None  # [-] eq. 12 as the paper prints it
    source: str = ""
    note: str = ""  # what a reader of the board has to know

    def __post_init__(self):
        if not re.fullmatch(r"[A-Za-z0-9_.-]+", self.name):
            raise ValueError(f"name {self.name!r} may have letters, digits, '_', '-' and '.' only")
        if not self.conditions:
            raise ValueError("at least one condition is wanted")
        if shared := sorted(self.training.all_seeds & self.test.all_seeds):
            raise ValueError(f"training and test share the seeds {shared}")
        if not self.trains_on_test_road and self._shared_surfaces():
            raise ValueError(
                "training has a surface of the test; choose other roads, or say so with "
                "trains_on_test_road: true"
            )

    @cached_property
    def vehicle(self) -> VehicleParameters:
        """The car that is driven. Raises ConfigError."""
        return load_vehicle(self.car)

    @cached_property
    def sensors(self) -> Instruments:
        """The instruments of the drives. Raises ConfigError."""
        return load_instruments(self.instruments)

    @cached_property
    def digest(self) -> str:
        """sha256 of all that decides drives and scores: task, roads, car, instruments, files."""
        parts: list[Any] = [self, self.vehicle, self.sensors]
        if any(condition.grade != "S0" for condition in self.conditions):
            parts.append(load_plant_mismatch())
        text = json.dumps([_canonical(part) for part in parts], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def grade(self, drives: DriveSet, condition: Condition) -> Grade:
        """The car that is driven: trainings are always on the nominal one."""
        return condition.grade if drives is self.test else "S0"

    def seed_stream(self, condition: Condition) -> int:
        """A number that conditions share which differ in the car alone: on each road they are then
        driven by one individual, whose departures from the drawing grow with its grade.
        """
        driven = [(c.mode, c.speed_kmh) for c in self.conditions]
        return driven.index((condition.mode, condition.speed_kmh))

    @property
    def has_several_test_drives(self) -> bool:
        """Whether it has test drives to choose from."""
        return len(self.test.roads) * len(self.test.seeds) > 1

    def with_test_drives(self, number: int | None) -> "Task":
        """The same task with another number of test drives per condition, all of them for None.

        Raises ConfigError.
        """
        try:
            test = dataclasses.replace(self.test, number=number)
        except ValueError as error:
            raise ConfigError(f"{self.name}: {error}") from None
        return dataclasses.replace(self, test=test)

    def _shared_surfaces(self) -> bool:
        fixed = [road for road in self.test.roads if not _is_random(road)]
        return any(_base_road(road) in map(_base_road, fixed) for road in self.training.roads)


def load_task(name: str | Path) -> Task:
    """A task by shipped name or YAML path. Raises ConfigError."""
    task = config.load(Task, "tasks", name)
    stem = Path(name).stem
    if task.name != stem:
        raise ConfigError(f"{name}: the task is called {task.name!r}, its file {stem!r}")
    return task


def shipped_tasks(board: BoardName | None = None) -> list[Task]:
    """All shipped tasks, or those of one board; the paper's cases in their order."""
    tasks = [load_task(name) for name in config.names("tasks")]
    return [task for task in tasks if board in (None, task.board)]


def _is_random(road: Road) -> bool:
    """Whether a road is another surface at every seed, and not one surface for ever."""
    one, other = (road.realise(np.random.default_rng(seed)).z for seed in (0, 1))
    return not np.array_equal(one, other)


def _base_road(road: Road) -> Road:
    """The road from which an altered one is made."""
    return _base_road(road.road) if isinstance(road, NoisyCopy) else road


def _canonical(value: Any) -> Any:
    """`value` as JSON types: dataclasses with the name of their class, surface files by content."""
    if dataclasses.is_dataclass(value):
        names = [f.name for f in dataclasses.fields(value) if f.name not in DESCRIPTIVE_FIELDS]
        fields = {name: _canonical(getattr(value, name)) for name in names}
        if isinstance(value, Measured):
            fields["path"] = hashlib.sha256(Path(value.path).read_bytes()).hexdigest()
        return {"is": type(value).__name__, **fields}
    if isinstance(value, tuple | list):
        return [_canonical(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _canonical(item) for key, item in value.items()}
    return value if isinstance(value, str | int | float | bool | type(None)) else repr(value)
