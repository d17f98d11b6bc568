"""Roughness and class of roads by spectra and by RMS, on drives that trained neither.

    python -m studies.roughness_alone RESULTS.jsonl [--drives N]

N drives over 200 m for each state of the struts and each grade, the described car (S0) and
individuals (S2), at 14.5 to 54 km/h; the level of a road is drawn over classes A to E, its waviness
from 1.6 to 2.4, and every fourth has potholes. The regression on RMS is trained, as by `road-recon
classify --method rms`, on 60 drives of individuals. The seeds are those of no task. The last lines
are N such drives on the plants of other projects, of four cars in turn, each told its description.
A row is appended to the results for each drive and method; those that stand there are not computed
again.
"""

from functools import cache
from itertools import product
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
from road_envs.roads import Iso8608, Potholes, Road, Superposed
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from studies.plants import CARS, told_vehicle
from studies.study import Row, run_study, study_parser

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


def draw_road(seed: int) -> Road:
    """Road of 200 m, of a level within classes A to E; every fourth has potholes."""
    rng = np.random.default_rng(seed)
    low, high = np.log([0.7 * CLASSES["A"], 2.0 * CLASSES["E"]])
    plain = Iso8608(G_d0=np.exp(rng.uniform(low, high)), w=rng.uniform(1.6, 2.4), length=LENGTH)
    return Superposed(roads=(plain, Potholes(length=LENGTH))) if seed % 4 == 3 else plain


@cache
def drive(state: str, grade: str, number: int) -> tuple[Record, Profile, VehicleParameters]:
    """Return record and truth of a drive, and the vehicle that the methods are told. The state is
    one of the struts, or a plant that drives one of the `studies.plants.CARS`.
    """
    seed = FIRST_SEED + number
    rng = np.random.default_rng([seed, 1])
    surface, speed_kmh = draw_road(seed).realise(rng), float(np.exp(rng.uniform(*np.log(SPEEDS))))
    if state in PLANTS:
        car = CARS[number % len(CARS)]
        driven = simulate_on_plant(state, surface, speed_kmh=speed_kmh, seed=seed, vehicle=car)
        return *driven, told_vehicle(state, car)
    driven = simulate_record(
        surface,
        speed_kmh=speed_kmh,
        vehicle=VEHICLE,
        mode=STATES[state],
        individual=seed,
        grade=grade,
        seed=seed,
    )
    return *driven, load_vehicle(VEHICLE)


@cache
def regression(state: str) -> RmsRoughness:
    """Regression on RMS of the drives of the training corpus in this state."""
    trained = drives_in_mode(Corpus(car=VEHICLE), STATES[state], SPEEDS, 60, "S2")
    return RmsRoughness.fit(*zip(*trained, strict=True))


def compute(state: str, grade: str, name: str, number: int) -> Row:
    """Return the error [dB] of the level of a drive, and whether class and interval are right."""
    record, truth, car = drive(state, grade, number)
    level = roughness_level(truth, float(np.nanmedian(record.v)))
    by_spectra = name == "spectra"
    found: Any = classify_record(record, car) if by_spectra else regression(state).predict(record)
    error = float(np.log(found.G_d0 / level))
    return {
        "error": DB * error,
        "same": bool(found.letter == roughness_class(level)),
        "inside": bool(abs(error) < ndtri(0.95) * found.log_std),
    }


def summary(rows: list[Row]) -> str:
    """Return median, RMS and worst error, shares in the class and inside 90 %, by method."""
    lines = [
        "",
        "state                           grade  by       median   RMS  worst  class  inside 90 %",
    ]
    keys = [(row["state"], row["grade"], row["name"]) for row in rows]
    for key in dict.fromkeys(keys):
        chosen = [row for row, own in zip(rows, keys, strict=True) if own == key]
        errors, same, inside = np.array([[r["error"], r["same"], r["inside"]] for r in chosen]).T
        rms, worst = np.sqrt(np.mean(errors**2)), errors[np.argmax(np.abs(errors))]
        state, grade, name = key
        state = f"passive, plant {state}" if state in PLANTS else state
        lines.append(
            f"{state:32s}{grade:7s}{name:8s}{np.median(np.abs(errors)):7.1f}{rms:6.1f}"
            f"{worst:+7.1f}{same.mean():7.0%}{inside.mean():13.0%}"
        )
    lines[0] = f"{len(chosen)} drives each                                 error of Gd(n0) [dB]"
    return "\n".join(lines)


def main() -> None:
    """Compute what is missing and print the table."""
    parser = study_parser("Roughness and class of roads by spectra and by RMS.")
    parser.add_argument("--drives", type=int, default=24)
    chosen = parser.parse_args()
    groups = [*product(STATES, GRADES, ("spectra", "RMS"))]
    groups += [(plant, "told", "spectra") for plant in sorted(PLANTS)]
    cases = [
        {"state": state, "grade": grade, "name": name, "number": number}
        for state, grade, name in groups
        for number in range(chosen.drives)
    ]
    run_study(chosen, cases, compute, summary, lambda rows, path: None)


if __name__ == "__main__":
    main()
