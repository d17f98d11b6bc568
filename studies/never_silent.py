"""Errors and intervals of drives of vehicles that depart from their description, road by road.

    python -m studies.never_silent [--individuals N] [--seed SEED]

Each vehicle is one of grade S1: its parameters depart within the tolerances of the description,
and its instruments are sound. `map_smoother` gets the description alone ("described"), and the
vehicle's own parameters ("own"), which gives the error that is attainable. A cell holds the median
of N drives of 100 m, each over another road with another vehicle.
"""

import argparse
from statistics import median

from estimators.estimation import estimate
from estimators.map_smoother.estimator import MapSmoother
from leaderboard.api import score
from road_envs.drives.recording import simulate_record
from road_envs.sensing.perturbed_vehicle import perturb_vehicle
from road_envs.vehicle.parameters import load_vehicle

MIXED = {"front": "ride", "rear": "handling"}
ROADS = ("iso_b", "iso_c", "iso_d", "belgian_like")
CONDITIONS: tuple[tuple[float, str | dict[str, str]], ...] = (
    (14.5, "ride"),
    (36.0, MIXED),
    (54.0, MIXED),
)
LENGTH = 100.0
HEAD = ("road", "km/h", "own", "described", "ratio", "worst", "in 50 %", "in 90 %", "noted")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Errors and intervals under the description.")
    parser.add_argument("--individuals", type=int, default=3)
    parser.add_argument("--seed", type=int, default=9100)
    chosen, car = parser.parse_args(), load_vehicle("land_rover_defender_110")
    print("in-band NRMSE of map_smoother, medians; share of errors in its intervals")
    print(("{:<13}" + "{:>10}" * 8).format(*HEAD))
    for road in ROADS:
        for k, (kmh, mode) in enumerate(CONDITIONS):
            rows, noted = list[list[float]](), 0
            for i in range(chosen.individuals):
                seed = chosen.seed + 100 * k + i
                record, truth = simulate_record(
                    road, speed_kmh=kmh, mode=mode, seed=seed, grade="S1", length=LENGTH
                )
                described = estimate("map_smoother", record, car)
                vehicle = perturb_vehicle(car, "S1", seed).car
                own = MapSmoother(adapt=False).estimate(record, vehicle)
                names = ("nrmse", "coverage_50", "coverage_90")
                scores = score(described, truth, speed_kmh=kmh)
                attainable = score(own, truth, speed_kmh=kmh)["nrmse"]
                rows.append([attainable, *(scores[name] for name in names)])
                noted += any("vehicle" in note for note in described.notes)
            own_error, error, half, most = (median(row[j] for row in rows) for j in range(4))
            worst = max(row[1] for row in rows)
            print(
                f"{road:<13}{kmh:>10g}{own_error:>10.3f}{error:>10.3f}{error / own_error:>10.2f}"
                f"{worst:>10.3f}{100 * half:>10.0f}{100 * most:>10.0f}"
                f"{noted:>7} of {len(rows)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
