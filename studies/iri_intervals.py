"""IRI of segments with its interval of 95 %, from samples of the estimated road, class by class.

    python -m studies.iri_intervals [--drives N] [--seed SEED]

Each drive of 200 m at 54 km/h over another road gives two segments of 100 m with an IRI of either
wheel path and of their mean. "own": `map_smoother` knows the vehicle. "described": the vehicle is
one of grade S1 and departs from its description within the tolerances. "paper": three sensors of
1 kHz, "phone": those of phones. "profile" is the bias of the IRI of the estimate itself, without
the waves that were not resolved.
"""

import argparse

import numpy as np

from estimators.map_smoother.estimator import MapSmoother
from leaderboard.drive_report.posterior_iri import posterior_iri
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Estimate
from road_envs.roads import realise_road
from road_envs.sensing.data_logger import load_instruments
from road_envs.sensing.perturbed_vehicle import perturb_vehicle
from road_envs.vehicle.parameters import load_vehicle

MIXED = {"front": "ride", "rear": "handling"}
SPEED, LENGTH = 54.0, 200.0
EDGES = np.array([0.0, 100.0, 200.0])
CASES = (("paper", "own"), ("paper", "described"), ("phone", "own"))
HEAD = ("class", "sensors", "vehicle", "segments", "profile", "bias", "RMSE", "width", "inside")


def ratios(road_class: str, sensors: str, knows: str, seed: int) -> np.ndarray:
    """IRI of the profile, low, median and high over the true one (4, 3, 2) of a drive."""
    car, road = load_vehicle("land_rover_defender_110"), realise_road(road_class, seed, LENGTH)
    record, truth = simulate_record(
        road, speed_kmh=SPEED, mode=MIXED, seed=seed, grade="S1",
        instruments=load_instruments(sensors),
    )  # fmt: skip
    vehicle = perturb_vehicle(car, "S1", seed).car if knows == "own" else car
    smoother = MapSmoother(instruments=sensors, adapt=knows != "own")
    found = smoother.estimate(record, vehicle)
    true = posterior_iri(Estimate(truth.s, truth.z), EDGES).median
    plain = posterior_iri(Estimate(found.s, found.z), EDGES).median
    return np.array([plain, *posterior_iri(found, EDGES)]) / true


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Intervals of the IRI.")
    parser.add_argument("--drives", type=int, default=3)
    parser.add_argument("--seed", type=int, default=9730)
    chosen = parser.parse_args()
    print("IRI over the true one in percent; width: half an interval of 95 %; inside: share of IRI")
    print(("{:<7}{:<9}{:<11}" + "{:>10}" * 6).format(*HEAD))
    for sensors, knows in CASES:
        for road in ("iso_a", "iso_b", "iso_c", "iso_d"):
            seeds = range(chosen.seed, chosen.seed + chosen.drives)
            found = np.array([ratios(road, sensors, knows, seed) for seed in seeds])
            plain, low, middle, high = found.transpose(1, 0, 2, 3)
            inside = np.mean((low <= 1.0) & (high >= 1.0))
            numbers = (
                plain.mean() - 1.0, middle.mean() - 1.0, np.sqrt(np.mean((middle - 1.0) ** 2)),
                np.mean(0.5 * np.log(high / low)), inside,
            )  # fmt: skip
            cells = "".join(f"{100.0 * x:>10.1f}" for x in numbers)
            print(f"{road[-1].upper():<7}{sensors:<9}{knows:<11}{middle[:, 0].size:>10}{cells}",
                  flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
