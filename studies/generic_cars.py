"""IRI before and after `identify` from two ordinary drives, of cars whose make nobody knows.

    python -m studies.generic_cars RESULTS.jsonl [--plot FILE] [--seed SEED]

Each car is described as its owner can: a class with the mass, wheelbase and track of the papers
(`road-recon new-vehicle`). It drives 500 m of class B at 50 km/h and 500 m of class C at 40 km/h,
which nobody measured, and from them `road-recon identify` narrows the description. Then it drives
100 m of each class at 50 km/h, and `map_smoother` has the IRI with the class and with the
identified car, by its samples of the road as in a report. The cars are those of another project's
program, and on our own simulator individuals that are drawn within the tolerances of their class
and then manufactured (grade S1). A row is appended to the results for each drive; those that stand
there are not computed again.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from estimators.api import CalibrationDrive, CalibrationError
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.identification import identify
from estimators.map_smoother.preparation import SolverSettings
from leaderboard.drive_report.posterior_iri import posterior_iri
from road_envs.drives.recording import simulate_record
from road_envs.plants.driving import simulate_on_plant
from road_envs.records.record import Profile, Record
from road_envs.records.roughness import iri
from road_envs.vehicle import generic_cars
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.tolerances import parameter_space
from studies.iri_after_calibration import draw
from studies.study import Row, run_study, study_parser

CARS = (
    ("mujoco", "bmw_320i", "saloon"),
    ("mujoco", "volkswagen_vanagon", "van"),
    ("mujoco", "jeep_cherokee", "suv"),
    ("commonroad", "bmw_320i", "saloon"),
    *(("simulator", name, name) for name in generic_cars.CLASSES),
)
"""Plant, car, and the class by which it is described."""

CALIBRATION = (("iso_b", 50.0), ("iso_c", 40.0))
"""Roads and speeds [km/h] of the drives before."""

CLASSES, SPEED_KMH = ("A", "B", "C"), 50.0
CALIBRATION_LENGTH, LENGTH = 500.0, 100.0

FIRST_SEED = 27_600
"""Nothing was developed with the seeds from this one on."""


def owners_description(car: VehicleParameters, car_class: str) -> VehicleParameters:
    """Return the vehicle that `new-vehicle` makes of class, mass, wheelbase and track of a car."""
    mass, track = car.m_b + car.front.m + car.rear.m, car.front.y_t + car.rear.y_t
    return generic_cars.fitted_vehicle(car_class, car_class, mass, car.wheelbase, track)


def true_car(plant: str, car: str, seed: int) -> VehicleParameters:
    """Return the car of a plant, or an individual of a class within its tolerances."""
    described = load_vehicle(car)
    if plant != "simulator":
        return described
    return parameter_space(described).draw(np.random.default_rng(seed))


def drive(
    plant: str, car: VehicleParameters, road: str, speed_kmh: float, length: float, seeds: list[int]
) -> tuple[Record, Profile]:
    """Drive a car over a road; `seeds` are those of the road and of the individual."""
    settings: dict[str, Any] = {
        "speed_kmh": speed_kmh,
        "seed": seeds[0],
        "vehicle": car,
        "length": length,
    }
    if plant != "simulator":
        return simulate_on_plant(plant, road, **settings)
    return simulate_record(road, **settings, grade="S1", individual=seeds[1])


@cache
def described_and_identified(
    plant: str, car: str, car_class: str, seed: int
) -> tuple[VehicleParameters, VehicleParameters]:
    """Return the car as its owner describes it and as it was identified, twice the first if that
    was refused.
    """
    true = true_car(plant, car, seed)
    described = owners_description(true, car_class)
    records = [
        drive(plant, true, road, speed, CALIBRATION_LENGTH, [seed + k, seed])[0]
        for k, (road, speed) in enumerate(CALIBRATION)
    ]
    try:
        return described, identify(
            [CalibrationDrive(record) for record in records], described, SolverSettings()
        ).car
    except CalibrationError:
        return described, described


def reported(record: Record, car: VehicleParameters) -> tuple[list[float], list[str]]:
    """Return the IRI [mm/m] of a drive with its limits of 95 %, and the notes of the estimate."""
    found = MapSmoother().estimate(record, car)
    limits = posterior_iri(found, np.array([0.0, LENGTH]))
    values = (limits.median, limits.low, limits.high)
    return [round(float(of_mean[-1, 0]), 4) for of_mean in values], list(found.notes)


def drive_result(plant: str, car: str, car_class: str, road_class: str, seed: int) -> Row:
    """Return `iri` (2, 1), true and reported with the identified car; what a report says before
    and after the identification, its notes after, and whether the identification was refused.
    """
    described, identified = described_and_identified(plant, car, car_class, seed)
    at = seed + len(CALIBRATION) + CLASSES.index(road_class)
    road = f"iso_{road_class.lower()}"
    record, truth = drive(plant, true_car(plant, car, seed), road, SPEED_KMH, LENGTH, [at, seed])
    before, _ = reported(record, described)
    after, notes = reported(record, identified)
    true = round(float(np.mean([iri(z, truth.ds) for z in truth.z])), 4)
    return {
        "iri": [[true], [after[0]]],
        "before": before,
        "after": after,
        "notes": notes,
        "refused": identified is described,
    }


def summary(rows: Sequence[Row]) -> str:
    """Return each drive, and bias, RMSE and coverage on the plants and on the simulator."""
    head = f"{'IRI mm/m':>10}{'before':>9}{'in 95 %':>9}{'after':>9}{'in 95 %':>9}{'notes':>7}"
    lines = [
        "error of the IRI before and after the identification",
        f"{'plant, car':<34}class{head}",
    ]
    for row in rows:
        (true,), _ = row["iri"]
        cells = "".join(f"{x[0] / true - 1.0:>+9.1%}{_holds(x, true):>9}" for x in _found(row))
        name = f"{row['plant']:<12}{row['car']:<22}{row['road_class']:<5}"
        refused = "  refused" if row["refused"] else ""
        lines.append(f"{name}{true:>10.2f}{cells}{len(row['notes']):>7}{refused}")
    lines.append(
        f"\n{'':<14}{'drives':>7}"
        + "".join(
            f"{f'{what}, {when}':>17}"
            for when in ("before", "after")
            for what in ("bias", "RMSE", "in 95 %")
        )
    )
    for name, is_ours in (("plants", False), ("simulator", True)):
        chosen = [row for row in rows if (row["plant"] == "simulator") == is_ours]
        if not chosen:
            continue
        true = np.array([row["iri"][0][0] for row in chosen])
        cells = ""
        for k in range(2):
            found = np.array([_found(row)[k] for row in chosen])
            error = found[:, 0] / true - 1.0
            inside = np.mean((found[:, 1] <= true) & (true <= found[:, 2]))
            cells += f"{error.mean():>+17.1%}{np.sqrt(np.mean(error**2)):>17.1%}{inside:>17.0%}"
        lines.append(f"{name:<14}{len(chosen):>7}{cells}")
    return "\n".join(lines)


def _found(row: Row) -> tuple[list[float], list[float]]:
    return row["before"], row["after"]


def _holds(found: list[float], true: float) -> str:
    return "yes" if found[1] <= true <= found[2] else "no"


def main() -> None:
    """Run the study."""
    parser = study_parser("IRI by cars of generic description, before and after identification.")
    parser.add_argument("--seed", type=int, default=FIRST_SEED)
    chosen = parser.parse_args()
    cases = [
        dict(zip(("plant", "car", "car_class"), car, strict=True))
        | {"road_class": name, "seed": chosen.seed + 10 * k}
        for k, car in enumerate(CARS)
        for name in CLASSES
    ]
    run_study(chosen, cases, drive_result, summary, draw)


if __name__ == "__main__":
    main()
