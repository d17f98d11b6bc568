"""Gymnasium environment `RoadRecon/Safe4S4-v1`: comfort, never on two wheels."""

from dataclasses import dataclass
from hashlib import sha256
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np

from road_envs.core.config import ConfigError, Positive, Settings
from road_envs.envs.instrumented_fleet import FleetSettings
from road_envs.envs.options import EnvSetup, EpisodeStart, build_options
from road_envs.envs.road_recon import RoadReconEnv
from road_envs.envs.safe_drives import SafeDrive, draw_drive, load_benchmark
from road_envs.envs.safety_step import SAFETY_COLUMNS
from road_envs.envs.vector import RoadReconVectorEnv
from road_envs.sensing.data_logger import DataLogger
from road_envs.simulation.drive import DriveSimulator
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.suspension import encode_command

REWARD_TERMS = ("comfort", "tyre_load", "cost")  # of the vector reward, each with a minus sign


@dataclass(frozen=True, kw_only=True)
class SafeOptions(Settings):
    """Keyword arguments of the environment; `Safe4S4Env` documents them."""

    split: Literal["train", "test", "sealed"] = "train"
    seal: str | None = None
    control_rate: Annotated[Positive, "Hz", "rate of the actions"] = 20.0
    vector_reward: bool = False

    def __post_init__(self):
        super().__post_init__()
        _split_key(self.split, self.seal)


def _split_key(split: str, seal: str | None) -> int:
    """Return the part of the random entropy that keeps the splits apart, by the secret text of the
    sealed test. Raises ConfigError without one, and on one for another split.
    """
    if (split == "sealed") != (seal is not None):
        raise ConfigError(
            f"the split 'sealed', and no other, needs a seal: its secret text; got split = "
            f"{split!r}, seal = {'a text' if seal else seal!r}"
        )
    return int.from_bytes(sha256(f"{split}:{seal}".encode()).digest()[:8], "big")


class Safe4S4Setup(EnvSetup):
    """Objects built from the keyword arguments of the benchmark. Raises ConfigError."""

    output_columns = SAFETY_COLUMNS

    def __init__(self, options: dict[str, Any]):
        self.safe = build_options(SafeOptions, options, "RoadRecon/Safe4S4-v1")
        self.benchmark = load_benchmark()
        rate, groups = self.safe.control_rate, ["accelerations", "planar", "struts"]
        fixed = {"road": "flat", "control": "states", "observe": groups, "truth": False}
        super().__init__(fixed | {"control_rate": rate})

    def fleet_settings(self) -> FleetSettings:
        return super().fleet_settings()._replace(individual=True)

    def rewards(self, values: np.ndarray) -> np.ndarray:
        """Return the rewards (N,), or (N, 3) as a vector, in the values of an interval."""
        if not self.safe.vector_reward:
            return super().rewards(values)
        return -values[:, [self.output_columns.index(name) for name in REWARD_TERMS]]

    def episode_options(self, options: dict[str, Any]) -> Any:
        """Return the fields of `SafeDrive` that a reset fixes. Raises ConfigError."""
        draw_drive(self.benchmark, self.safe.split, np.random.default_rng(0), options)
        return dict(options)

    def draw(
        self, random: np.random.Generator, fixed: dict[str, Any]
    ) -> tuple[SafeDrive, list[np.random.SeedSequence]]:
        """Draw a description, and the seeds of the road, the car and the sensors."""
        # one stream per cause, of entropy that differs between the splits
        key = _split_key(self.safe.split, self.safe.seal)
        root = np.random.SeedSequence([key, *random.integers(2**32, size=4).tolist()])
        drive_seed, *others = root.spawn(4)
        rng = np.random.default_rng(drive_seed)
        return draw_drive(self.benchmark, self.safe.split, rng, fixed), others

    def prepare(self, random: np.random.Generator, o: Any) -> EpisodeStart:
        """Draw the start of a drive from `random`; the fields `o` of `SafeDrive` are fixed."""
        fixed = o if isinstance(o, dict) else {}  # after an episode a vector environment has none
        description, (road_seed, car_seed, sensor_seed) = self.draw(random, fixed)
        surface = description.realise_surface(np.random.default_rng(road_seed), self.car)
        k, step = len(self.instruments.accelerometers), self.options.step
        car, faults = description.individual_car(self.car, car_seed, k)
        plant, speed = build_plant(car, manoeuvres=True), description.speed_profile
        drive = DriveSimulator(plant, car, surface, speed, None, step, description.manoeuvre)
        drive.limit_duration(description.duration)
        logger = DataLogger(self.instruments, car, step, np.random.default_rng(sensor_seed), faults)
        byte = encode_command(None, car)
        return EpisodeStart(description.speed_kmh, byte, drive, logger, description)


