"""Gymnasium environment `RoadRecon-v0`: the vehicle on a road."""

from collections import deque
from math import ceil
from typing import Any

import gymnasium
import numpy as np

from road_envs.core.config import ConfigError, validate_choice
from road_envs.envs.failures import END_OF_ROAD
from road_envs.envs.fleet_arrays import StepOutput
from road_envs.envs.options import EnvSetup, EpisodeStart
from road_envs.simulation.drive import DriveSimulator

RENDERED_HISTORY = 4.0  # length of the acceleration traces in a rendered frame [s]


class RoadReconEnv(gymnasium.Env):
    """Environment of a 7-DOF Land Rover on a road, whose 4S4 suspension the agent switches.

    ## Description
    A vehicle with solid axles drives over a road at constant speed. Its four struts can be soft
    with low damping (*ride*) or stiff with high damping (*handling*); a command takes effect after
    a delay of 20 ms and a lag of 10 ms. The agent observes the vehicle's own instruments: vertical
    accelerations, of the body at the right front (RF), left rear (LR) and right rear (RR) unless
    other `sensors` are chosen, the speed, and the commanded states, but not the road. The model
    (`road_envs.vehicle.equations`, `suspension`) is that of Ngwangwa, Heyns, Breytenbach & Els.

    ## Action Space
    `control="vehicle"`: `Discrete(2)`, 0 ride, 1 handling, for all struts.
    `control="axle"`: `Discrete(4)`, front + 2 * rear with 0 ride and 1 handling.
    `control="states"`: `Discrete(16)`, front + 4 * rear with 0 ride, 1 handling, 2 soft spring and
    high damping, 3 stiff spring and low damping.
    A `vehicle` with passive struts has nothing to switch: `Discrete(1)`, and no other `control`.

    ## Observation Space
    `Box`, float32, (3 k + 5,), where k is the number of samples in a control interval (50 at 1 kHz
    and 20 Hz). `unwrapped.split(observation)` returns the parts by name. Other `sensors` have one
    row of k for each accelerometer, in their order.

    | index | quantity | unit | low | high |
    |---|---|---|---|---|
    | 0 ... 3k-1 | RF, LR and RR acceleration, k each, oldest first | m/s² | -range | range |
    | 3k | measured speed | m/s | 0 | 100 |
    | 3k+1 ... 3k+4 | stiff spring, high damping (commanded), front, then rear | - | 0 | 1 |

    `observe` appends groups of further instruments, which have no noise [assumed]:

    | group | numbers | unit | low, high |
    |---|---|---|---|
    | `"planar"` | longitudinal and lateral specific force, means over the interval | m/s² | ±20 |
    | `"struts"` | extensions of the struts FL, FR, RL, RR, at the end of it | m | ±0.5 |
    | | their rates of extension, likewise | m/s | ±10 |

    The specific force in the axes of the body is a_x - g theta and a_y + g phi.

    ## Rewards
    Minus the weighted sum of the costs, times the control interval in seconds, so that a return
    does not depend on the control rate:

    | term in `info` | quantity over the interval | unit | weight |
    |---|---|---|---|
    | `comfort` | RMS heave acceleration, W_k-weighted after ISO 2631-1 | m/s² | 1 |
    | `rattle` | RMS extension of the four struts | m | 10 |
    | `tyre_load` | RMS of tyre load over static load, less 1 | - | 1 |
    | `unresolved_variance` | share of the road's variance that stays unresolved | - | 0 |

    The last one, in `info` only where its weight is not 0, is the error variance of the best linear
    estimate of a class-D road within the scored band (`information_bound.BoundTable`) by a vehicle
    that stays in the commanded states; one that keeps switching is charged the same.

    ## Starting State
    The vehicle starts in equilibrium on a level apron, front axle 5 m before the road, in `mode`.
    Reset drives one control interval, so that the first observation holds samples. It draws a road
    (unless fixed), a speed (if a range is given) and the sensor noise, each from its own random
    stream. A random road with a step that no wheel climbs, more than 0.2 m within 0.05 m as on some
    of class H, is drawn again; a fixed one raises ConfigError.

    ## Episode End
    Truncated when the rear axle has left the road and the apron after it. Terminated when the body
    or an axle has rolled or pitched by more than 45 degrees, beyond the model's small angles, or
    the motion is no longer finite: `info["reason"]` is then 1 or 2, else 0, and the attribute
    `failure` says it in words.

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
    | `mode` | `None` | mode at the start, by default ride, or passive; also by `front`, `rear` |
    | `control` | `"vehicle"` | what an action switches: `"vehicle"`, `"axle"` or `"states"` |
    | `control_rate` | `20.0` | actions per second [Hz] |
    | `length` | `None` | length of the road [m]; `None`: its own |
    | `sensors` | `"paper"` | instruments by name or YAML path |
    | `vehicle` | `"land_rover_defender_110"` | vehicle by name or YAML path |
    | `step` | `0.001` | integrator step [s] |
    | `manoeuvre` | `None` | `"steady_turn"`, `"lane_change"`, `"slalom"`, `"braking"`, or mapping |
    | `truth` | `True` | whether `info` has `s`, `profile` and `loads`, for scoring |
    | `observe` | `["accelerations"]` | observed groups; `"planar"`, `"struts"` may be added |
    | `weights` | see above | mapping of the cost names above to their weights |
    | `exaggeration` | `1.0` | factor by which rendered frames enlarge vertical motion |

    `reset(options={"speed_kmh": ..., "mode": ...})` overrides these two for one episode.
    At reset and at each step `info` holds `t` [s], `station` [m] of the front axle, `speed_kmh`,
    `comfort`, `rattle`, `tyre_load` (the terms of the reward), `reason`, and with `truth`: `s` (k,)
    [m], `profile` (2, k) [m] under the front axle and `loads` (4, k) [N] of the tyres at the
    samples.

    ## Vectorized environment
    `gym.make_vec("RoadRecon-v0", num_envs=4, vectorization_mode="sync")`; in spawned workers use
    `"road_envs:RoadRecon-v0"`, which imports the package first.

    ## Version History
    * v0: first release. Since package 0.2.0 steps over steep edges are divided and the end of the
      stiff gas spring is softer, so that episodes over obstacles differ from those of 0.1.0.
    """

    setup_class: type[EnvSetup] = EnvSetup
    metadata: dict[str, Any] = {  # noqa: RUF012 - as the base class has it; each instance copies it
        "render_modes": ["rgb_array"],
        "render_fps": 20,
    }

    def __init__(self, render_mode: str | None = None, **options: Any):
        if render_mode is not None:
            validate_choice("render mode", render_mode, self.metadata["render_modes"])
        self.setup = self.setup_class(options)
        self.render_mode = render_mode
        rate = self.setup.options.control_rate
        self.metadata = self.metadata | {"render_fps": rate}
        self.observation_space = self.setup.observation_space
        self.action_space = self.setup.action_space
        self.fleet = self.setup.make_fleet(keep_signals=render_mode is not None)
        self._start: EpisodeStart | None = None
        self.failure = ""  # why the episode was terminated, in words; empty if it was not
        self._command_byte = 0
        self._reward_column = self.setup.output_columns.index("reward")
        self._history: deque[np.ndarray] = deque(maxlen=ceil(RENDERED_HISTORY * rate))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode; the class documents `options`. Raises ConfigError on unknown ones."""
        super().reset(seed=seed)
        episode_options = self.setup.episode_options(options or {})
        self._start = start = self.setup.prepare(self.np_random, episode_options)
        self.fleet.start(0, start.drive, start.logger, start.speed_kmh)
        self._history.clear()
        output = self._advance(start.command_byte)
        return output.observation[0], self._info(output, start)[1]

    def step(self, action: int):
        """Drive one control interval under `action`."""
        if self._start is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        n = len(self.setup.command_bytes)  # the common kind first: `contains` takes a while
        if isinstance(action, bool) or not (
            0 <= action < n if type(action) is int else self.action_space.contains(action)
        ):
            raise ConfigError(f"the action must be one of 0 to {n - 1}, got {action!r}")
        output = self._advance(int(self.setup.command_bytes[action]))
        reward, info = self._info(output, self._start)
        terminated = info["reason"] != 0
        truncated = not terminated and bool(output.events[0, END_OF_ROAD])
        return output.observation[0], reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Return a frame (540, 960, 3), uint8, of the vehicle; None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("nothing is rendered unless render_mode is 'rgb_array'")
            return None
        if not self._history:
            raise gymnasium.error.ResetNeeded("call reset before render")
        from road_envs.rendering import Scene, render_frame

        scene = Scene.from_drive(
            self.drive,
            self.fleet.last_interval(0, self._command_byte),
            samples=np.concatenate(self._history, axis=1),
            fs=self.setup.instruments.fs,
            window=RENDERED_HISTORY,
            exaggeration=self.setup.options.exaggeration,
            sensors=tuple(self.setup.instruments.accelerometers),
        )
        return render_frame(scene)

    @property
    def drive(self) -> DriveSimulator:
        """Copy of the drive of this episode in its current state."""
        if self._start is None:
            raise gymnasium.error.ResetNeeded("call reset before reading the drive")
        self.fleet.write_back(0, self._start.drive)
        return self._start.drive

    def split(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parts of an observation by name: RF, LR, RR (k,), speed (1,), front (2,), rear
        (2,) and, where they are observed, planar (2,), extension (4,), extension_rate (4,).
        """
        return {name: observation[part] for name, part in self.setup.observation_slices.items()}

    def _advance(self, byte: int) -> StepOutput:
        output = self.fleet.advance(byte)
        self._command_byte = byte
        if self.render_mode is not None:
            k, S = self.setup.samples_per_interval, len(self.setup.instruments.accelerometers)
            self._history.append(output.observation[0, : S * k].reshape(S, k).copy())
        return output

    def _info(self, output: StepOutput, start: EpisodeStart) -> tuple[float, dict[str, Any]]:
        row = output.values[0].tolist()
        info: dict[str, Any] = {name: row[j] for name, j in self.setup.info_columns.items()}
        road = start.drive.surface.name
        info["reason"], self.failure = self.setup.failure(output, 0, road)
        if self.setup.options.truth:
            info |= {name: rows[0] for name, rows in output.truths.items()}
        return row[self._reward_column], info
