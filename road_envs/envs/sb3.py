"""Adapter of `RoadReconVectorEnv` to the vector environments of Stable-Baselines3."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import
from road_envs.envs.vector import RoadReconVectorEnv

with optional_import("Stable-Baselines3 environments"):
    from stable_baselines3.common.vec_env import VecEnv


class RoadReconVecEnv(VecEnv):
    """Stable-Baselines3 VecEnv of `num_envs` environments; `options` as in RoadReconVectorEnv.

    An environment that has ended restarts within the same step; its last observation is
    `info["terminal_observation"]`, and `info["TimeLimit.truncated"]` is true if only the road
    ended. `info_keys` are the entries of `info` in every step; none by default, because their
    dictionaries dominate the cost of a step. `vector_class` may be `Safe4S4VectorEnv`; `cost_price`
    is then subtracted from the reward per second of `info["cost"]`. Raises ConfigError.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        info_keys: Sequence[str] = (),
        vector_class: type[RoadReconVectorEnv] = RoadReconVectorEnv,
        cost_price: float = 0.0,
        **options: Any,
    ):
        if "autoreset_mode" in options:
            raise ConfigError("autoreset_mode must be omitted: Stable-Baselines3 resets in step")
        self.env = vector_class(num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **options)
        self.cost_price = cost_price
        self.info_keys = tuple(info_keys)
        self._actions = np.zeros(num_envs, dtype=np.int64)
        super().__init__(num_envs, self.env.single_observation_space, self.env.single_action_space)

    def seed(self, seed: int | None = None, alike: int = 1) -> Sequence[int | None]:
        """Set the seeds of the next reset, the same for `alike` environments in a row."""
        seeds = super().seed(seed)
        self._seeds = [seeds[i // alike] for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> np.ndarray:
        """Return the first observations (num_envs, 3 k + 5), with the seeds set by `seed`."""
        seeds = None if self._seeds[0] is None else list(self._seeds)
        options = self._options[0] if any(self._options) else None
        observations, infos = self.env.reset(seed=seeds, options=options)
        self.reset_infos = self._rows(infos)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = np.asarray(actions)

    def step_wait(self):
        """Return observations, rewards, dones (num_envs, ...) and a list of infos."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        dones = terminated | truncated
        rows = self._rows(infos)
        if self.cost_price and infos:
            cost = infos["cost"].copy()
            if dones.any():  # else `infos` are those of the next episode
                cost[dones] = infos["final_info"]["cost"][dones]
            rewards = rewards - self.cost_price * cost
        for i in np.flatnonzero(dones):
            final = infos["final_info"]
            rows[i] |= {name: final[name][i] for name in self.info_keys}
            rows[i]["terminal_observation"] = infos["final_obs"][i]
            rows[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            if final["reason"][i]:
                rows[i]["reason"] = self.env.failures[i]
        return observations, rewards.astype(np.float32), dones, rows

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute once for each environment; all environments share it."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise ConfigError(f"{attr_name} cannot be set: all environments share their options")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any):
        raise ConfigError(f"{method_name} cannot be called: the environments are rows of arrays")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def _rows(self, infos: dict[str, Any]) -> list[dict[str, Any]]:
        return [{name: infos[name][i] for name in self.info_keys} for i in range(self.num_envs)]
