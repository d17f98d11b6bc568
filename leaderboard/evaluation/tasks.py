"""Tasks: a vehicle on training and test roads, the conditions of the drives, and all seeds.

Tasks come from `configs/tasks/*.yaml` or are generated for a surface file. An estimator is trained
once per condition (mode and speed) on the drives of that condition, as the paper trains one network
for each scenario. Training and test share neither a seed nor a surface, but in tasks that follow
the paper (`trains_on_test_road`, which the board prints).
"""

import dataclasses
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from leaderboard.evaluation.boards import BoardDefinition, shipped_boards
from leaderboard.evaluation.drive_set import DriveSet, at_length
from leaderboard.evaluation.task_files import settings_digest, with_paths
from leaderboard.kept_drives import kept_digest
from leaderboard.shared_surfaces import repeated_road, share_a_surface, shared_seeds
from road_envs.core import config
from road_envs.core.config import ConfigError, Count, Positive, Settings
from road_envs.core.reading import parsing
from road_envs.plants.commonroad_car import as_driven
from road_envs.roads import Road
from road_envs.roads.api import AnyRoad
from road_envs.roads.composite import NoisyCopy
from road_envs.sensing.data_logger import Instruments, load_instruments
from road_envs.sensing.perturbed_vehicle import (
    PerturbedVehicle,
    load_plant_mismatch,
    perturb_vehicle,
)
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.suspension import encode_command

Grade = Literal["S0", "S1", "S2", "S3", "S4"]
StrutMode = Literal["ride", "handling", "soft_high", "stiff_low", "passive"]

ALL_DRIVES = "all drives"  # name of the group of all drives on a page


@dataclass(frozen=True, kw_only=True)
class _AxleModes(Settings):
    """Different strut modes in front and at the rear."""

    front: StrutMode
    rear: StrutMode


@dataclass(frozen=True, kw_only=True)
class ModeAndSpeed(Settings):
    """Strut mode and speed of a drive."""

    mode: StrutMode | _AxleModes
    speed_kmh: Annotated[Positive, "km/h"]

    @property
    def simulator_mode(self) -> str | dict[str, str]:
        """Mode in the form that the simulator accepts."""
        return self.mode if isinstance(self.mode, str) else dataclasses.asdict(self.mode)


@dataclass(frozen=True, kw_only=True)
class Condition(ModeAndSpeed):
    """Strut mode, speed and plant-mismatch grade of a drive."""

    grade: Grade = "S0"  # of the test vehicle (`perturbed_vehicle`); training uses S0
    car: str | None = None  # instead of the task's
    plant: Literal["mujoco", "commonroad"] | None = None  # of other projects, whose drives are kept

    @property
    def label(self) -> str:
        """Name such as "ride, 14.5 km/h", with the grade if it is not S0."""
        mode = self.mode
        name = mode if isinstance(mode, str) else f"{mode.front} front, {mode.rear} rear"
        car = "" if self.grade == "S0" else f", car {self.grade}"
        of = "".join(f", {Path(part).stem}" for part in (self.car, self.plant) if part)
        return f"{name}, {self.speed_kmh:g} km/h{car}{of}"


@dataclass(frozen=True, kw_only=True)
class _CalibrationRun(ModeAndSpeed):
    """A drive of each test vehicle that estimators are given before its test drive.

    On the test road of a seed, the vehicle has driven over `road` of seed + `seed_offset`. With
    `survey_std` [m], the standard deviation of independent errors, its profile is given too.
    """

    road: AnyRoad
    seed_offset: Count
    length: float | None = None  # [m]; else the road's own
    survey_std: Annotated[Positive | None, "m"] = None

    @property
    def driven_road(self) -> Road:
        """The road at the length that is driven."""
        return at_length(self.road, self.length)


