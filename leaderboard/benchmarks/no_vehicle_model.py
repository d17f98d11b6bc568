"""Error of `calibrated_fir` and of a window over distance, both fitted to one known stretch.

    python -m leaderboard.benchmarks.no_vehicle_model [--vehicle NAME] [--seed N]

One individual vehicle is calibrated on 100 m and tested on other roads and at another speed; each
error is followed by the share of errors [%] inside 50 and 90 % intervals.
"""

import argparse
from typing import Any

import numpy as np

from estimators.api import Estimator
from estimators.linear.calibrated_fir import CalibratedFir
from estimators.linear.fir_ridge import FirRidge
from leaderboard.metrics.heights import nrmse
from road_envs.analysis.roughness import band_pass
from road_envs.data.record import Profile, Record, scored_band
from road_envs.data.recording import simulate_record
from road_envs.roads import realise_road
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle

CALIBRATION = ("iso_d", 41)
"""Road and seed of the stretch that is known."""

TESTS = (("iso_d", 51), ("belgian_like", 52), ("potholes", 53))
LENGTH = 100.0  # [m]
OTHER_SPEED = 30.0  # [km/h]
SWITCHED: tuple[tuple[str, Any, float], ...] = (
    ("mixed", {"front": "ride", "rear": "handling"}, 54.0),
    ("ride", "ride", 14.5),
)


def judge(estimator: Estimator, record: Record, truth: Profile, car: VehicleParameters) -> str:
    """Return the in-band error and the shares inside the intervals, as text."""
    estimate, band = estimator.estimate(record, car), scored_band(float(record.v.mean()))
    text = f"{nrmse(truth.z, estimate.z, truth.ds, band).pooled:.3f}"
    if estimate.z_std is None:
        return text
    error = np.abs(band_pass(estimate.z - truth.z, truth.ds, band))
    cut = (truth.s.size - error.shape[1]) // 2
    std = estimate.z_std[:, cut : cut + error.shape[1]]
    shares = [100.0 * np.mean(error < bound * std) for bound in (0.6745, 1.6449)]
    return f"{text} ({shares[0]:.0f}/{shares[1]:.0f})"


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
    print(f"{'':34s}{'calibrated_fir':>18s}{'window':>8s}")
    for name, mode, speed in conditions:
        for grade in ("S0", "S3"):

            def drive(road: tuple[str, int], kmh: float) -> tuple[Record, Profile]:
                return simulate_record(
                    realise_road(road[0], road[1], LENGTH),
                    speed_kmh=kmh, mode=mode, seed=chosen.seed, vehicle=car, grade=grade,  # noqa: B023
                )  # fmt: skip

            record, truth = drive(CALIBRATION, speed)
            fitted = [
                each.fit([record], [truth], car, 1)
                for each in (CalibratedFir(), FirRidge(shipped=False))
            ]
            for road, kmh in [*((test, speed) for test in TESTS), (TESTS[0], OTHER_SPEED)]:
                errors = [judge(each, *drive(road, kmh), car) for each in fitted]
                what = f"{name} {speed:g} km/h {grade}, {road[0]}, {kmh:g}"
                print(f"{what:34s}{errors[0]:>18s}{errors[1]:>8s}", flush=True)


if __name__ == "__main__":
    main()