class Safe4S4Env(RoadReconEnv):
    """Benchmark of semi-active switching: comfort, never on two wheels.

    ## Description
    A vehicle with the 4S4 suspension of `RoadReconEnv` drives for 20 to 30 s over a rough track
    whose ISO class changes on the way, with bumps, a severe manoeuvre (double lane change of
    ISO 3888-1 with its 3.5 m, J-turn or fishhook) and a gentle one (steady turn, slalom, or braking
    with falling speed). Environment, distribution of the drives and reward are frozen: a change of
    any is another version.

    ## Spaces
    Those of `RoadReconEnv` with `control="states"`, `Discrete(16)`, and
    `observe=["accelerations", "planar", "struts"]`.

    ## Rewards
    Minus `comfort`: the time integral [m²/s³] of the squared W_k-weighted vertical acceleration
    (ISO 2631-1) at the front seats, of heave, pitch and roll; the mean over both, so that left and
    right are equal. Integrals of squares add up, whatever the control rate. Safety is a constraint:
    `info["cost"]` is the time [s] within the interval for which both wheels of a side have been off
    the ground for more than 20 ms, or a strut is at its bump stop. With `vector_reward` the reward
    is minus (`comfort`, `tyre_load`, `cost`), `reward_space` its space.

    `info` also holds `t` [s], `station` [m], `speed_kmh`, `tyre_load` [s] (integral of the squared
    load over static load, above 0.4 Hz, so without its quasi-static share), `stop` [s] at a bump
    stop, `lift_off` [s] with a side off the ground, the largest `load_transfer` ratio, the
    difference of left and right over their sum, and `roll` [rad], and `reason`.

    ## Starting State
    Each reset draws from its seed a `SafeDrive`, the road, the individual car with its payload and
    the sensor noise and faults, each from its own stream. `reset(options={...})` fixes any field of
    `SafeDrive`; the others stay as they are drawn.

    ## Episode End
    Truncated when the time of the drive is over; terminated as in `RoadReconEnv`.

    ## Arguments

    | keyword | default | meaning |
    |---|---|---|
    | `split` | `"train"` | `"train"`, `"test"` (public) or `"sealed"`, with own random numbers |
    | `seal` | `None` | the secret text of the sealed test |
    | `control_rate` | `20.0` | actions per second [Hz] |
    | `vector_reward` | `False` | whether the reward is a vector (MO-Gymnasium) |

    ## Version History
    * v1: first release.
    """

    setup_class = Safe4S4Setup
    setup: Safe4S4Setup
    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 20}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, **options: Any):
        super().__init__(render_mode, **options)
        if self.setup.safe.vector_reward:
            self.reward_space = gymnasium.spaces.Box(-np.inf, 0.0, (3,), dtype=np.float64)

    def _info(self, output, start):
        reward, info = super()._info(output, start)
        vector = self.setup.safe.vector_reward
        return (self.setup.rewards(output.values)[0] if vector else reward), info

    @property
    def description(self) -> SafeDrive:
        """Description of the drive of this episode."""
        if self._start is None:
            raise gymnasium.error.ResetNeeded("call reset before reading the description")
        return self._start.description


class Safe4S4VectorEnv(RoadReconVectorEnv):
    """Batch of `Safe4S4Env`; keywords of both classes."""

    setup_class = Safe4S4Setup
