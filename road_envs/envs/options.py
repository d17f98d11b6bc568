"""Options, spaces and episode starts that the scalar and the vector environment share."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import gymnasium
import numpy as np
from pydantic import Field

from road_envs.analysis.information_bound import BoundTable, RoadPrior
from road_envs.core import config
from road_envs.core.config import ConfigError, NonNegative, Positive, Settings, UnknownKeyError
from road_envs.envs import fleet_arrays as fa
from road_envs.envs.failures import ANGLES, MAX_ANGLE, NONFINITE_STEP, ROLLOVER
from road_envs.envs.instrumented_fleet import FleetSettings, InstrumentedFleet
from road_envs.roads import load_road, with_length
from road_envs.roads.surface import Surface
from road_envs.sensing.data_logger import DataLogger, load_instruments
from road_envs.simulation.drive import DriveSimulator
from road_envs.simulation.manoeuvres import load_manoeuvre
from road_envs.simulation.speed import MAX_SPEED_KMH
from road_envs.vehicle.equations import DOF, build_plant
from road_envs.vehicle.parameters import DEFAULT_STEP, Step, load_vehicle
from road_envs.vehicle.suspension import MODES, encode_command

T = TypeVar("T")

RIDE_OR_HANDLING = ("ride", "handling")
ACTIONS: dict[str, tuple[dict[str, str], ...]] = {
    "vehicle": tuple({"front": mode, "rear": mode} for mode in RIDE_OR_HANDLING),
    "axle": tuple({"front": f, "rear": r} for r in RIDE_OR_HANDLING for f in RIDE_OR_HANDLING),
    "states": tuple({"front": front, "rear": rear} for rear in MODES for front in MODES),
}
"""Strut states commanded by the actions 0, 1, ..., for each choice of `control`."""

PASSIVE_ACTIONS = ({"front": "passive", "rear": "passive"},)
"""The only action of a car with passive struts, which changes nothing."""

Speed = Annotated[float, Field(gt=0, le=MAX_SPEED_KMH)]

# parts of an observation that are no accelerometers
RESERVED_NAMES = {"speed", "front", "rear", "planar", "extension", "extension_rate"}
MAX_STEPS = 1_000_000  # most integrator steps in a control interval: 240 MB of signals are kept
MAX_OBSERVED_SPEED = 100.0  # upper limit of the observed speed [m/s]
MAX_DRAWS = 20  # most roads that an episode draws until one has no step too high for a wheel

_bound_tables: dict[tuple[object, ...], BoundTable] = {}  # by all that they depend on


@dataclass(frozen=True, kw_only=True)
class Weights(Settings):
    """Weights of the four costs in the reward, each per second."""

    comfort: Annotated[float, "per m/s²", "of the W_k-weighted RMS heave acceleration"] = 1.0
    rattle: Annotated[float, "per m", "of the RMS strut extension"] = 10.0
    tyre_load: Annotated[float, "", "of the RMS relative tyre load variation"] = 1.0
    unresolved_variance: Annotated[
        NonNegative, "", "of the road's unresolved share of variance"
    ] = 0.0


@dataclass(frozen=True, kw_only=True)
class EnvOptions(Settings):
    """Keyword arguments of the environment; `RoadReconEnv` documents them."""

    road: str | dict[str, Any] = "belgian"
    speed_kmh: Annotated[
        Speed | Annotated[tuple[Speed, Speed], config.SmallestFirst], "km/h", "speed, or its range"
    ] = 14.5
    mode: str | dict[str, str] | None = None
    control: Literal["vehicle", "axle", "states"] = "vehicle"
    control_rate: Annotated[Positive, "Hz", "rate of the actions"] = 20.0
    length: float | None = None
    sensors: str = "paper"
    vehicle: str = "land_rover_defender_110"
    step: Step = DEFAULT_STEP
    manoeuvre: str | dict[str, Any] | None = None
    truth: bool = True
    observe: tuple[Literal["accelerations", "planar", "struts"], ...] = ("accelerations",)
    weights: Weights = field(default_factory=Weights)
    exaggeration: Annotated[Positive, "", "factor on drawn vertical motion"] = 1.0

    def __post_init__(self):
        super().__post_init__()
        encode_command(self.mode)
        if self.manoeuvre is not None:
            load_manoeuvre(self.manoeuvre)
        groups = list(self.observe)
        if "accelerations" not in groups or len(set(groups)) < len(groups):
            raise ValueError(f"observe needs 'accelerations' and no duplicates, got {groups}")
        per_interval = 1.0 / (self.control_rate * self.step)
        if per_interval > MAX_STEPS:
            raise ValueError(
                f"a control interval must have at most {MAX_STEPS} integrator steps: with "
                f"control_rate = {self.control_rate} Hz and step = {self.step} s it has "
                f"{per_interval:.3g}"
            )
        if per_interval < 1.0 or abs(per_interval - round(per_interval)) > 1e-6:
            raise ValueError(
                f"control_rate must give a whole number of integrator steps of {self.step} s, "
                f"got {self.control_rate} Hz"
            )


class EpisodeStart(NamedTuple):
    """Start of one episode; `description` is its `SafeDrive`, if it is one of the benchmark."""

    speed_kmh: float
    command_byte: int
    drive: DriveSimulator
    logger: DataLogger
    description: Any = None


def build_options(cls: type[T], options: Mapping[str, Any], where: str) -> T:
    """Build `cls` from an environment's keyword arguments. Raises ConfigError. An unknown one is
    named in Python's words, by which TorchRL knows what to leave out.
    """
    try:
        return config.build(cls, options, where)
    except UnknownKeyError as error:
        text = str(error)
        for name in options:
            text = text.replace(f"{name}: unknown key", f"unexpected keyword argument {name!r}")
        raise UnknownKeyError(text) from None


def validate_actions(actions: Any, size: int, n_actions: int) -> np.ndarray:
    """Return `actions` as indices (size,) of `n_actions`. Raises ConfigError."""
    indices = np.asarray(actions)
    if indices.shape != (size,) or indices.dtype.kind not in "iu":
        raise ConfigError(
            f"actions must be {size} whole numbers, got {indices.dtype} of shape {indices.shape}"
        )
    wrong = np.flatnonzero((indices < 0) | (indices >= n_actions))
    if wrong.size:
        raise ConfigError(
            f"actions must be 0 to {n_actions - 1}, got {indices[wrong[0]]} for environment "
            f"{wrong[0]}"
        )
    return indices


class EnvSetup:
    """Objects built from the keyword arguments of the environments. Raises ConfigError."""

    output_columns: tuple[str, ...] = fa.OUTPUT_COLUMNS

    def __init__(self, options: dict[str, Any]):
        if isinstance(options.get("weights"), Weights):
            options["weights"] = asdict(options["weights"])
        self.options = o = build_options(EnvOptions, options, "RoadRecon-v0")
        self.car = load_vehicle(o.vehicle)
        encode_command(o.mode, self.car)
        if self.car.is_passive and o.control != "vehicle":
            raise ConfigError(
                f"control = {o.control!r} switches 4S4 struts, but the car {self.car.name} has "
                "passive ones: leave out control; the only action is 0, which changes nothing"
            )
        self.manoeuvre = None if o.manoeuvre is None else load_manoeuvre(o.manoeuvre)
        self.plant = build_plant(self.car, manoeuvres=self.manoeuvre is not None)
        self.instruments = load_instruments(o.sensors)
        if taken := RESERVED_NAMES & self.instruments.accelerometers.keys():
            raise ConfigError(
                f"{o.sensors}: an accelerometer must not be named {min(taken)!r}, which is another "
                "part of the observation"
            )
        road = load_road(o.road)
        self.road = road if o.length is None else with_length(road, o.length)
        self.interval = 1.0 / o.control_rate
        commands = [encode_command(action, self.car) for action in self.actions]
        self.command_bytes = np.array(commands, dtype=np.uint8)
        samples = self.instruments.fs * self.interval
        self.samples_per_interval = round(samples)
        if self.samples_per_interval < 1 or abs(self.samples_per_interval - samples) > 1e-6:
            raise ConfigError(
                f"control_rate must give a whole number of samples at {self.instruments.fs} Hz, "
                f"got {o.control_rate} Hz"
            )
        sizes, *limits = np.array(list(self._parts.values())).T
        low, high = (np.repeat(x, sizes.astype(int)).astype(np.float32) for x in limits)
        self.observation_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gymnasium.spaces.Discrete(len(self.command_bytes))

    @property
    def actions(self) -> tuple[dict[str, str], ...]:
        """Strut states that the actions 0, 1, ... command."""
        return PASSIVE_ACTIONS if self.car.is_passive else ACTIONS[self.options.control]

    @cached_property
    def _parts(self) -> dict[str, tuple[int, float, float]]:
        """Size, lower and upper limit of each named part of an observation."""
        k, sensors = self.samples_per_interval, self.instruments
        ranges = zip(sensors.accelerometers, sensors.ranges, strict=True)
        parts = {name: (k, -limit, limit) for name, limit in ranges}
        parts |= {"speed": (1, 0.0, MAX_OBSERVED_SPEED), "front": (2, 0.0, 1.0)}
        parts["rear"] = parts["front"]
        if "planar" in self.options.observe:
            parts["planar"] = fa.N_PLANAR, -fa.MAX_PLANAR, fa.MAX_PLANAR
        if "struts" in self.options.observe:
            half = fa.N_STRUT_SIGNALS // 2
            parts["extension"] = half, -fa.MAX_EXTENSION, fa.MAX_EXTENSION
            parts["extension_rate"] = half, -fa.MAX_EXTENSION_RATE, fa.MAX_EXTENSION_RATE
        return parts

    @cached_property
    def observation_slices(self) -> dict[str, slice]:
        """Slice of each named part within an observation."""
        ends = np.cumsum([size for size, _, _ in self._parts.values()]).tolist()
        starts = [0, *ends[:-1]]
        return {name: slice(*s) for name, *s in zip(self._parts, starts, ends, strict=True)}

    @cached_property
    def bound_table(self) -> BoundTable:
        """Table of the reconstruction bound on a class-D road, for each pair of strut states."""
        speeds = np.atleast_1d(np.asarray(self.options.speed_kmh, dtype=float)) / 3.6
        if speeds[0] < speeds[-1]:
            speeds = np.linspace(speeds[0], speeds[-1], 5)  # the table interpolates in between
        used = {mode for action in self.actions for mode in action.values()}
        modes = tuple(mode for mode in self.car.modes if mode in used)
        # half a second each: shared by all environments of one vehicle, its instruments and speeds
        key = repr(self.car), repr(self.instruments), tuple(speeds), modes
        if key not in _bound_tables:
            table = BoundTable.tabulate(self.car, self.instruments, RoadPrior(), speeds, modes)
            _bound_tables[key] = table
        return _bound_tables[key]

    def unresolved_variance_by_command(self, v: float) -> np.ndarray:
        """Return the unresolved share (256,) [-] of the road's variance at `v` [m/s], by command
        byte; it is 1 for bytes that no action commands.
        """
        share = np.ones(256)
        for action, byte in zip(self.actions, self.command_bytes, strict=True):
            share[byte] = self.bound_table.interpolate(**action, v=v) ** 2
        return share

    def fleet_settings(self) -> FleetSettings:
        """Settings that the vehicles of all environments have in common."""
        o, by_command = self.options, self.unresolved_variance_by_command
        return FleetSettings(
            self.instruments,
            step=o.step,
            steps=round(self.interval / o.step),
            manoeuvre=self.manoeuvre,
            weights=(o.weights.comfort, o.weights.rattle, o.weights.tyre_load),
            top_speed=MAX_OBSERVED_SPEED,
            planar="planar" in o.observe,
            struts="struts" in o.observe,
            unresolved_variance=by_command if o.weights.unresolved_variance > 0.0 else None,
            unresolved_variance_weight=o.weights.unresolved_variance,
            truth=o.truth,
        )

    def make_fleet(self, n_vehicles: int = 1, **options: Any) -> InstrumentedFleet:
        """Return a fleet at rest, one vehicle for each environment, with these of its `options`."""
        return InstrumentedFleet(self.plant, self.car, self.fleet_settings(), n_vehicles, **options)

    def episode_options(self, options: dict[str, Any]) -> Any:
        """Return the options with those of one episode. Raises ConfigError on unknown ones."""
        known = {"speed_kmh": self.options.speed_kmh, "mode": self.options.mode}
        if extra := options.keys() - known.keys():
            names = ", ".join(known)
            raise UnknownKeyError(f"unknown reset options {sorted(extra)}; known: {names}")
        return config.build(EnvOptions, known | options, "reset options")

    def prepare(self, random: np.random.Generator, o: Any) -> EpisodeStart:
        """Draw the start of an episode from `random`, with the options `o` of a reset."""
        # one stream per cause; new streams go to the end, so that old seeds keep their roads
        road_rng, speed_rng, sensor_rng = random.spawn(3)
        v, step = o.speed_kmh, self.options.step
        speed_kmh = float(v if isinstance(v, int | float) else speed_rng.uniform(*v))
        surface = self._draw_climbable(road_rng)
        drive = DriveSimulator(self.plant, self.car, surface, speed_kmh / 3.6, o.mode, step)
        logger = DataLogger(self.instruments, self.car, step, sensor_rng)
        return EpisodeStart(speed_kmh, encode_command(o.mode, self.car), drive, logger)

    def _draw_climbable(self, random: np.random.Generator) -> Surface:
        """Return the first of MAX_DRAWS roads that every wheel climbs. Raises ConfigError."""
        for draw in range(MAX_DRAWS):
            surface = self.road.realise(random)
            try:
                surface.check_climbable()
                break
            except ConfigError:
                if draw == MAX_DRAWS - 1:
                    raise
        return surface

    @cached_property
    def info_columns(self) -> dict[str, int]:
        """Columns of `StepOutput.values` that `info` holds, by name."""
        unused = () if self.options.weights.unresolved_variance else ("unresolved_variance",)
        columns = enumerate(self.output_columns)
        return {name: j for j, name in columns if name not in ("reward", *unused)}

    def rewards(self, values: np.ndarray) -> np.ndarray:
        """Return the rewards (N,) in the values (N, columns) of an interval."""
        return values[:, self.output_columns.index("reward")]

    def failure(self, output: fa.StepOutput, i: int, road: str) -> tuple[int, str]:
        """Return why the episode of environment `i` on `road` has failed: ROLLOVER or
        NONFINITE_STEP, and in words; 0 and no words if it has not.
        """
        _, rollover, nonfinite_step = output.events[i].tolist()
        if nonfinite_step < 0 and rollover < 0:
            return 0, ""
        begin = round((output.values[i, 0] - self.interval) / self.options.step)
        if nonfinite_step >= 0:
            t = self.options.step * (begin + nonfinite_step)
            return NONFINITE_STEP, f"{road}: the motion is no longer finite at t = {t:.3f} s"
        row, column = divmod(rollover, len(ANGLES))
        t, degrees = self.options.step * (begin + row), np.degrees(MAX_ANGLE)
        text = f"{DOF[ANGLES[column]]} passed {degrees:.0f} degrees at t = {t:.3f} s"
        return ROLLOVER, text