@dataclass(frozen=True, kw_only=True)
class Task(Settings):
    """Training and test drives under some conditions; changing a task invalidates its results."""

    name: str
    title: str
    board: str | BoardDefinition  # a shipped board, or one of its own, with the name of the task
    version: int
    car: str
    instruments: str
    conditions: Annotated[tuple[Condition, ...], Field(min_length=1)]
    training: DriveSet
    test: DriveSet
    calibration: tuple[_CalibrationRun, ...] = ()  # drives of each test vehicle, given before
    low_pass: Annotated[Positive | None, "Hz", "of all accelerations, as in the paper"] = None
    trains_on_test_road: bool = False
    position_noise: bool = False  # of the fixes of the test drives, as of a receiver
    bumps: bool = False  # also score obstacles
    bound: bool = True  # also compute the information bound of every drive
    claimed_level_error: float | None = None  # [-] eq. 12, value printed in the paper
    source: str = ""
    note: str = ""  # remark printed on the board

    def __post_init__(self):
        super().__post_init__()
        if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*", self.name):
            raise ValueError(f"name {self.name!r} may have letters, digits, '_', '-' and '.' only")
        if isinstance(self.board, str):
            config.validate_choice("board", self.board, shipped_boards())
        labels = [condition.label for condition in self.conditions]
        if len(set(labels)) < len(labels):
            raise ValueError(f"conditions must have labels that differ, got {labels}")
        self._check_groups(labels)
        self._check_plants()
        if self.training.design or len(self.test.design) not in (0, len(self.conditions)):
            raise ValueError(
                "a design lists the test drives of every condition: "
                f"{len(self.conditions)} lists, none for training"
            )
        if self.position_noise and any(c.grade not in ("S3", "S4") for c in self.conditions):
            raise ValueError("position_noise needs the position fixes of S3 or S4 everywhere")
        if self.low_pass and self.low_pass >= 0.5 * self.sensors.fs:
            raise ValueError(
                f"low_pass must be below {0.5 * self.sensors.fs:g} Hz, half the sampling rate of "
                f"{self.instruments}, got {self.low_pass:g} Hz"
            )
        if shared := shared_seeds(self.training, self.test):
            raise ValueError(f"training and test share the seeds {shared}")
        if kind := repeated_road(self.test):
            raise ValueError(
                f"no seed varies the road {kind}, so the test needs a single seed and may list "
                "each surface once"
            )
        self._check_calibration()
        apart = not self.trains_on_test_road
        if apart and share_a_surface(self.test.roads, self.training.roads):
            raise ValueError(
                "training and test share a surface; choose other roads, or set "
                "trains_on_test_road: true"
            )

    @property
    def heading(self) -> str:
        """Title, and the car of the test drives where it is not that of the training."""
        grades = {condition.grade for condition in self.conditions}
        if len(grades) > 1 or grades == {"S0"}:
            return self.title
        return f"{self.title}; evaluated on the field car {grades.pop()}, trained on S0"

    @property
    def training_delays(self) -> list[float]:
        """Delay [m] of the road of each training drive, 0 if it is no delayed copy."""
        roads = [road for road, _ in self.training.roads_and_seeds]
        return [road.delay if isinstance(road, NoisyCopy) else 0.0 for road in roads]

    @property
    def board_name(self) -> str:
        """Name of the board of this task."""
        return self.board if isinstance(self.board, str) else self.name

    @property
    def board_definition(self) -> BoardDefinition:
        """Definition of the board of this task."""
        return shipped_boards()[self.board] if isinstance(self.board, str) else self.board

    @property
    def is_public(self) -> bool:
        """Whether the test roads can be drawn by anybody: those of a shipped task, not a season."""
        return self.name in config.names("tasks")

    @cached_property
    def vehicle(self) -> VehicleParameters:
        """Nominal parameters of the vehicle. Raises ConfigError."""
        return load_vehicle(self.car)

    def vehicle_of(self, condition: Condition) -> VehicleParameters:
        """Return the vehicle that is described to estimators under a condition."""
        car = self.vehicle if condition.car is None else load_vehicle(condition.car)
        return as_driven(car) if condition.plant == "commonroad" else car

    @cached_property
    def sensors(self) -> Instruments:
        """Instruments of the vehicle. Raises ConfigError."""
        return load_instruments(self.instruments)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all inputs of drives and scores: task, roads, vehicle, instruments, files."""
        parts: list[Any] = [self, self.vehicle, self.sensors]
        parts += [self.vehicle_of(condition) for condition in self.conditions if condition.car]
        parts += [kept_digest(condition.plant) for condition in self.conditions if condition.plant]
        if any(condition.grade != "S0" for condition in self.conditions):
            parts.append(load_plant_mismatch())
        return settings_digest(parts)

    def seed_stream(self, condition: Condition) -> int:
        """Return the stream of the sensor noise under a condition, one for those of any grade."""
        driven = [(c.mode, c.speed_kmh) for c in self.conditions]
        return driven.index((condition.mode, condition.speed_kmh))

    def individual(self, index: int, grade: Grade) -> PerturbedVehicle:
        """Return the vehicle of a `grade` on the test road of this index in `roads_and_seeds`."""
        _, seed = self.test.roads_and_seeds[index]
        return perturb_vehicle(self.vehicle, grade, np.random.SeedSequence(seed))

    def drives_of(self, drives: DriveSet, condition: Condition) -> list[tuple[int, Road, int]]:
        """Return index, road and seed of the training or test drives under a condition."""
        pairs = drives.roads_and_seeds
        if drives is not self.test:
            return [(k, road, seed) for k, (road, seed) in enumerate(pairs)]
        design = drives.design or [range(len(pairs))] * len(self.conditions)
        return [(k, *pairs[k]) for k in design[self.conditions.index(condition)]]

    @property
    def has_several_test_drives(self) -> bool:
        """True if the number of test drives can be reduced."""
        return len(self.test.roads) * len(self.test.seeds) > 1

    def with_test_drives(self, number: int | None) -> "Task":
        """Return the task with this number of test drives under every condition; None takes all.

        Raises ConfigError if there are fewer.
        """
        try:
            test = dataclasses.replace(self.test, number=number, design=())
        except ValueError as error:
            raise ConfigError(f"{self.name}: {error}") from None
        return dataclasses.replace(self, test=test)

    def with_test_length(self, length: float) -> "Task":
        """Return the task on test roads of this length [m], which its note says."""
        note = f"{self.note} Test roads of {length:g} m.".strip()
        test = dataclasses.replace(self.test, length=length)
        return dataclasses.replace(self, test=test, note=note)

    def _check_groups(self, labels: list[str]) -> None:
        """Raise ValueError if a name stands for other drives as well."""
        for family in self.test.families:  # as `report.run_groups` names conditions and cars
            if family in ("", ALL_DRIVES, *labels) or family.startswith(("car ", "frame ")):
                raise ValueError(
                    "families need names that are no condition, car or frame, nor "
                    f"{ALL_DRIVES!r}, got {family!r}"
                )
        if not isinstance(self.board, str) and self.name in shipped_boards():
            raise ValueError(
                f"a task with a board of its own cannot be named as the board {self.name}"
            )

    def _check_plants(self) -> None:
        """Raise ValueError on what drives of foreign plants do not have."""
        if not any(condition.plant for condition in self.conditions):
            return
        absent = {
            "a low_pass": self.low_pass is not None,
            "test drives without noise": not self.test.noise,
            "a grade": any(c.plant and c.grade != "S0" for c in self.conditions),
        }
        if asked := [name for name, is_asked in absent.items() if is_asked]:
            raise ValueError(f"conditions on a plant cannot have {asked[0]}")

    def _check_calibration(self) -> None:
        """Raise ValueError if a calibration drive shares a seed, or a surface of the test."""
        others = [self.training, self.test]
        for run in self.calibration:
            seeds = tuple(seed + run.seed_offset for seed in sorted(self.test.all_seeds))
            drives = DriveSet(roads=(run.road,), seeds=seeds)
            if shared := sorted({x for other in others for x in shared_seeds(drives, other)}):
                raise ValueError(f"a calibration drive shares the seeds {shared} with other drives")
            if share_a_surface([run.road], self.test.roads):
                raise ValueError(
                    "a calibration drive and a test drive share a surface; choose another road for "
                    "the calibration"
                )
            others.append(drives)


def load_task(name: str | Path) -> Task:
    """Load a task by shipped name or YAML path. Raises ConfigError.

    The paths of files in a task are relative to its own file.
    """
    path = config.find("tasks", name)
    with parsing(path, ConfigError, "not valid YAML"):
        data = with_paths(config.read_yaml(path), lambda file: str(path.parent / file))
    task = config.build(Task, data, str(path))
    stem = Path(name).stem
    if task.name != stem:
        raise ConfigError(
            f"{name}: the task is named {task.name!r} but its file {stem!r}; give both one name"
        )
    if stem in config.names("tasks") and path != config.find("tasks", stem):
        if task.digest != load_task(stem).digest:
            raise ConfigError(f"{name}: {stem} is the name of another, shipped task; change it")
    for condition in task.conditions:
        try:
            encode_command(condition.simulator_mode, task.vehicle_of(condition))
        except ConfigError as error:
            raise ConfigError(f"{name}: conditions: {error}") from None
    return task


def shipped_tasks(board: str | None = None) -> list[Task]:
    """Return all shipped tasks, or those of one board, ordered by name."""
    tasks = [load_task(name) for name in config.names("tasks")]
    return [task for task in tasks if board in (None, task.board_name)]
