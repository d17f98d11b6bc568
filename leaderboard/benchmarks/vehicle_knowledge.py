"""Error of `map_smoother` over what it knows of the vehicle, on individuals of each grade.

    python -m leaderboard.benchmarks.vehicle_knowledge RESULTS.jsonl [--individuals N] [--grade S1]
        [--plot FILE]

One line of JSON for each individual is appended to the results; those that stand there are not
computed again. The test drive is one of 120 m at 54 km/h, soft in front and stiff at the rear, over
class D. What is known of the vehicle:

| told | its description |
| adapted | its description, fitted to the very drive |
| blind | fitted to another drive of 150 m, over a road that nobody measured |
| known | fitted to 100 m over a road measured with errors of 0.5 mm |
| true | the individual itself, and of its instruments what their data sheet says |
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from estimators.api import CalibrationDrive, copy_with
from estimators.common.identified_vehicle import IdentifiedVehicle
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.identification import IdentificationResult, identify
from leaderboard.benchmarks.study import Row, run_study, study_parser
from leaderboard.evaluation.test_data import levelled
from leaderboard.metrics.heights import nrmse
from leaderboard.report.plots import COLOURS, write_figure
from road_envs.data.record import Profile, Record, scored_band
from road_envs.data.recording import simulate_record
from road_envs.roads import realise_road
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.perturbed_vehicle import GRADES, perturb_vehicle

MIXED = {"front": "ride", "rear": "handling"}
SPEED_KMH = 54.0
KNOWLEDGE = ("told", "adapted", "blind", "known", "true")
SURVEY_STD = 0.0005
FIRST_INDIVIDUAL = 1001
"""Seed of the first individual; those below were looked at in development."""

TEST_ROAD, KNOWN_ROAD, BLIND_ROAD = (1_070_000, 120.0), (1_080_000, 100.0), (1_090_000, 150.0)
"""First seed and length [m] of the test roads, and of the roads of both calibrations."""


def calibrate(
    car: VehicleParameters, individual: int, grade: str, division: str
) -> IdentificationResult:
    """Identify an individual from a drive over a `known` road or over one that nobody measured."""
    known = division == "known"
    record, profile = _drive(individual, grade, KNOWN_ROAD if known else BLIND_ROAD)
    drive = CalibrationDrive(record)
    if known:
        measured = levelled(profile, SURVEY_STD, np.random.default_rng(individual))
        drive = CalibrationDrive(record, measured, SURVEY_STD)
    return identify([drive], car, structure=None)


def individual_result(individual: int, grade: str) -> Row:
    """Return the result of one individual."""
    car = load_vehicle("land_rover_defender_110")
    true = perturb_vehicle(car, grade, individual).car
    found = {k: calibrate(car, individual, grade, k) for k in ("known", "blind")}
    record, truth = _drive(individual, grade, TEST_ROAD)
    told = MapSmoother(draws=0, adapt=False)
    adapting = MapSmoother(draws=0)
    errors = {}
    for knowledge in KNOWLEDGE:
        smoother = {"told": told, "adapted": adapting, "true": told}.get(knowledge)
        if smoother is None:
            smoother = copy_with(adapting, identified=IdentifiedVehicle.of(found[knowledge]))
        estimate = smoother.estimate(record, true if knowledge == "true" else car)
        band = scored_band(float(record.v.mean()))
        errors[knowledge] = round(nrmse(truth.z, estimate.z, truth.ds, band).pooled, 4)
    frame, bending = true.variation.frame, true.variation.bending
    return {
        "frame": frame and round(frame.f, 2),
        "bending": bending and round(bending.f, 2),
        "nrmse": errors,
    }


def _drive(seed: int, grade: str, road: tuple[int, float]) -> tuple[Record, Profile]:
    first, length = road
    surface = realise_road("iso_d", first + seed, length)
    return simulate_record(
        surface, speed_kmh=SPEED_KMH, mode=MIXED, seed=first + seed, individual=seed, grade=grade
    )


def summary(rows: Sequence[Row]) -> str:
    """Return medians and worst errors."""
    lines = ["median (worst) in-band NRMSE of map_smoother"]
    lines.append(f"{'grade':<7}{'n':>3}  " + "".join(f"{k:>16}" for k in KNOWLEDGE))
    for grade in GRADES:
        chosen = [row for row in rows if row["grade"] == grade]
        if not chosen:
            continue
        cells = ([row["nrmse"][k] for row in chosen] for k in KNOWLEDGE)
        text = "".join(f"   {np.median(c):.3f} ({max(c):.3f})" for c in cells)
        lines.append(f"{grade:<7}{len(chosen):>3}  {text}")
    return "\n".join(lines)


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the error of each individual over what is known of the vehicle."""
    grades = [grade for grade in GRADES if any(row["grade"] == grade for row in rows)]

    def paint(figure: Any) -> None:
        panels = figure.subplots(1, len(grades), sharey=True, squeeze=False)[0]
        for axes, grade in zip(panels, grades, strict=True):
            errors = [row["nrmse"] for row in rows if row["grade"] == grade]
            for e in errors:
                axes.plot(KNOWLEDGE, [e[k] for k in KNOWLEDGE], color="0.8", lw=0.8)
            median = [np.median([e[k] for e in errors]) for k in KNOWLEDGE]
            axes.plot(KNOWLEDGE, median, "o-", color=COLOURS["left"], label="median")
            number = f"{len(errors)} individual" + "s" * (len(errors) > 1)
            axes.set_title(f"{grade}, {number}")
            axes.set_xlabel("what is known of the vehicle")
        panels[0].set_ylim(0.0, 1.05 * max(max(row["nrmse"].values()) for row in rows))
        panels[0].set_ylabel("in-band NRMSE of map_smoother")
        panels[0].legend(frameon=False)

    write_figure(paint, (3.6 * len(grades) + 0.6, 3.8), path)


def main() -> None:
    """Run the study."""
    parser = study_parser("Error over knowledge of the vehicle.")
    parser.add_argument("--individuals", type=int, default=0)
    parser.add_argument("--grade", action="append", choices=GRADES[1:])
    chosen = parser.parse_args()
    cases = [
        {"individual": FIRST_INDIVIDUAL + k, "grade": grade}
        for k in range(chosen.individuals)
        for grade in chosen.grade or GRADES[1:]
    ]
    run_study(chosen, cases, individual_result, summary, draw)


if __name__ == "__main__":
    main()
