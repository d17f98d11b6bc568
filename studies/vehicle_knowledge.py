"""Error of `map_smoother` over what it knows of the vehicle, on the test drives of the field board.

    python -m studies.vehicle_knowledge RESULTS.jsonl --drives S1 54 9 [--drives ...] [--plot FILE]

One line of JSON for each drive is appended to the results; those that stand there are not computed
again. Each `--drives` is a grade, a speed [km/h] and a number of test drives of the board, whose
own table has the blind division. What is known of the vehicle:

| described | its description |
| adapted | its description, fitted to the very drive: the described division of the board |
| known | fitted to the calibration drive of the known division |
| true | the individual itself, and of its instruments what their data sheet says |
| attainable | no estimate: what the individual itself allows, from data below 100 Hz |
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estimators.map_smoother.estimator import MapSmoother
from leaderboard.evaluation.tasks import Condition, Task, load_task
from leaderboard.evaluation.test_data import calibration_drives, simulate_drive
from leaderboard.metrics.bootstrap import interquartile_mean
from leaderboard.metrics.heights import nrmse
from leaderboard.report.attainable import drive_error
from leaderboard.report.plots import COLOURS, write_figure
from road_envs.records.record import scored_band
from road_envs.sensing.perturbed_vehicle import GRADES
from studies.study import Row, run_study, study_parser

TICKS = (0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.5)
KNOWLEDGE = ("described", "adapted", "known", "true", "attainable")


def drive_result(grade: str, speed_kmh: float, drive: int) -> Row:
    """Return the errors on a test drive of the field board."""
    task = _task("field_known", grade, speed_kmh, drive)
    condition, car = _condition(task, grade, speed_kmh), task.vehicle
    road, seed = next(x[1:] for x in task.drives_of(task.test, condition) if x[0] == drive)
    one = simulate_drive(task, task.test, condition, road, seed)
    true = task.individual(drive, condition.grade).car
    described, adapting = MapSmoother(draws=0, adapt=False), MapSmoother(draws=0)
    runs = {
        "described": (described, car),
        "adapted": (adapting, car),
        "known": (adapting.calibrate(calibration_drives(task, condition, seed), car), car),
        "true": (described, true),
    }
    band = scored_band(speed_kmh / 3.6)
    errors = {}
    for knowledge, (smoother, vehicle) in runs.items():
        estimate = smoother.estimate(one.record, vehicle)
        errors[knowledge] = nrmse(one.truth.z, estimate.z, one.truth.ds, band).pooled
    errors["attainable"] = drive_error(task, condition, one, true)
    return {"nrmse": {k: round(x, 4) for k, x in errors.items() if np.isfinite(x)}}


def _condition(task: Task, grade: str, speed_kmh: float) -> Condition:
    return next(c for c in task.conditions if (c.grade, c.speed_kmh) == (grade, speed_kmh))


def _task(name: str, grade: str, speed_kmh: float, drive: int) -> Task:
    """Return a task with more drives than its default if `drive` is none of these."""
    task = load_task(name)
    drives = task.drives_of(task.test, _condition(task, grade, speed_kmh))
    return task if drive in [k for k, _, _ in drives] else task.with_test_drives(drive + 1)


def summary(rows: Sequence[Row]) -> str:
    """Return interquartile means and worst errors by grade, as on the board, and by speed."""
    lines = ["in-band NRMSE of map_smoother: interquartile mean over drives (worst)"]
    lines.append(f"{'grade':<7}{'km/h':>5}{'drives':>8}" + "".join(f"{k:>16}" for k in KNOWLEDGE))
    for grade in sorted({row["grade"] for row in rows}):
        chosen = [row for row in rows if row["grade"] == grade]
        for speed in sorted({row["speed_kmh"] for row in chosen}):
            part = [row for row in chosen if row["speed_kmh"] == speed]
            lines.append(_line(grade, f"{speed:g}", part))
        lines.append(_line(grade, "all", chosen))
    return "\n".join(line.rstrip() for line in lines)


def _line(grade: str, speed: str, rows: Sequence[Row]) -> str:
    cells = []
    for knowledge in KNOWLEDGE:
        x = np.array([r["nrmse"][knowledge] for r in rows if knowledge in r["nrmse"]])
        cells.append(f"{interquartile_mean(x):.3f} ({x.max():.3f})" if x.size else "")
    return f"{grade:<7}{speed:>5}{len(rows):>8}" + "".join(f"{cell:>16}" for cell in cells)


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the error of each drive over what is known of the vehicle, one panel a grade."""
    grades = [grade for grade in GRADES if any(row["grade"] == grade for row in rows)]

    def paint(figure: Any) -> None:
        panels = figure.subplots(1, len(grades), sharey=True, squeeze=False)[0]
        for axes, grade in zip(panels, grades, strict=True):
            speeds = sorted({row["speed_kmh"] for row in rows if row["grade"] == grade})
            for speed, colour in zip(speeds, (COLOURS["left"], COLOURS["right"]), strict=False):
                errors = [
                    r["nrmse"] for r in rows if (r["grade"], r["speed_kmh"]) == (grade, speed)
                ]
                shown = [k for k in KNOWLEDGE if all(k in e for e in errors)]
                for e in errors:
                    axes.plot(shown, [e[k] for k in shown], color=colour, lw=0.6, alpha=0.5)
                median = [np.median([e[k] for e in errors]) for k in shown]
                label = f"{speed:g} km/h, {len(errors)} drives"
                axes.plot(shown, median, "o-", color=colour, label=label)
            axes.set_title(f"{grade}")
            axes.tick_params(axis="x", rotation=45)
            axes.legend(frameon=False)
        panels[0].set_yscale("log")
        panels[0].set_yticks(TICKS, [f"{x:g}" for x in TICKS])
        panels[0].minorticks_off()
        panels[0].set_ylabel("in-band NRMSE of map_smoother")

    write_figure(paint, (3.6 * len(grades) + 0.6, 4.2), path)


def main() -> None:
    """Run the study."""
    parser = study_parser("Error over knowledge of the vehicle.")
    parser.add_argument("--drives", action="append", nargs=3, metavar=("GRADE", "KMH", "NUMBER"))
    chosen = parser.parse_args()
    cases = []
    for grade, kmh, number in chosen.drives or []:
        task = load_task("field_known").with_test_drives(int(number))
        drives = task.drives_of(task.test, _condition(task, grade, float(kmh)))
        cases += [{"grade": grade, "speed_kmh": float(kmh), "drive": k} for k, _, _ in drives]
    run_study(chosen, cases, drive_result, summary, draw)


if __name__ == "__main__":
    main()
