"""`RoadRecon-v0`: the vehicle on a road as a Gymnasium environment. No physics lives here."""

from collections import deque
from dataclasses import asdict, dataclass, field
from math import ceil
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np

from road_envs.comfort import wk_sos
from road_envs.config import STRICT, ConfigError, build, one_of
from road_envs.dynamics import DOF, Z_B, plant
from road_envs.manoeuvres import load_manoeuvre
from road_envs.processing import run_sections
from road_envs.record import SENSORS
from road_envs.roads import load_road, with_length
from road_envs.sensors import Logger, load_instruments
from road_envs.simulate import Drive, SimulationError, Trajectory
from road_envs.suspension import command, strut_states
from road_envs.vehicle import load_vehicle

ACTIONS: dict[str, tuple[Any, ...]] = {
    "vehicle": ("ride", "handling"),
    "axle": tuple(
        {"front": front, "rear": rear}
        for rear in ("ride", "handling")
        for front in ("ride", "handling")
    ),
}
"""What the actions 0, 1, ... command, for each choice of `control`."""

ANGLES = [DOF.index(name) for name in ("phi", "theta", "phi_af", "phi_ar")]
LARGEST_ANGLE = np.radians(45.0)

TOP_SPEED = 200.0
"""Highest speed that is accepted [km/h]."""

RECENT = 4.0
"""How much of the accelerations a picture shows [s]."""


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Weights of the reward's three costs, each per second."""

    __pydantic_config__ = STRICT

    comfort: Annotated[float, "per m/s²", "of the W_k-weighted RMS heave acceleration"] = 1.0
    rattle: Annotated[float, "per m", "of the RMS strut extension"] = 10.0
    tyre_load: Annotated[float, "", "of the RMS relative tyre load variation"] = 1.0


@dataclass(frozen=True, kw_only=True)
class Options:
    """The keyword arguments of the environment; see `RoadReconEnv`."""

    __pydantic_config__ = STRICT

    road: str | dict[str, Any] = "belgian"
    speed_kmh: float | tuple[float, float] = 14.5
    mode: str | dict[str, str] = "ride"
    control: Literal["vehicle", "axle"] = "vehicle"
    control_rate: float = 20.0
    length: float | None = None
    sensors: str = "paper"
    vehicle: str = "land_rover_defender_110"
    step: float = 0.001
    manoeuvre: str | dict[str, Any] | None = None
    truth: bool = True
    weights: Weights = field(default_factory=Weights)
    exaggeration: float = 1.0

    def __post_init__(self):
        check_speed(self.speed_kmh)
        command(self.mode)
        if self.manoeuvre is not None:
            load_manoeuvre(self.manoeuvre)
        if not self.exaggeration > 0:
            raise ValueError(f"exaggeration must be above 0, got {self.exaggeration}")
        per_interval = 1.0 / (self.control_rate * self.step) if self.control_rate > 0 else 0.0
        if per_interval < 1.0 or abs(per_interval - round(per_interval)) > 1e-6:
            raise ValueError(
                f"control_rate must make a whole number of integrator steps of {self.step} s, "
                f"got {self.control_rate} Hz"
            )


def check_speed(speed_kmh: float | tuple[float, float]) -> None:
    """Raise ValueError unless `speed_kmh` is a speed or a range of speeds that can be driven."""
    speeds = np.atleast_1d(np.asarray(speed_kmh, dtype=float))
    if not ((speeds > 0) & (speeds <= TOP_SPEED)).all() or speeds[0] > speeds[-1]:
        raise ValueError(
            f"speed_kmh must be a number or a range [low, high] within 0 to {TOP_SPEED:g} km/h "
            f"and above 0, got {speed_kmh}"
        )


