# %% [markdown]
# # Train a policy with Stable-Baselines3
#
# `RoadReconVecEnv` drives many vehicles side by side as one Stable-Baselines3 environment. In a few
# seconds PPO learns from raw accelerations that a soft suspension is the comfortable one on a
# straight road. `docs/policies.md` has the results of longer trainings.

# %%
import argparse
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

from road_envs.envs.sb3 import RoadReconVecEnv

parser = argparse.ArgumentParser(description="Train a switching policy by PPO for some seconds.")
parser.add_argument("--out", type=Path, default=Path("out/examples"), help="folder of the picture")
parser.add_argument("--steps", type=int, default=80_000, help="environment steps, at least 8000")
options = parser.parse_known_args()[0]  # a notebook kernel has arguments of its own
options.out.mkdir(parents=True, exist_ok=True)
torch.set_num_threads(1)  # the network is too small for more

TASK = {
    "road": "iso_d",
    "speed_kmh": [40.0, 54.0],  # each episode draws its speed and its road
    "length": 60.0,
    "control": "axle",
    "truth": False,  # the true road would only slow the steps
}
N_ENVS = 64

# %% [markdown]
# ## Constant states, for comparison


# %%
def episode_returns(choose, seed):
    """Return the return of one episode in each environment, with actions `choose(observations)`."""
    envs = RoadReconVecEnv(N_ENVS, **TASK)
    envs.seed(seed)
    observations = envs.reset()
    returns, running = np.zeros(N_ENVS), np.ones(N_ENVS, dtype=bool)
    while running.any():
        observations, rewards, dones, _ = envs.step(choose(observations))
        returns += np.where(running, rewards, 0.0)
        running &= ~dones
    return returns


TEST_SEED = 10_000
PAIRS = ("ride", "handling in front", "handling at the rear", "handling")
constant = [
    episode_returns(lambda x, a=action: np.full(len(x), a), TEST_SEED).mean() for action in range(4)
]
for name, value in zip(PAIRS, constant, strict=True):
    print(f"{name:<22} return {value:.2f}")

# %% [markdown]
# ## The training


# %%
class LearningCurve(BaseCallback):
    """Record the mean return of the latest episodes after each rollout."""

    def __init__(self):
        super().__init__()
        self.points = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        if episodes := self.model.ep_info_buffer:
            self.points.append((self.num_timesteps, np.mean([each["r"] for each in episodes])))


envs = VecMonitor(RoadReconVecEnv(N_ENVS, **TASK))
curve = LearningCurve()
settings = {"n_steps": 32, "batch_size": 512, "gamma": 0.9, "learning_rate": 1e-3}
model = PPO("MlpPolicy", envs, **settings, seed=1, device="cpu")
model.learn(options.steps, callback=curve)
learned = episode_returns(lambda x: model.predict(x, deterministic=True)[0], TEST_SEED).mean()
print(f"{'PPO':<22} return {learned:.2f} after {model.num_timesteps} steps")
model.save(options.out / "policy.zip")

# %%
figure = Figure(figsize=(8, 4.5), layout="constrained")
axes = figure.subplots()
steps, means = np.array(curve.points).T
axes.plot(steps, means, color="#D55E00", lw=2, label="PPO, while exploring")
axes.plot(steps[-1], learned, "o", color="#D55E00", label="PPO, deterministic, test roads")
for name, value, style in zip(PAIRS, constant, ("-", ":", "-.", "--"), strict=True):
    axes.axhline(value, color="0.4", ls=style, lw=1, label=f"always {name}")
axes.set(xlabel="environment steps", ylabel="return of an episode")
axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
axes.spines[["top", "right"]].set_visible(False)
figure.savefig(options.out / "train_a_policy.png", dpi=120)
