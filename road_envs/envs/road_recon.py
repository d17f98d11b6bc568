"""`RoadRecon-v0`: the vehicle on a road as a Gymnasium environment. No physics lives here."""

from collections import deque
from math import ceil
from typing import Any

import gymnasium
import numpy as np

from road_envs.config import ConfigError, validate_choice
from road_envs.envs.options import EnvSetup, EpisodeStart
from road_envs.simulation.control_step import OUTPUT_COLUMNS, StepOutput
from road_envs.simulation.drive import DriveSimulator

RENDERED_HISTORY = 4.0
"""How much of the accelerations a picture shows [s]."""


class RoadReconEnv(gymnasium.Env):
    """A stiff 7-DOF Land Rover on a road, whose 4S4 suspension the agent switches.

    ## Description
    A vehicle with solid axles drives over a road at constant speed. Its four struts can be soft
    with low damping (*ride*) or stiff with high damping (*handling*); a command takes effect after
    a delay of 20 ms and a lag of 10 ms. The agent sees what the car's own instruments see: three
    vertical body accelerations at the right front (RF), left rear (LR) and right rear (RR), the
    speed, and the commanded states. It never sees the road. The model is that of Ngwangwa, Heyns,
    Breytenbach & Els; see `road_envs.vehicle.equations` and `road_envs.vehicle.suspension`.

    ## Action Space
    `control="vehicle"`: `Discrete(2)`, 0 ride, 1 handling, for all struts.
    `control="axle"`: `Discrete(4)`, front + 2 * rear with 0 ride and 1 handling: 0 ride/ride,
    1 front handling, 2 rear handling, 3 handling/handling.
    `control="states"`: `Discrete(16)`, front + 4 * rear with 0 ride, 1 handling, 2 soft spring and
    high damping, 3 stiff spring and low damping.

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

    `observe` adds groups of other instruments, here without noise [assumed], at the end:

    | group | numbers | unit | low, high |
    |---|---|---|---|
    | `"planar"` | felt longitudinal and lateral acceleration, means | m/s² | ±20 |
    | `"struts"` | extensions of the struts FL, FR, RL, RR, at the end | m | ±0.5 |
    | | rates of extension, likewise | m/s | ±10 |

    What is felt on a leaning body is a_x - g theta and a_y + g phi.

    ## Rewards
    Minus the weighted sum of the costs, times the control interval in seconds, so that a return
    does not depend on the control rate:

    | term in `info` | quantity over the interval | unit | weight |
    |---|---|---|---|
    | `comfort` | RMS heave acceleration, W_k-weighted after ISO 2631-1 | m/s² | 1 |
    | `rattle` | RMS extension of the four struts | m | 10 |
    | `tyre_load` | RMS of tyre load over static load, less 1 | - | 1 |
    | `unresolved_variance` | share of the road's variance that the states leave unknown | - | 0 |

    The last one, whose weight is called `information`, is told where that weight is not 0. It is
    what the best linear estimate in the commanded states does not know of a class-D road in the
    judged band (`observability.BoundTable`), for a car that stays in them; one that keeps
    switching is charged as if it stayed.

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
    | `control` | `"vehicle"` | what an action switches: `"vehicle"`, `"axle"` or `"states"` |
    | `control_rate` | `20.0` | actions per second [Hz] |
    | `length` | `None` | another length of the road [m] |
    | `sensors` | `"paper"` | instruments by name or YAML path |
    | `vehicle` | `"land_rover_defender_110"` | vehicle by name or YAML path |
    | `step` | `0.001` | integrator step [s] |
    | `manoeuvre` | `None` | `"steady_turn"`, `"lane_change"`, `"slalom"`, `"braking"`, or mapping |
    | `truth` | `True` | whether `info` has `profile` and `loads`, for scoring |
    | `observe` | `["accelerations"]` | what is observed; `"planar"`, `"struts"` may follow |
    | `weights` | see above | mapping with `comfort`, `rattle`, `tyre_load`, `information` |
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
            validate_choice("render mode", render_mode, self.metadata["render_modes"])
        self.setup = EnvSetup(options)
        self.render_mode = render_mode
        rate = self.setup.options.control_rate
        self.metadata = self.metadata | {"render_fps": rate}
        self.observation_space = self.setup.observation_space
        self.action_space = self.setup.action_space
        self.fleet = self.setup.make_fleet()
        self._start: EpisodeStart | None = None
        self._command_byte = 0
        self._history: deque[np.ndarray] = deque(maxlen=ceil(RENDERED_HISTORY * rate))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start an episode; see the class for `options`. Raises ConfigError on unknown ones."""
        super().reset(seed=seed)
        episode_options = self.setup.episode_options(options or {})
        self._start = self.setup.start_episode(self.fleet, 0, self.np_random, episode_options)
        self._history.clear()
        output = self._advance(self._start.command_byte)
        return output.observation[0], self._info(output, self._start)[1]

    def step(self, action: int):
        """Drive one control interval under `action`."""
        if self._start is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        if not self.action_space.contains(action):
            last = len(self.setup.command_bytes) - 1
            raise ConfigError(f"the action must be one of 0 to {last}, got {action!r}")
        output = self._advance(int(self.setup.command_bytes[action]))
        reward, info = self._info(output, self._start)
        terminated = info["reason"] != ""
        truncated = not terminated and bool(output.end_of_road[0])
        return output.observation[0], reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """A picture (540, 960, 3), uint8, of the car on its road; None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn("nothing is rendered unless render_mode is 'rgb_array'")
            return None
        if not self._history:
            raise gymnasium.error.ResetNeeded("call reset before render")
        from road_envs.rendering import Scene, render_frame

        samples = np.concatenate(self._history, axis=1)
        fs, enlarged = self.setup.instruments.fs, self.setup.options.exaggeration
        shown = self.fleet.last_interval(0, self._command_byte)
        return render_frame(
            Scene.from_drive(self.drive, shown, samples, fs, RENDERED_HISTORY, enlarged)
        )

    @property
    def drive(self) -> DriveSimulator:
        """The drive of this episode, where it is now; a copy of what the environment holds."""
        if self._start is None:
            raise gymnasium.error.ResetNeeded("call reset before looking at the drive")
        self.fleet.write_back(0, self._start.drive)
        return self._start.drive

    def split(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        """The parts of an observation: RF, LR, RR (k,), speed (1,), front (2,), rear (2,); where
        they are observed planar (2,), extension (4,), extension_rate (4,).
        """
        return {name: observation[part] for name, part in self.setup.observation_slices.items()}

    def _advance(self, byte: int) -> StepOutput:
        output = self.fleet.advance(np.array([byte], dtype=np.uint8))
        self._command_byte = byte
        if self.render_mode is not None:
            k = self.setup.samples_per_interval
            self._history.append(output.observation[0, : 3 * k].reshape(3, k).copy())
        return output

    def _info(self, output: StepOutput, start: EpisodeStart) -> tuple[float, dict[str, Any]]:
        """The reward and what is told beside it."""
        info: dict[str, Any] = dict(zip(OUTPUT_COLUMNS, output.values[0].tolist(), strict=True))
        reward = info.pop("reward")
        if self.setup.options.weights.unresolved_variance == 0.0:
            del info["unresolved_variance"]
        info["reason"] = self.setup.failure_reason(output, 0, start.surface.name)
        if self.setup.options.truth:
            info |= {"s": output.s[0], "profile": output.profile[0], "loads": output.loads[0]}
        return reward, info
