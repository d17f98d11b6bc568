"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347) by Stable-Baselines3.

Observations and rewards are normalised by running statistics, since samples in m/s² and strut
states differ in size; the statistics are part of the learned policy.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

WORKERS = 4
ROLLOUT = 256
"""Environments stepped side by side, and intervals of each between two updates."""


class LearnedPPO:
    """A small network from the last control interval's samples to the strut state."""

    def learn(
        self,
        options: dict[str, Any],
        steps: int,
        seed: int,
        progress: Callable[[float], None],
    ) -> None:
        """Train on `steps` control intervals, rounded up to whole rollouts."""
        import torch
        from stable_baselines3 import PPO
        from stable_baselines3.common.callbacks import BaseCallback
        from stable_baselines3.common.env_util import make_vec_env
        from stable_baselines3.common.vec_env import VecNormalize

        class Progress(BaseCallback):
            def _on_step(self) -> bool:
                progress(min(self.num_timesteps / steps, 1.0))
                return True

        envs = make_vec_env("road_envs:RoadRecon-v0", WORKERS, seed=seed, env_kwargs=options)
        self.statistics = VecNormalize(envs)
        self.model = PPO(
            "MlpPolicy", self.statistics, n_steps=ROLLOUT, batch_size=256, seed=seed, device="cpu"
        )
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # layers this small only lose by being split
        try:
            self.model.learn(total_timesteps=steps, callback=Progress())
        finally:
            torch.set_num_threads(threads)
        self.statistics.training = False
        envs.close()

    def reset(self, actions: int, seed: int) -> None:
        """Nothing to prepare: the learned policy has no memory."""

    def act(self, observation: np.ndarray) -> int:
        """The likeliest action."""
        action, _ = self.model.predict(
            self.statistics.normalize_obs(observation), deterministic=True
        )
        return int(action)
