"""Errors of the trained estimators on vehicles that differ from the described one.

    python -m studies.trained_estimators [NAME or FILE ...] [--individuals N]

Each of N individuals is driven over 100 m, of class D and of Belgian paving in turn, in three
conditions and as each of the grades S0 to S3. The table has the median (and the worst) in-band
NRMSE of each estimator, as trained (`described`) and after its correction by another 100 m of the
same vehicle in the same condition, levelled with errors of 0.5 mm (`known`). The seeds of the roads
and individuals are those of no task and of no training.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np

from estimators import make_estimator
from estimators.api import CalibrationDrive, CalibrationError
from leaderboard.evaluation.test_data import levelled
from leaderboard.metrics.heights import nrmse
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Profile, Record, scored_band
from road_envs.roads import realise_road
from road_envs.sensing.perturbed_vehicle import GRADES
from road_envs.vehicle.parameters import load_vehicle

NAMES = ("fir_ridge", "tcn", "tcn_causal", "gru", "gru_causal")
CONDITIONS: tuple[tuple[Any, float], ...] = (
    ("ride", 14.5),
    ("handling", 30.0),
    ({"front": "ride", "rear": "handling"}, 54.0),
)
ROADS = ("iso_d", "belgian_like")
LENGTH = 100.0  # [m]
SURVEY_STD = 0.0005  # [m]
FIRST_INDIVIDUAL, TEST_SEED, KNOWN_SEED = 2001, 1_110_000, 1_120_000
"""First seeds of the individuals, of the test roads and of the measured roads."""


def drives(individuals: int) -> Iterator[tuple[str, tuple[Record, Profile], CalibrationDrive]]:
    """Yield grade, test drive with its truth, and calibration drive of each case."""
    for grade in GRADES:
        for k in range(individuals):
            for i, (mode, speed_kmh) in enumerate(CONDITIONS):
                seed = len(CONDITIONS) * k + i
                drive = [
                    simulate_record(
                        realise_road(road, first + seed, LENGTH),
                        speed_kmh=speed_kmh,
                        mode=mode,
                        seed=first + seed,
                        individual=FIRST_INDIVIDUAL + k,
                        grade=grade,
                    )
                    for road, first in ((ROADS[seed % 2], TEST_SEED), ("iso_d", KNOWN_SEED))
                ]
                record, profile = drive[1]
                measured = levelled(profile, SURVEY_STD, np.random.default_rng(seed))
                yield grade, drive[0], CalibrationDrive(record, measured, SURVEY_STD)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("estimators", nargs="*", default=NAMES, metavar="NAME or FILE")
    parser.add_argument("--individuals", type=int, default=3)
    chosen = parser.parse_args()
    car = load_vehicle("land_rover_defender_110")
    estimators: dict[str, Any] = {name: make_estimator(name) for name in chosen.estimators}
    errors: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for grade, (record, truth), known in drives(chosen.individuals):
        band = scored_band(float(record.v.mean()))
        for name, estimator in estimators.items():
            variants = {"described": estimator}
            try:
                variants["known"] = estimator.calibrate([known], car)
            except CalibrationError:
                variants["known"] = estimator
            for knowledge, each in variants.items():
                z = each.estimate(record, car).z
                errors[name, knowledge, grade].append(nrmse(truth.z, z, truth.ds, band).pooled)
    print(f"{'estimator':12s}{'knows':>7s}" + "".join(f"{grade:>14s}" for grade in GRADES))
    for name in estimators:
        for knowledge in ("described", "known"):
            cells = [errors[name, knowledge, grade] for grade in GRADES]
            text = "".join(f"  {np.median(e):5.3f} ({max(e):4.2f})" for e in cells)
            print(f"{name:12s}{knowledge:>7s}{text}")


if __name__ == "__main__":
    main()