class RoadReconEnv(gymnasium.Env):
    """A stiff 7-DOF Land Rover on a road, whose 4S4 suspension the agent switches.

    ## Description
    A vehicle with solid axles drives over a road at constant speed. Its four struts can be soft
    with low damping (*ride*) or stiff with high damping (*handling*); a command takes effect after
    a delay of 20 ms and a lag of 10 ms. The agent sees what the car's own instruments see: three
    vertical body accelerations at the right front (RF), left rear (LR) and right rear (RR), the
    speed, and the commanded states. It never sees the road. The model is that of Ngwangwa, Heyns,
    Breytenbach & Els; see `road_envs.dynamics` and `road_envs.suspension`.

    ## Action Space
    `control="vehicle"`: `Discrete(2)`, 0 ride, 1 handling, for all struts.
    `control="axle"`: `Discrete(4)`, front + 2 * rear with 0 ride and 1 handling: 0 ride/ride,
    1 front handling, 2 rear handling, 3 handling/handling.

    ## Observation Space
    `Box`, float32, (3 k + 5,), where k is the number of samples in a control interval (50 at 1 kHz
    and 20 Hz). `unwrapped.split(observation)` names the parts.

    | index | quantity | unit | low | high |
    |---|---|---|---|---|
    | 0 ... k-1 | RF acceleration, oldest first | m/s² | -range | range |
    | k ... 2k-1 | LR acceleration | m/s² | -range | range |
    | 2k ... 3k-1 | RR acceleration | m/s² | -range | range |
    | 3k | speed as measured | m/s | 0 | 100 |
    | 3k+1, 3k+2 | front: stiff spring, high damping (commanded) | - | 0 | 1 |
    | 3k+3, 3k+4 | rear: stiff spring, high damping (commanded) | - | 0 | 1 |

    ## Rewards
    Minus the weighted sum of three costs, times the control interval in seconds, so that a return
    does not depend on the control rate:

    | term in `info` | quantity over the interval | unit | weight |
    |---|---|---|---|
    | `comfort` | RMS heave acceleration, W_k-weighted after ISO 2631-1 | m/s² | 1 |
    | `rattle` | RMS extension of the four struts | m | 10 |
    | `tyre_load` | RMS of tyre load over static load, less 1 | - | 1 |

    ## Starting State
    At rest on a level apron, front axle 5 m before the road, in the mode `mode`; one control
    interval has been driven, so that the first observation holds samples. Each reset draws a road
    (unless it is a fixed one), a speed (if a range is given) and the sensors' noise, each from a
    stream of its own.

    ## Episode End
    Truncated when the rear axle has left the road and the apron after it. Terminated when body or
    axle has rolled or pitched by more than 45 degrees, where the model's small angles end, or when
    the motion leaves the range of numbers; `info["reason"]` then says which.

    ## Arguments
    ```python
    import gymnasium as gym
    import road_envs

    env = gym.make("RoadRecon-v0", road="iso_d", speed_kmh=[14.5, 54.0], control="axle")
    ```
    | keyword | default | meaning |
    |---|---|---|
    | `road` | `"belgian"` | shipped name, path of a YAML or surface file, or mapping with `kind` |
    | `speed_kmh` | `14.5` | speed [km/h], or `[low, high]` from which each episode draws |
    | `mode` | `"ride"` | 4S4 mode at the start; also `{"front": ..., "rear": ...}` |
    | `control` | `"vehicle"` | what an action switches: `"vehicle"` or `"axle"` |
    | `control_rate` | `20.0` | actions per second [Hz] |
    | `length` | `None` | another length of the road [m] |
    | `sensors` | `"paper"` | instruments by name or YAML path |
    | `vehicle` | `"land_rover_defender_110"` | vehicle by name or YAML path |
    | `step` | `0.001` | integrator step [s] |
    | `manoeuvre` | `None` | `"steady_turn"`, `"lane_change"`, `"slalom"`, `"braking"`, or mapping |
    | `truth` | `True` | whether `info` has `profile` and `loads`, for scoring |
    | `weights` | see above | mapping with `comfort`, `rattle`, `tyre_load` |
    | `exaggeration` | `1.0` | factor by which pictures enlarge vertical motion |

    `reset(options={"speed_kmh": ..., "mode": ...})` overrides these two for one episode.
    `info` has, at reset as at each step: `t` [s], `station` [m] of the front axle, `speed_kmh`,
    `comfort`, `rattle`, `tyre_load` (the reward's terms), `reason`, and with `truth`: `s` (k,) [m],
    `profile` (2, k) [m] under the front axle and `loads` (4, k) [N] of the tyres at the samples.

    ## Vectorized environment
    `gym.make_vec("RoadRecon-v0", num_envs=4, vectorization_mode="sync")`; in spawned workers use
    `"road_envs:RoadRecon-v0"`, which imports the package first.

    ## Version History
    * v0: first release.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as the base class has it; each instance copies it
        "render_modes": ["rgb_array"],
        "render_fps": 20,
    }

    def __init__(self, render_mode: str | None = None, **options: Any):
        if render_mode is not None:
            one_of("render mode", render_mode, self.metadata["render_modes"])
        if isinstance(options.get("weights"), Weights):
            options["weights"] = asdict(options["weights"])
        self.options = o = build(Options, options, "RoadRecon-v0")
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": o.control_rate}
        self._recent: deque[np.ndarray] = deque(maxlen=ceil(RECENT * o.control_rate))
        self.car = load_vehicle(o.vehicle)
        self.manoeuvre = None if o.manoeuvre is None else load_manoeuvre(o.manoeuvre)
        self.plant = plant(self.car, manoeuvres=self.manoeuvre is not None)
        self.instruments = load_instruments(o.sensors)
        road = load_road(o.road)
        self.road = road if o.length is None else with_length(road, o.length)
        self.interval = 1.0 / o.control_rate
        self._steps = round(self.interval / o.step)
        self._bytes = [command(action) for action in ACTIONS[o.control]]
        self._samples = round(self.instruments.fs * self.interval)
        if self._samples < 1 or abs(self._samples - self.instruments.fs * self.interval) > 1e-6:
            raise ConfigError(
                f"control_rate must make a whole number of samples at {self.instruments.fs} Hz, "
                f"got {o.control_rate} Hz"
            )
        self._wk = wk_sos(1.0 / o.step)
        self._static_load = np.repeat(self.car.tyre_loads, 2)
        reach = np.full(3 * self._samples, self.instruments.range)
        self._low = np.r_[-reach, np.zeros(5)].astype(np.float32)
        self._high = np.r_[reach, 100.0, np.ones(4)].astype(np.float32)
        self.observation_space = gymnasium.spaces.Box(self._low, self._high, dtype=np.float32)
        self.action_space = gymnasium.spaces.Discrete(len(self._bytes))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode; see the class for `options`. Raises ConfigError on unknown ones."""
        super().reset(seed=seed)
        # one stream per cause: new ones go to the end, so that old seeds keep their roads
        road_rng, speed_rng, sensor_rng = self.np_random.spawn(3)
        speed_kmh, mode = self._episode(options or {})
        if not isinstance(speed_kmh, float):
            speed_kmh = float(speed_rng.uniform(*speed_kmh))
        self.speed_kmh = speed_kmh
        surface = self.road.realise(road_rng)
        step = self.options.step
        speed = speed_kmh / 3.6
        self.drive = Drive(self.plant, self.car, surface, speed, mode, step, self.manoeuvre)
        self.logger = Logger(self.instruments, self.car, step, sensor_rng)
        self._wk_memory = np.zeros((self._wk.shape[0], 1, 2))
        self._recent.clear()
        observation, _, _, info = self._advance(command(mode))
        return observation, info

    def step(self, action: int):
        """Drive one control interval under `action`."""
        if not self.action_space.contains(action):
            raise ConfigError(
                f"the action must be one of 0 to {len(self._bytes) - 1}, got {action!r}"
            )
        observation, reward, terminated, info = self._advance(self._bytes[int(action)])
        return observation, reward, terminated, self.drive.over and not terminated, info

    def render(self) -> np.ndarray | None:
        """A picture (540, 960, 3), uint8, of the car on its road; None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("nothing is rendered unless render_mode is 'rgb_array'")
            return None
        if not self._recent:
            raise gymnasium.error.ResetNeeded("call reset before render")
        from road_envs.rendering import Scene, frame  # needs Pillow; few environments are looked at

        samples = np.concatenate(self._recent, axis=1)
        fs, enlarged = self.instruments.fs, self.options.exaggeration
        return frame(Scene.of(self.drive, self._shown, samples, fs, RECENT, enlarged))

    def split(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        """The parts of an observation: RF, LR, RR (k,), speed (1,), front (2,), rear (2,)."""
        k = self._samples
        cuts = np.cumsum([k, k, k, 1, 2])
        return dict(
            zip((*SENSORS, "speed", "front", "rear"), np.split(observation, cuts), strict=True)
        )

    def _episode(self, options: dict[str, Any]):
        known = {"speed_kmh": self.options.speed_kmh, "mode": self.options.mode}
        if extra := options.keys() - known.keys():
            raise ConfigError(f"unknown reset options {sorted(extra)}; known: {', '.join(known)}")
        chosen = build(Options, known | options, "reset options")
        return chosen.speed_kmh, chosen.mode

    def _advance(self, byte: int):
        commands = np.full(self._steps, byte, dtype=np.uint8)
        reason = ""
        try:
            trajectory = self.drive.advance(commands)
            reason = _overturned(trajectory)
        except SimulationError as error:
            reason, trajectory = str(error), _still(commands, self.drive.step)
        terms = self._terms(trajectory)
        weights = asdict(self.options.weights)
        reward = -self.interval * sum(weights[name] * terms[name] for name in terms)
        info: dict[str, Any] = {
            "t": self.drive.t,
            "station": self.drive.station,
            "speed_kmh": self.speed_kmh,
            **terms,
            "reason": reason,
        }
        if self.options.truth:
            at = slice(-self._samples * self.logger.every, None, self.logger.every)
            info["s"] = trajectory.s[at].copy()
            info["profile"] = self.drive.surface.height(info["s"])
            info["loads"] = trajectory.tyre_load[at].T.copy()
        return self._observe(trajectory, byte), float(reward), bool(reason), info

    def _terms(self, trajectory: Trajectory) -> dict[str, float]:
        heave = trajectory.acceleration[:, Z_B]
        weighted = np.empty((1, heave.size))
        run_sections(self._wk, self._wk_memory, heave[None], weighted)
        variation = trajectory.tyre_load / self._static_load - 1.0
        return {
            "comfort": float(np.sqrt(np.mean(weighted**2))),
            "rattle": float(np.sqrt(np.mean(trajectory.extension**2))),
            "tyre_load": float(np.sqrt(np.mean(variation**2))),
        }

    def _observe(self, trajectory: Trajectory, byte: int) -> np.ndarray:
        samples = self.logger.sense(trajectory)
        if self.render_mode is not None:
            self._shown = trajectory
            self._recent.append(samples)
        stiff, high = strut_states(np.array([byte]))
        speed = self.logger.speed_gain * self.drive.speed
        states = [stiff[0, 0], high[0, 0], stiff[0, 2], high[0, 2]]
        observation = np.concatenate([samples.ravel(), [speed], states]).astype(np.float32)
        return np.clip(observation, self._low, self._high)


def _overturned(trajectory: Trajectory) -> str:
    """What turned too far for the model, and when; empty if nothing did."""
    angles = np.abs(trajectory.state[:, ANGLES])
    if angles.max() <= LARGEST_ANGLE:
        return ""
    row, column = np.unravel_index(np.argmax(angles > LARGEST_ANGLE), angles.shape)
    name, degrees = DOF[ANGLES[column]], np.degrees(LARGEST_ANGLE)
    return f"{name} passed {degrees:.0f} degrees at t = {trajectory.t[row]:.3f} s"


def _still(commands: np.ndarray, step: float) -> Trajectory:
    """What is reported of an interval in which the motion broke down: nothing moved."""
    from road_envs.integrator import SIGNALS

    t = step * np.arange(commands.size)
    return Trajectory(t, 0.0 * t, 0.0 * t, commands, np.zeros((t.size, SIGNALS)))
