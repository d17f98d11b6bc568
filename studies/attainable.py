"""Error of `map_smoother` on the test drives of the main board, beside its bounds.

    python -m studies.attainable RESULTS.jsonl [--plot FILE]

One line of JSON for each drive is appended to the results; those that stand there are not computed
again. All bounds have the spectrum of the road driven (`leaderboard.evaluation.bound`):

| van Trees | least error of any estimator, in the mean over Gaussian roads of this spectrum |
| attainable | posterior of the nonlinear vehicle at the very road, from data below 100 Hz |
| bound | linear vehicle without friction, from data below 25 Hz |
| linear | the same with friction as noise: the least error of linear estimators |
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estimators.map_smoother.attainable import van_trees_error
from estimators.map_smoother.estimator import MapSmoother
from leaderboard.evaluation.bound import fit_spectrum
from leaderboard.evaluation.tasks import load_task
from leaderboard.evaluation.test_data import simulate_drives
from leaderboard.metrics.bootstrap import interquartile_mean
from leaderboard.metrics.heights import nrmse
from leaderboard.report.attainable import BANDWIDTH, drive_error
from leaderboard.report.plots import write_figure
from road_envs.analysis.information_bound import RoadPrior, bound
from road_envs.records.record import scored_band
from studies.study import Row, run_study, study_parser

TASK = load_task("new_road")
COLUMNS = ("map_smoother", "attainable", "van Trees", "bound", "linear")
VAN_TREES_ROADS = 4
"""Roads of 300 m over which the information is averaged; with 16 the figure is a sixth to a quarter
lower."""


def drive_result(state: str, drive: int) -> Row:
    """Return error and bounds on a test drive in a `state` of the struts, at a speed."""
    condition = next(c for c in TASK.conditions if c.label == state)
    one = next(d for d in simulate_drives(TASK, TASK.test, condition) if d.index == drive)
    car, mode, v = TASK.vehicle, condition.simulator_mode, condition.speed_kmh / 3.6
    band = scored_band(v)
    estimate = MapSmoother(draws=0).estimate(one.record, car)
    level, w = fit_spectrum(one.truth, band) or (np.nan, np.nan)
    prior = RoadPrior(G_d0=10.0 ** (level / 10.0), w=w)
    floor = bound(car, mode, v, TASK.sensors, prior, residual_as_noise=True).pooled
    errors = {
        "map_smoother": nrmse(one.truth.z, estimate.z, one.truth.ds, band).pooled,
        "attainable": drive_error(TASK, condition, one, car),
        "van Trees": van_trees_error(
            one.record, car, prior, bandwidth=BANDWIDTH, roads=VAN_TREES_ROADS
        ),
        "bound": bound(car, mode, v, TASK.sensors, prior).pooled,
        "linear": floor,
    }
    return {
        "family": TASK.test.families[drive % len(TASK.test.families)],
        "mode": state.rsplit(",", 1)[0],
        "km/h": condition.speed_kmh,
        "nrmse": {name: round(error, 4) for name, error in errors.items()},
    }


def summary(rows: Sequence[Row]) -> str:
    """Return the errors of each drive, and interquartile means by family, speed and state."""
    width = max(len(f"{r['family']}, {r['state']}") for r in rows) + 2
    lines = ["in-band NRMSE" + " " * (width - 13) + "".join(f"{name:>14}" for name in COLUMNS)]

    def line(name: str, chosen: Sequence[Row], pick: Callable[..., Any]) -> None:
        cells = (float(pick(np.array([r["nrmse"][column] for r in chosen]))) for column in COLUMNS)
        lines.append(f"{name:<{width}}" + "".join(f"{cell:>14.3f}" for cell in cells))

    for row in rows:
        line(f"{row['family']}, {row['state']}", [row], np.max)
    lines.append("interquartile means")
    for key in ("family", "km/h", "mode"):
        for value in dict.fromkeys(row[key] for row in rows):
            chosen = [r for r in rows if r[key] == value]
            line(f"  {value}" + " km/h" * (key == "km/h"), chosen, interquartile_mean)
    for name, pick in (("", interquartile_mean), (", median", np.median), (", worst", np.max)):
        line(f"  all{name}", rows, pick)
    return "\n".join(lines)


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the error of each drive over what is attainable there."""

    def paint(figure) -> None:
        axes = figure.subplots()
        for family in dict.fromkeys(row["family"] for row in rows):
            points = [r["nrmse"] for r in rows if r["family"] == family]
            x, y = ([p[name] for p in points] for name in ("attainable", "map_smoother"))
            axes.loglog(x, y, "o", label=family)
        ends = [0.01, 1.0]
        axes.loglog(ends, ends, color="0.5", lw=0.8)
        axes.set_xlabel("attainable in-band NRMSE")
        axes.set_ylabel("in-band NRMSE of map_smoother")
        axes.legend(frameon=False)

    write_figure(paint, (5.0, 4.2), path)


def main() -> None:
    """Run the study."""
    chosen = study_parser("Error on the main board beside its bounds.").parse_args()
    cases = [
        {"state": condition.label, "drive": index}
        for condition in TASK.conditions
        for index, _, _ in TASK.drives_of(TASK.test, condition)
    ]
    run_study(chosen, cases, drive_result, summary, draw)


if __name__ == "__main__":
    main()
