"""Vector environment of Stable-Baselines3 that is observed as the features of learned policies.

```python
from stable_baselines3 import PPO
from road_envs.envs.safe4s4 import Safe4S4VectorEnv
from road_envs.envs.sb3 import RoadReconVecEnv
from road_envs.policies.feature_env import FeatureVecEnv

envs = FeatureVecEnv(RoadReconVecEnv(32, vector_class=Safe4S4VectorEnv, cost_price=50.0), seed=1)
PPO("MlpPolicy", envs).learn(100_000).save("mine.zip")  # road-recon policies --policy mine.zip
```
"""

from typing import Any

import gymnasium
import numpy as np

from road_envs.core.extras import optional_import
from road_envs.envs.sb3 import RoadReconVecEnv
from road_envs.policies.api import PolicyContext
from road_envs.policies.features import MAX_FEATURE, N_FEATURES, FeatureExtractor

with optional_import("Stable-Baselines3 environments"):
    from stable_baselines3.common.vec_env import VecEnvWrapper

RIDE = ("ride", "ride")  # states of the paired baseline


class FeatureVecEnv(VecEnvWrapper):
    """Vector environment `env` observed as features, with actions that last for several intervals.

    An action is repeated for `action_repeat` intervals, whose rewards are summed. With
    `paired_baseline` the rewards of vehicles that stay in ride on the same roads are subtracted:
    of each pair of rows of `env` the second one, so that there are half as many environments. After
    one vehicle of a pair has rolled over, the two drive different roads of the same kind.
    """

    def __init__(
        self,
        env: RoadReconVecEnv,
        seed: int,
        *,
        action_repeat: int = 1,
        paired_baseline: bool = False,
    ):
        limits, setup = np.full(N_FEATURES, MAX_FEATURE, dtype=np.float32), env.env.setup
        super().__init__(env, gymnasium.spaces.Box(-limits, limits), setup.action_space)
        self.rows = 2 if paired_baseline else 1
        self.num_envs = env.num_envs // self.rows
        self.action_repeat = action_repeat
        env.seed(seed, alike=self.rows)
        self.features = FeatureExtractor(PolicyContext.from_setup(setup, self.num_envs, seed))

    def reset(self) -> np.ndarray:
        self.features.reset(np.ones(self.num_envs, dtype=bool))
        observations: Any = self.venv.reset()
        return self.features.update(observations[:: self.rows])

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = np.asarray(actions)

    def step_wait(self):
        """Return features, rewards up to the ends of episodes, dones (N, ...) and infos."""
        features, n = self.features, self.num_envs
        total, ended = np.zeros(n, dtype=np.float32), np.zeros(n, dtype=bool)
        infos: list[dict[str, Any]] = [{} for _ in range(n)]
        row_actions = np.full(self.venv.num_envs, features.context.action_index(*RIDE))
        row_actions[:: self.rows] = self._actions
        for _ in range(self.action_repeat):
            every_row: Any = self.venv.step(row_actions)
            observations, rewards, dones, part_infos = (x[:: self.rows] for x in every_row)
            if self.rows > 1:
                rewards = rewards - every_row[1][1::2]
            total += np.where(ended, 0.0, rewards).astype(np.float32)
            newly_ended = np.flatnonzero(dones & ~ended)
            if newly_ended.size:  # the learner bootstraps from the last features if truncated
                last = np.zeros_like(observations)
                last[newly_ended] = [part_infos[i]["terminal_observation"] for i in newly_ended]
                # the states of filtered features are taken as zero
                terminal = FeatureExtractor(features.context).update(last)
                for i in newly_ended:
                    infos[i] = {**part_infos[i], "terminal_observation": terminal[i]}
            features.reset(dones)
            observations = features.update(observations)
            ended |= dones
        return observations, total, ended, infos
