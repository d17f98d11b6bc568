"""Individuals whose bodies twist and bend, and whose tyres hold them sideways as no file says.

    python -m studies.bodies_and_sides RESULTS.jsonl [--individuals N]

`road-recon estimate map_smoother` gets the description of each car, of which individuals of grade
S2 have another body and those of S4 another side motion too (of the paper's vehicle, the file has
none). A line holds the medians of N drives of 100 m at 54 km/h, each over another road with another
individual; `side` is the number of drives on which side motion is noted. A row is appended to the
results for each drive; those that stand there are not computed again.
"""

from itertools import product
from statistics import median

import numpy as np

from leaderboard.drive_report.drive_estimates import (
    estimate_drive,
    make_drive_estimator,
    with_doubts,
)
from leaderboard.scoring import score
from road_envs.drives.logger_tables.description import DriveDescription
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.drives.reading import DriveFile
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Estimate, Record
from road_envs.records.roughness import iri
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from studies.study import Row, run_study, study_parser

CARS = ("land_rover_defender_110", "bmw_320i", "saloon")
GRADES, ROADS, SPEED_KMH, LENGTH = ("S2", "S4"), ("iso_b", "iso_c"), 54.0, 100.0
FIRST_SEED = 9350
HEAD = ("car", "grade", "road", "error", "worst", "in 90 %", "IRI", "IRI worst", "side")


def estimated(record: Record, car: VehicleParameters) -> tuple[Estimate, bool]:
    """Return the estimate of the drive of a car, and whether side motion is noted."""
    measured = MeasuredRecord(record)
    drive = DriveFile("", "", measured, "", car, "paper", False, DriveDescription())
    estimator = make_drive_estimator("map_smoother", drive, {})
    drive, found = estimate_drive(estimator, with_doubts(drive))
    return found, any("sideways" in note for note in drive.measured.notes)


def compute(car: str, grade: str, road: str, seed: int) -> Row:
    """Return the errors of one drive, and whether side motion is noted."""
    described = load_vehicle(car)
    record, truth = simulate_record(
        road,
        vehicle=described,
        speed_kmh=SPEED_KMH,
        mode="passive" if described.is_passive else {"front": "ride", "rear": "handling"},
        seed=seed,
        grade=grade,
        length=LENGTH,
    )
    found, is_noted = estimated(record, described)
    scores = score(found, truth, speed_kmh=SPEED_KMH)
    true, told = (np.mean(iri(z, truth.ds)) for z in (truth.z, found.z))
    return {
        "error": scores["nrmse"],
        "inside": scores["coverage_90"],
        "iri": float(told / true - 1.0),
        "side": is_noted,
    }


def summary(rows: list[Row]) -> str:
    """Return the table, a line for each car, grade and road."""
    lines = [
        "in-band NRMSE of map_smoother, share of errors in 90 % intervals, error of the IRI",
        ("{:<25}{:<7}{:<7}" + "{:>10}" * 6).format(*HEAD),
    ]
    cases = [(row["car"], row["grade"], row["road"]) for row in rows]
    for case in dict.fromkeys(cases):
        chosen = [row for row, own in zip(rows, cases, strict=True) if own == case]
        error, inside, bias = ([row[key] for row in chosen] for key in ("error", "inside", "iri"))
        car, grade, road = case
        lines.append(
            f"{car:<25}{grade:<7}{road:<7}{median(error):>10.3f}{max(error):>10.3f}"
            f"{100 * median(inside):>10.0f}{median(bias):>+10.1%}{max(bias, key=abs):>+10.1%}"
            f"{sum(row['side'] for row in chosen):>5} of {len(chosen)}"
        )
    return "\n".join(lines)


def main() -> None:
    """Compute what is missing and print the table."""
    parser = study_parser("Bodies and side motions that no file says.")
    parser.add_argument("--individuals", type=int, default=2)
    chosen = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + chosen.individuals)
    cases = [
        {"car": car, "grade": grade, "road": road, "seed": seed}
        for car, grade, road, seed in product(CARS, GRADES, ROADS, seeds)
    ]
    run_study(chosen, cases, compute, summary, lambda rows, path: None)


if __name__ == "__main__":
    main()
