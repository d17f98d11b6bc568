"""The world: roads, vehicle, instruments, and their Gymnasium face `RoadRecon-v0`.

Read the files in the order in which data flows: `config`, `record`, `roads`, `vehicle`, `curves`,
`suspension`, `dynamics`, `integrator`, `simulate`, `sensors`, `dataset`, `lanes`, `interval`,
`fleet`, `episode`, `env`, `vector_env`.
"""

import gymnasium

__version__ = "0.2.0"

ID = "RoadRecon-v0"

if ID not in gymnasium.registry:
    gymnasium.register(
        id=ID,
        entry_point="road_envs.envs.road_recon:RoadReconEnv",
        vector_entry_point="road_envs.envs.vector:RoadReconVectorEnv",
        max_episode_steps=100_000,
    )
