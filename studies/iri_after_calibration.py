"""IRI of 100 m segments by `map_smoother` on vehicles of S3 that two drives calibrated, and the
shares of its errors inside its intervals.

    python -m studies.iri_after_calibration RESULTS.jsonl [--individuals N]
        [--plot FILE]

One line of JSON for each drive is appended to the results; those that stand there are not computed
again. Each individual is calibrated as in the blind division of the field board, by drives over
200 m of class D at 54 km/h and 150 m of class C at 36 km/h that nobody measured, and then drives at
54 km/h over a segment of each of the classes A to C, of which it is told nothing.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from estimators.api import CalibrationDrive
from estimators.map_smoother.estimator import MapSmoother
from leaderboard.metrics.heights import band_pass, error_over_truth, uncertainty
from leaderboard.report.plots import COLOURS, write_figure
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Profile, Record, scored_band
from road_envs.records.roughness import iri
from road_envs.roads import realise_road
from road_envs.vehicle.parameters import load_vehicle
from studies.study import Row, run_study, study_parser

MIXED, SPEED_KMH = {"front": "ride", "rear": "handling"}, 54.0
CALIBRATION = (("iso_d", 200.0, MIXED, SPEED_KMH), ("iso_c", 150.0, "ride", 36.0))
"""Road, its length [m], mode and speed [km/h] of the drives before."""

CLASSES = ("A", "B", "C")
SEGMENT = 100.0
"""Length [m] of the segment, the first of a road."""

LENGTH = 200.0
"""Length [m] of a road."""

FIRST_INDIVIDUAL = 1401
"""Seed of the first individual; nothing was developed on any."""


def drive(
    individual: int, road: str, k: int, length: float, mode: Any, speed_kmh: float
) -> tuple[Record, Profile]:
    """Return the record and the profile of drive `k` of an individual."""
    seed = 1_200_000 + 10_000 * k + individual
    return simulate_record(
        realise_road(road, seed, length),
        speed_kmh=speed_kmh, mode=mode, seed=seed, individual=individual, grade="S3",
    )  # fmt: skip


@cache
def calibrated(individual: int) -> MapSmoother:
    """Return the estimator for an individual."""
    records = [
        drive(individual, road, k, length, mode, speed)[0]
        for k, (road, length, mode, speed) in enumerate(CALIBRATION)
    ]
    car = load_vehicle("land_rover_defender_110")
    return MapSmoother().calibrate([CalibrationDrive(record) for record in records], car)


def drive_result(individual: int, road_class: str) -> Row:
    """Return true and estimated IRI of each segment of both wheel paths, NRMSE and coverage."""
    k = len(CALIBRATION) + CLASSES.index(road_class)
    road = f"iso_{road_class.lower()}"
    record, truth = drive(individual, road, k, LENGTH, MIXED, SPEED_KMH)
    found = calibrated(individual).estimate(record, load_vehicle("land_rover_defender_110"))
    pair = np.stack([truth.z, found.z])
    y, a = band_pass(pair, truth.ds, scored_band(SPEED_KMH / 3.6))
    assert found.z_std is not None
    scores = uncertainty(y, a, found.z_std)
    segments = iri(pair, truth.ds, segment=SEGMENT).reshape(2, -1)
    return {
        "iri": np.round(segments, 4).tolist(),
        "nrmse": round(error_over_truth(y, a).pooled, 4),
        "inside": [round(scores.coverage_50, 3), round(scores.coverage_90, 3)],
    }


def summary(rows: Sequence[Row]) -> str:
    """Return the errors of the IRI by class, and over all."""
    lines = [
        "IRI of 100 m segments, S3 after two drives over unmeasured roads, 54 km/h",
        f"{'class':<7}{'drives':>7}{'segments':>10}{'IRI m/km':>10}{'median |error|':>16}"
        f"{'worst':>8}{'RMSE m/km':>11}{'NRMSE':>8}{'in 50 %':>9}{'in 90 %':>9}",
    ]
    for name in (*CLASSES, "all"):
        chosen = [row for row in rows if name in (row["road_class"], "all")]
        if not chosen:
            continue
        true, found = np.concatenate([row["iri"] for row in chosen], axis=1)
        relative = np.abs(found / true - 1.0)
        inside = np.mean([row["inside"] for row in chosen], axis=0)
        lines.append(
            f"{name:<7}{len(chosen):>7}{true.size:>10}{true.mean():>10.2f}"
            f"{np.median(relative):>16.1%}{relative.max():>8.1%}"
            f"{np.sqrt(np.mean((found - true) ** 2)):>11.3f}"
            f"{np.median([row['nrmse'] for row in chosen]):>8.3f}{inside[0]:>9.0%}{inside[1]:>9.0%}"
        )
    return "\n".join(lines)


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw estimated over true IRI of all segments."""

    def paint(figure: Any) -> None:
        axes = figure.subplots()
        true, found = np.concatenate([row["iri"] for row in rows], axis=1)
        axes.plot([0.0, true.max()], [0.0, true.max()], color="0.7", lw=0.8)
        axes.plot(true, found, "o", ms=3, color=COLOURS["left"])
        axes.set_xlabel("true IRI [m/km]")
        axes.set_ylabel("estimated IRI [m/km]")

    write_figure(paint, (4.0, 3.6), path)


def main() -> None:
    """Run the study."""
    parser = study_parser("IRI of segments after a blind calibration.")
    parser.add_argument("--individuals", type=int, default=3)
    chosen = parser.parse_args()
    cases = [
        {"individual": FIRST_INDIVIDUAL + k, "road_class": name}
        for k in range(chosen.individuals)
        for name in CLASSES
    ]
    run_study(chosen, cases, drive_result, summary, draw)


if __name__ == "__main__":
    main()
