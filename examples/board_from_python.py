# %% [markdown]
# # A leaderboard from Python
#
# `run_task` evaluates estimators on a task in this process and returns a pandas DataFrame with one
# row per estimated drive. For estimators of other people use `road-recon leaderboard`, which runs
# each in a process of its own.

# %%
import argparse
from pathlib import Path

from matplotlib.figure import Figure

from leaderboard import run_task

parser = argparse.ArgumentParser(description="Evaluate estimators and draw the result.")
parser.add_argument("--out", type=Path, default=Path("out/examples"), help="folder of the picture")
parser.add_argument("--roads", type=int, default=2, help="test roads per condition")
parser.add_argument(
    "--estimators", nargs="+", default=["inverse_quarter_car", "fir_ridge", "wiener", "tcn"]
)
options = parser.parse_known_args()[0]  # a notebook kernel has arguments of its own
options.out.mkdir(parents=True, exist_ok=True)

# %% [markdown]
# ## The rows
#
# The task `new_road` has seven conditions: suspension states and speeds. Every score of the
# leaderboard is a column, in SI units.

# %%
table = run_task("new_road", options.estimators, roads=options.roads)
print(table[["estimator", "condition", "road", "nrmse", "r", "iri_error"]].head(8).to_string())

# %% [markdown]
# ## The ranking
#
# The board ranks by the in-band NRMSE. `table.attrs["labels"]` has the label of each score.

# %%
errors = table.groupby("estimator")["nrmse"]
ranking = errors.quantile([0.25, 0.5, 0.75]).unstack().sort_values(0.5)
print(ranking.round(3).rename(columns=lambda q: f"{q:.0%}").to_string())

# %%
figure = Figure(figsize=(8, 0.6 * len(ranking) + 1.4), layout="constrained")
axes = figure.subplots()
spread = [ranking[0.5] - ranking[0.25], ranking[0.75] - ranking[0.5]]
axes.barh(ranking.index, ranking[0.5], xerr=spread, color="#0072B2", ecolor="0.3", capsize=3)
axes.axvline(1.0, color="0.4", ls="--", lw=1.0)
axes.annotate(
    "flat road", (1.0, -0.45), (-4, 0), textcoords="offset points", ha="right", color="0.4"
)
axes.invert_yaxis()
axes.set(
    xlabel=f"{table.attrs['labels']['nrmse']}: median and quartiles over drives", xlim=(0, 1.05)
)
axes.spines[["top", "right"]].set_visible(False)
figure.savefig(options.out / "board.png", dpi=120)
