"""Error of estimators that are calibrated on one known road by one individual vehicle.

    python -m studies.no_vehicle_model [--vehicle NAME] [--seed N]

The vehicle is calibrated on 100 m and tested on other roads and at another speed:

| calibrated_fir | knows nothing else of the vehicle |
| window | the same 100 m, by a window over distance (`FirRidge.fit`) |
| fir_ridge, tcn | shipped weights, trained on the described Land Rover |
| +fir_ridge, +tcn | the same, corrected by the calibration drive |

The error of `calibrated_fir` is followed by the shares of errors [%] inside its 50 and 90 %
intervals.
"""

import argparse
from typing import Any

from estimators.api import CalibrationDrive, CalibrationError, Estimator
from estimators.linear.calibrated_fir import CalibratedFir
from estimators.linear.fir_ridge import FirRidge
from estimators.networks.sequence_estimator import Tcn
from leaderboard.scoring import score
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Profile, Record
from road_envs.roads import realise_road
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle

CALIBRATION = ("iso_d", 41)
"""Known road and its seed."""

TESTS = (("iso_d", 51), ("belgian_like", 52), ("potholes", 53))
LENGTH = 100.0  # [m]
OTHER_SPEED = 30.0  # [km/h]
SWITCHED: tuple[tuple[str, Any, float], ...] = (
    ("mixed", {"front": "ride", "rear": "handling"}, 54.0),
    ("ride", "ride", 14.5),
)


def calibrated(
    estimator: FirRidge | Tcn, drives: list[CalibrationDrive], car: VehicleParameters
) -> Estimator | None:
    """Return the estimator corrected by the drives, None if it refuses them."""
    try:
        return estimator.calibrate(drives, car)
    except CalibrationError:
        return None


def error_text(
    estimator: Estimator | None, record: Record, truth: Profile, car: VehicleParameters
) -> str:
    """Return the in-band error and the shares inside the intervals, as text."""
    if estimator is None:
        return "refused"
    scores = score(estimator.estimate(record, car), truth, speed_kmh=3.6 * float(record.v.mean()))
    shares = "/".join(f"{100.0 * scores[key]:.0f}" for key in ("coverage_50", "coverage_90"))
    return f"{scores['nrmse']:.3f} ({shares})"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Reconstruction without a vehicle model.")
    parser.add_argument("--vehicle", default="land_rover_defender_110")
    parser.add_argument("--seed", type=int, default=7, help="of the individual vehicle")
    chosen = parser.parse_args()
    car = load_vehicle(chosen.vehicle)
    conditions = SWITCHED
    if "ride" not in car.modes:
        (mode,) = car.modes
        conditions = ((mode, mode, 54.0), (mode, mode, 14.5))
    names = "".join(f"{name:>11s}" for name in ("window", "fir_ridge", "+fir_ridge", "tcn", "+tcn"))
    print(f"{'calibration; road, km/h':38s}{'calibrated_fir':>16s}{names}")
    for name, mode, speed in conditions:
        for grade in ("S0", "S3"):

            def drive(road: tuple[str, int], kmh: float) -> tuple[Record, Profile]:
                return simulate_record(
                    realise_road(road[0], road[1], LENGTH),
                    speed_kmh=kmh, mode=mode, seed=chosen.seed, vehicle=car, grade=grade,  # noqa: B023
                )  # fmt: skip

            record, truth = drive(CALIBRATION, speed)
            known = [CalibrationDrive(record, truth)]
            columns: list[Estimator | None] = [
                CalibratedFir().fit([record], [truth], car, 1),
                FirRidge(shipped=False).fit([record], [truth], car, 1),
            ]
            for each in (FirRidge(), Tcn()):
                columns += [each, calibrated(each, known, car)]
            for road, kmh in [*((test, speed) for test in TESTS), (TESTS[0], OTHER_SPEED)]:
                errors = [error_text(each, *drive(road, kmh), car) for each in columns]
                errors[1:] = [error.split()[0] for error in errors[1:]]
                what = f"{name} {speed:g} km/h {grade}, {road[0]}, {kmh:g}"
                others = "".join(f"{error:>11s}" for error in errors[1:])
                print(f"{what:38s}{errors[0]:>16s}{others}", flush=True)


if __name__ == "__main__":
    main()
