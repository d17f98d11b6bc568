"""Roughness and class of roads by spectra and by RMS, on drives that trained neither.

    python -m studies.roughness_alone [--drives N]

N drives over 200 m for each state of the struts and each grade, the described car (S0) and
individuals (S2), at 14.5 to 54 km/h; the level of a road is drawn over classes A to E, its waviness
from 1.6 to 2.4, and every fourth has potholes. The regression on RMS is trained, as by `road-recon
classify --method rms`, on 60 drives of individuals. The seeds are those of no task. The last lines
are N such drives on the plants of other projects, of four cars in turn, each told its description.
"""

import argparse
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

import numpy as np
from scipy.special import ndtri

from estimators.roughness.rms_regression import RmsRoughness, roughness_level
from estimators.roughness.spectral import classify_record
from road_envs.drives.recording import simulate_record
from road_envs.drives.training_corpus import Corpus, drives_in_mode
from road_envs.plants.driving import PLANTS, simulate_on_plant
from road_envs.records.record import Profile, Record
from road_envs.records.roughness import CLASSES, roughness_class
from road_envs.roads import Iso8608, Potholes, Road, Superposed, Surface
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from studies.plants import CARS, told_vehicle

VEHICLE = "land_rover_defender_110"
STATES: dict[str, Any] = {
    "ride": "ride",
    "handling": "handling",
    "ride in front, handling behind": {"front": "ride", "rear": "handling"},
}
GRADES = ("S0", "S2")
SPEEDS = (14.5, 54.0)  # [km/h]
LENGTH, FIRST_SEED = 200.0, 1_140_000
DB = 10.0 / np.log(10.0)

Drive = tuple[Record, Profile, VehicleParameters]
"""Record, truth, and the vehicle that the methods are told."""


def draw_road(seed: int) -> Road:
    """Road of 200 m, of a level within classes A to E; every fourth has potholes."""
    rng = np.random.default_rng(seed)
    low, high = np.log([0.7 * CLASSES["A"], 2.0 * CLASSES["E"]])
    plain = Iso8608(G_d0=np.exp(rng.uniform(low, high)), w=rng.uniform(1.6, 2.4), length=LENGTH)
    return Superposed(roads=(plain, Potholes(length=LENGTH))) if seed % 4 == 3 else plain


def roads(number: int) -> Iterator[tuple[int, Surface, float]]:
    """Yield seed, surface and speed [km/h] of each drive."""
    for seed in range(FIRST_SEED, FIRST_SEED + number):
        rng = np.random.default_rng([seed, 1])
        yield seed, draw_road(seed).realise(rng), float(np.exp(rng.uniform(*np.log(SPEEDS))))


def drives(state: str, grade: str, number: int) -> Iterator[Drive]:
    """Yield the drives of a grade in one state of the struts."""
    for seed, surface, speed_kmh in roads(number):
        yield (
            *simulate_record(
                surface,
                speed_kmh=speed_kmh,
                vehicle=VEHICLE,
                mode=STATES[state],
                individual=seed,
                grade=grade,
                seed=seed,
            ),
            load_vehicle(VEHICLE),
        )


def drives_on_plant(plant: str, number: int) -> Iterator[Drive]:
    """Yield drives of the `studies.plants.CARS` in turn."""
    for k, (seed, surface, speed_kmh) in enumerate(roads(number)):
        car = CARS[k % len(CARS)]
        driven = simulate_on_plant(plant, surface, speed_kmh=speed_kmh, seed=seed, vehicle=car)
        yield *driven, told_vehicle(plant, car)


@cache
def regression(state: str) -> RmsRoughness:
    """Regression on RMS of the drives of the training corpus in this state."""
    trained = drives_in_mode(Corpus(car=VEHICLE), STATES[state], SPEEDS, 60, "S2")
    return RmsRoughness.fit(*zip(*trained, strict=True))


def print_rows(begin: str, driven: Iterable[Drive], by_rms: RmsRoughness | None) -> None:
    """Print a line for each method: by spectra, and by a regression on RMS if there is one."""
    found: dict[str, list[tuple[float, bool, bool]]] = {}
    for record, truth, car in driven:
        level = roughness_level(truth, float(np.nanmedian(record.v)))
        estimates: dict[str, Any] = {"spectra": classify_record(record, car)}
        if by_rms is not None:
            estimates["RMS"] = by_rms.predict(record)
        for method, estimate in estimates.items():
            error = float(np.log(estimate.G_d0 / level))
            inside = abs(error) < ndtri(0.95) * estimate.log_std
            same = estimate.letter == roughness_class(level)
            found.setdefault(method, []).append((DB * error, same, inside))
    for method, rows in found.items():
        errors, same, inside = np.array(rows).T
        rms, worst = np.sqrt(np.mean(errors**2)), errors[np.argmax(np.abs(errors))]
        print(
            f"{begin}{method:8s}{np.median(np.abs(errors)):7.1f}{rms:6.1f}"
            f"{worst:+7.1f}{same.mean():7.0%}{inside.mean():13.0%}",
            flush=True,
        )


def main() -> None:
    """Print median, RMS and worst error, shares in the class and inside 90 %, for each method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=24)
    number = parser.parse_args().drives
    print(f"{number} drives each                                 error of Gd(n0) [dB]")
    print("state                           grade  by       median   RMS  worst  class  inside 90 %")
    for state in STATES:
        for grade in GRADES:
            driven = drives(state, grade, number)
            print_rows(f"{state:32s}{grade:7s}", driven, regression(state))
    for plant in sorted(PLANTS):
        print_rows(
            f"{f'passive, plant {plant}':32s}{'told':7s}", drives_on_plant(plant, number), None
        )


if __name__ == "__main__":
    main()
