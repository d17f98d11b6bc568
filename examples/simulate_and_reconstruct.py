# %% [markdown]
# # Simulate a drive and reconstruct the road
#
# A Land Rover drives over Belgian paving. Three accelerometers on its body are recorded, and an
# estimator reconstructs the road under both wheel paths from that record alone.
#
# Run it as `python examples/simulate_and_reconstruct.py`, or cell by cell in an editor that knows
# `# %%` cells.

# %%
import argparse
from pathlib import Path

from matplotlib.figure import Figure

from estimators import estimate
from leaderboard import plot, score
from road_envs import simulate_record

parser = argparse.ArgumentParser(description="Simulate a drive and reconstruct its road.")
parser.add_argument("--out", type=Path, default=Path("out/examples"), help="folder of the pictures")
parser.add_argument("--road", default="belgian", help="shipped name, YAML file or surface file")
parser.add_argument("--speed-kmh", type=float, default=14.5)
parser.add_argument("--mode", default="handling", help="suspension state: ride or handling")
parser.add_argument(
    "--compare", nargs="+", default=["flat", "fir_ridge", "wiener", "iterated_wiener"]
)
options = parser.parse_known_args()[0]  # a notebook kernel has arguments of its own
options.out.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The drive
#
# `simulate_record` returns what an estimator may use, the `Record`, and what it has to find, the
# true `Profile`. The seed draws the sensor noise, and the road if it is a random one.

# %%
record, truth = simulate_record(
    options.road, speed_kmh=options.speed_kmh, mode=options.mode, seed=1
)
print(f"{record.t.size} samples at {record.fs:.0f} Hz over {record.length:.0f} m of road")

# %%
figure = Figure(figsize=(10, 7), layout="constrained")
panels = figure.subplots(4, 1, sharex=True)
for side, z in zip(("left", "right"), truth.z, strict=True):
    panels[0].plot(truth.s, 1000 * z, lw=0.9, label=side)
panels[0].set(ylabel="road [mm]", title=f"{options.road}, {options.speed_kmh:g} km/h")
panels[0].legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 0.98))
limit = 1.1 * abs(record.a).max()
sensors = ("right front", "left rear", "right rear")
for axes, sensor, a in zip(panels[1:], sensors, record.a, strict=True):
    axes.plot(record.s, a, lw=0.6, color="C2")
    axes.set(ylabel=f"{sensor} [m/s²]", ylim=(-limit, limit))
panels[-1].set(xlabel="station of the front axle [m]")
for axes in panels:
    axes.spines[["top", "right"]].set_visible(False)
figure.savefig(options.out / "drive.png", dpi=120)

# %% [markdown]
# ## The reconstruction
#
# The Wiener smoother inverts the linearised vehicle. It needs no training, and returns a standard
# deviation besides the heights. Accelerometers do not sense the mean height of the road, so the
# raw heights are off by a slowly varying amount; inside the scored band they agree.

# %%
estimated = estimate("wiener", record)
plot(estimated, truth).savefig(options.out / "estimate.png")

# %% [markdown]
# ## The score
#
# The ranking score is the in-band NRMSE: the RMS error of the heights divided by the RMS of the
# true ones, both within the scored band of spatial frequencies. A flat road has 1.

# %%
for name in options.compare:
    scores = score(estimate(name, record), truth)
    print(f"{name:<16} in-band NRMSE {scores['nrmse']:.2f}, correlation {scores['r']:.2f}")

# %%
print(score(estimated, truth))
