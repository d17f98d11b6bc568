# %% [markdown]
# # Switch the suspension
#
# `RoadRecon-v0` is a Gymnasium environment: the agent switches the suspension of a vehicle between
# *ride* (soft, low damping) and *handling* (stiff, high damping) and pays for discomfort, strut
# travel and varying tyre loads. A policy of four lines beats both constant states in a lane change.

# %%
import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np
from matplotlib.figure import Figure

import road_envs  # registers RoadRecon-v0
from road_envs.policies import create
from road_envs.policies.rollout import roll_out

parser = argparse.ArgumentParser(description="Switch the suspension in a lane change.")
parser.add_argument("--out", type=Path, default=Path("out/examples"), help="folder of the picture")
parser.add_argument("--drives", type=int, default=32, help="roads on which policies are compared")
options = parser.parse_known_args()[0]  # a notebook kernel has arguments of its own
options.out.mkdir(parents=True, exist_ok=True)

TASK = {
    "road": "iso_c",
    "speed_kmh": 54.0,
    "length": 150.0,
    "control": "axle",  # actions: front + 2 * rear, with 0 ride and 1 handling
    "manoeuvre": "lane_change",
    "observe": ["accelerations", "planar"],  # adds the longitudinal and lateral acceleration
}

# %% [markdown]
# ## One episode
#
# The rule: handling on both axles while the lateral acceleration exceeds 1 m/s².

# %%
THRESHOLD = 1.0  # [m/s²]
RIDE, HANDLING = 0, 3

env = gym.make(road_envs.ID, **TASK)
observation, info = env.reset(seed=1)
trace, ended = [], False
while not ended:
    lateral = env.unwrapped.split(observation)["planar"][1]
    action = HANDLING if abs(lateral) > THRESHOLD else RIDE
    observation, reward, terminated, truncated, info = env.step(action)
    trace.append((info["station"], lateral, action == HANDLING, reward))
    ended = terminated or truncated
station, lateral, firm, reward = np.array(trace).T
print(f"{len(trace)} control steps, {firm.mean():.0%} in handling, return {reward.sum():.2f}")

# %% [markdown]
# ## The same rule as a policy
#
# A policy has `reset(context)` and `act(observations)`, and drives many vehicles at once: here one
# for each road. `PolicyContext` finds the parts of an observation by name.


# %%
class LateralThreshold:
    """Handling on both axles while the lateral acceleration exceeds THRESHOLD."""

    def reset(self, context):
        self.context = context

    def act(self, observations):
        firm = np.abs(self.context.signal("planar", observations)[:, 1]) > THRESHOLD
        return self.context.switch_axles(np.stack([firm, firm], axis=1), "ride", "handling")


policies = {
    "always ride": create("fixed_ride"),
    "always handling": create("fixed_handling"),
    "running RMS (tuned)": create("rrms"),
    "lateral threshold": LateralThreshold(),
}
returns = {}
for name, policy in policies.items():
    rollout = roll_out(policy, TASK, seeds=range(options.drives), store_observations=False)
    returns[name] = rollout.returns
    print(f"{name:<20} return {rollout.returns.mean():.2f} on {options.drives} roads")

# %%
figure = Figure(figsize=(10, 4), layout="constrained")
drive, bars = figure.subplots(1, 2, width_ratios=(3, 2))
drive.plot(station, lateral, color="0.2", lw=1.2, label="lateral acceleration")
low, high = drive.get_ylim()
drive.fill_between(
    station,
    low,
    high,
    where=firm > 0,
    step="post",
    color="#D55E00",
    alpha=0.2,
    lw=0,
    label="handling",
)
drive.set(xlabel="station of the front axle [m]", ylabel="[m/s²]", ylim=(low, high))
drive.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
names = list(returns)
costs = [-returns[name].mean() for name in names]
bars.barh(names, costs, color=["#0072B2"] * 3 + ["#D55E00"])
bars.invert_yaxis()
bars.set(xlabel="mean cost of an episode (less is better)")
for axes in (drive, bars):
    axes.spines[["top", "right"]].set_visible(False)
figure.savefig(options.out / "switch_the_suspension.png", dpi=120)
