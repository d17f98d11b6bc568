"""Individuals whose bodies twist and bend, and whose tyres hold them sideways as no file says.

    python -m studies.bodies_and_sides [--individuals N] [--seed SEED]

`road-recon estimate map_smoother` gets the description of each car, of which individuals of grade
S2 have another body and those of S4 another side motion too (of the paper's vehicle, the file has
none). A row holds the medians of N drives of 100 m at 54 km/h, each over another road with another
individual; `side` is the number of drives on which side motion is noted.
"""

import argparse
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

CARS = ("land_rover_defender_110", "bmw_320i", "saloon")
GRADES, ROADS, SPEED_KMH, LENGTH = ("S2", "S4"), ("iso_b", "iso_c"), 54.0, 100.0
HEAD = ("car", "grade", "road", "error", "worst", "in 90 %", "IRI", "IRI worst", "side")


def estimated(record: Record, car: VehicleParameters) -> tuple[Estimate, bool]:
    """Return the estimate of the drive of a car, and whether side motion is noted."""
    measured = MeasuredRecord(record)
    drive = DriveFile("", "", measured, "", car, "paper", False, DriveDescription())
    estimator = make_drive_estimator("map_smoother", drive, {})
    drive, found = estimate_drive(estimator, with_doubts(drive))
    return found, any("sideways" in note for note in drive.measured.notes)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Bodies and side motions that no file says.")
    parser.add_argument("--individuals", type=int, default=2)
    parser.add_argument("--seed", type=int, default=9350)
    chosen = parser.parse_args()
    print("in-band NRMSE of map_smoother, share of errors in 90 % intervals, error of the IRI")
    print(("{:<25}{:<7}{:<7}" + "{:>10}" * 6).format(*HEAD))
    for name, grade, road in ((n, g, r) for n in CARS for g in GRADES for r in ROADS):
        car, rows, noted = load_vehicle(name), list[list[float]](), 0
        mode = "passive" if car.is_passive else {"front": "ride", "rear": "handling"}
        for seed in range(chosen.seed, chosen.seed + chosen.individuals):
            record, truth = simulate_record(
                road, vehicle=car, speed_kmh=SPEED_KMH, mode=mode, seed=seed, grade=grade,
                length=LENGTH,
            )  # fmt: skip
            found, is_noted = estimated(record, car)
            scores = score(found, truth, speed_kmh=SPEED_KMH)
            true, told = (np.mean(iri(z, truth.ds)) for z in (truth.z, found.z))
            rows.append([scores["nrmse"], scores["coverage_90"], float(told / true - 1.0)])
            noted += is_noted
        error, inside, bias = (median(row[k] for row in rows) for k in range(3))
        worst, worst_bias = max(row[0] for row in rows), max((row[2] for row in rows), key=abs)
        print(
            f"{name:<25}{grade:<7}{road:<7}{error:>10.3f}{worst:>10.3f}{100 * inside:>10.0f}"
            f"{bias:>+10.1%}{worst_bias:>+10.1%}{noted:>5} of {len(rows)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
