"""Vector environment of `RoadRecon-v0`, which advances all vehicles in the lanes of one fleet."""

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from road_envs.core.config import ConfigError, shown, validate_choice
from road_envs.envs.fleet_arrays import StepOutput
from road_envs.envs.options import EnvOptions, EnvSetup, validate_actions

MAX_ENVS = 100_000  # most vehicles: with the shortest roads they need some gigabytes
KEPT = "_generators _seeds _roads failures _elapsed _done _observations fleet".split()
"""Attributes that change from step to step."""


class RoadReconVectorEnv(VectorEnv):
    """Batch of `num_envs` environments; number i equals a `RoadReconEnv` with seed + i exactly.

    ```python
    import gymnasium as gym
    import road_envs

    envs = gym.make_vec(
        "RoadRecon-v0", num_envs=64, vectorization_mode="vector_entry_point", road="iso_d"
    )
    ```

    | keyword | default | meaning |
    |---|---|---|
    | `num_envs` | `1` | number of environments |
    | `autoreset_mode` | `NEXT_STEP` | or `SAME_STEP`, `DISABLED`, of Gymnasium's AutoresetMode |
    | `threads` | `1` | number of threads; results do not depend on it |
    | `max_episode_steps` | `None` | steps after which an episode is truncated |
    | all others | | as in `RoadReconEnv` |

    `reset(seed=..., options=...)` takes one seed or a seed for each environment, and the options
    of `RoadReconEnv.reset`; with `DISABLED` also `reset_mask` (num_envs,) bool, the environments to
    reset. `info` has the keys of the scalar environment, with a row for each environment, and for
    each key a mask `_key` (num_envs,) of the valid rows; `failures` says why episodes ended.
    `SAME_STEP` adds `final_obs` and `final_info` of the ended episodes. It does not render.
    """

    setup_class: type[EnvSetup] = EnvSetup
    metadata: dict[str, Any] = {  # noqa: RUF012 - as the base class has it; each instance copies it
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 1,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ):
        if render_mode is not None:
            raise ConfigError(
                f"a vector environment has no render_mode {render_mode!r}; render with "
                f"gym.make('RoadRecon-v0', render_mode='rgb_array')"
            )
        steps = 1 if max_episode_steps is None else max_episode_steps
        counts = {"num_envs": num_envs, "threads": threads, "max_episode_steps": steps}
        for name, value in counts.items():
            if isinstance(value, bool) or not (isinstance(value, int) and value >= 1):
                raise ConfigError(f"{name} must be a whole number of at least 1, got {value!r}")
            if value > MAX_ENVS and name != "max_episode_steps":
                raise ConfigError(f"{name} must be at most {MAX_ENVS}, got {value}")
        if not isinstance(autoreset_mode, AutoresetMode):
            known = {mode.value: mode for mode in AutoresetMode}
            autoreset_mode = known[validate_choice("autoreset mode", autoreset_mode, known)]
        self.setup, self.autoreset_mode = self.setup_class(options), autoreset_mode
        self.num_envs, self.max_episode_steps = num_envs, max_episode_steps
        self.metadata = self.metadata | {"autoreset_mode": autoreset_mode}
        self.render_mode = None
        self.single_observation_space = self.setup.observation_space
        self.single_action_space = self.setup.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.fleet = self.setup.make_fleet(num_envs, threads=threads)
        self._generators: list[np.random.Generator] = []
        self._seeds: list[int] = []
        self._roads, self.failures = [""] * num_envs, [""] * num_envs
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._done = np.zeros(num_envs, dtype=bool)
        self._observations = np.zeros((num_envs, 0))

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        return tuple(self._generators)

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # type: ignore[override]
        return tuple(self._seeds)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start episodes in all environments, or in those of `reset_mask`. Raises ConfigError."""
        options = dict(options or {})
        mask = self._validate_mask(options.pop("reset_mask", None))
        episode_options = self.setup.episode_options(options)
        self._seed_generators(seed, mask)
        output = self._start_and_advance(mask, episode_options)
        self._done[mask] = False
        observations = output.observation
        if not mask.all():
            observations = np.where(mask[:, None], observations, self._observations)
        self._keep(observations)
        return observations, self._infos(output, mask)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Drive all environments for one control interval under `actions` (num_envs,)."""
        if not self._generators:
            raise gymnasium.error.ResetNeeded("call reset before step")
        known = self.setup.command_bytes
        commands = known[validate_actions(actions, self.num_envs, len(known))]
        if any(self.failures):
            self.failures = [""] * self.num_envs
        restarted = self._done
        if restarted.any():
            if self.autoreset_mode == AutoresetMode.DISABLED:
                raise gymnasium.error.ResetNeeded(
                    f"environments {np.flatnonzero(self._done).tolist()} have ended: reset them "
                    f"with options={{'reset_mask': ...}} before the next step"
                )
            # NEXT_STEP: this step is their reset, whatever the action
            commands[restarted] = self._start_episodes(restarted, self.setup.options)[restarted]
        output = self.fleet.advance(commands)
        self._elapsed += ~restarted
        infos = self._infos(output, np.ones(self.num_envs, dtype=bool))
        terminated = output.failed & ~restarted
        truncated = output.end_of_road & ~terminated & ~restarted
        if self.max_episode_steps is not None:
            truncated |= (self._elapsed >= self.max_episode_steps) & ~restarted
        rewards = self.setup.rewards(output.values).copy()
        rewards[restarted] = 0.0
        self._done = terminated | truncated
        observations = output.observation
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._done.any():
            observations, infos = self._autoreset(self._done, output, infos)
            self._done = np.zeros(self.num_envs, dtype=bool)
        self._keep(observations)
        return observations, rewards, terminated, truncated, infos

    def state(self) -> dict[str, Any]:
        """Return a copy of all that changes, for `set_state`."""
        return copy.deepcopy({name: getattr(self, name) for name in KEPT})

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a `state` of an environment with the same options. Raises ConfigError."""
        if not (isinstance(state, dict) and set(state) == set(KEPT)):
            raise ConfigError(f"the state must be one that state() returned, got {shown(state)}")
        if (n := state["fleet"].n_vehicles) != self.num_envs:
            raise ConfigError(f"the state is of {n} environments; there are {self.num_envs}")
        for name, value in copy.deepcopy(state).items():
            setattr(self, name, value)

    def _keep(self, observations: np.ndarray) -> None:
        if self.autoreset_mode == AutoresetMode.DISABLED:
            self._observations = observations.copy()

    def _autoreset(
        self, ended: np.ndarray, output: StepOutput, infos: dict[str, Any]
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes where one has `ended`; return their observations, and all infos."""
        final_obs = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended):
            final_obs[i] = output.observation[i].copy()
        final_info = self._infos(output, ended)
        started = self._start_and_advance(ended, self.setup.options)
        for name, rows in self._infos(started, ended).items():
            infos[name] = infos[name].copy()
            infos[name][ended] = rows[ended]
        observations = np.where(ended[:, None], started.observation, output.observation)
        final = {"final_obs": final_obs, "final_info": final_info}
        return observations, infos | final | {f"_{name}": ended.copy() for name in final}

    def _start_and_advance(self, mask: np.ndarray, episode_options: EnvOptions) -> StepOutput:
        commands = self._start_episodes(mask, episode_options)
        return self.fleet.advance(commands, None if mask.all() else mask)

    def _start_episodes(self, mask: np.ndarray, episode_options: EnvOptions) -> np.ndarray:
        """Start episodes in `mask`, and return their command bytes (num_envs,)."""
        commands = np.zeros(self.num_envs, dtype=np.uint8)
        for i in np.flatnonzero(mask):
            start = self.setup.prepare(self._generators[i], episode_options)
            self.fleet.start(int(i), start.drive, start.logger, start.speed_kmh)
            commands[i], self._roads[i] = start.command_byte, start.drive.surface.name
        self._elapsed[mask] = 0
        return commands

    def _infos(self, output: StepOutput, mask: np.ndarray) -> dict[str, Any]:
        """Return the infos of the environments in `mask`; other rows are zero."""
        values = output.values if mask.all() else np.where(mask[:, None], output.values, 0.0)
        infos: dict[str, Any] = {name: values[:, j] for name, j in self.setup.info_columns.items()}
        codes = infos["reason"] = np.zeros(self.num_envs, dtype=np.int64)
        for i in np.flatnonzero(mask & output.failed).tolist():
            codes[i], self.failures[i] = self.setup.failure(output, i, self._roads[i])
        if self.setup.options.truth:
            for name, array in output.truths.items():
                inside = mask.reshape(-1, *[1] * (array.ndim - 1))
                infos[name] = array if mask.all() else np.where(inside, array, 0.0)
        return infos | dict.fromkeys([f"_{name}" for name in infos], mask.copy())

    def _validate_mask(self, mask: Any) -> np.ndarray:
        """Return `mask` as (num_envs,) bool; None stands for all. Raises ConfigError."""
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        fits = isinstance(mask, np.ndarray) and mask.dtype == bool
        if not fits or mask.shape != (self.num_envs,) or not mask.any():
            raise ConfigError(
                f"reset_mask must be an array of {self.num_envs} bools with at least one true, "
                f"got {mask!r}"
            )
        if self.autoreset_mode != AutoresetMode.DISABLED:
            raise ConfigError(
                "reset_mask is for autoreset_mode 'Disabled'; in the mode "
                f"{self.autoreset_mode.value!r} environments that have ended restart by themselves"
            )
        if not self._generators and not mask.all():
            raise gymnasium.error.ResetNeeded("the first reset must be of all environments")
        return mask

    def _seed_generators(self, seed: int | Sequence[int | None] | None, mask: np.ndarray) -> None:
        """Seed the environments in `mask`; without a seed an existing generator is kept."""
        if isinstance(seed, int | np.integer):
            seeds: list[int | None] = [int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = [None] * self.num_envs if seed is None else list(seed)
        if len(seeds) != (n := self.num_envs):
            raise ConfigError(f"seed must be one number or {n} numbers, got {len(seeds)}")
        if not self._generators:
            drawn = [seeding.np_random(s) for s in seeds]
            self._generators, self._seeds = [r for r, _ in drawn], [s for _, s in drawn]
            return
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self._generators[i], self._seeds[i] = seeding.np_random(seeds[i])
