"""In-band NRMSE of estimators with a vehicle model, and its bound, on vehicles of four makes.

    python -m studies.vehicles [--roads iso_c,belgian_like] [--seeds N]

Each vehicle drives over the same roads of 100 m at 36 km/h in its first mode, with the paper's
instruments. The bound is that of the linear vehicle without friction, and with friction as noise.
"""

import argparse
from typing import Any

import numpy as np

from road_envs.analysis.information_bound import RoadPrior, bound, equivalent_damping
from road_envs.drives.recording import simulate_record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from studies.in_band_errors import in_band_errors

CARS = ("bmw_320i", "jeep_cherokee", "land_rover_defender_110", "volkswagen_vanagon")
ESTIMATORS = ("map_smoother", "kalman_rts", "iterated_wiener", "wiener")
SPEED_KMH, LENGTH = 36.0, 100.0


def errors(car: VehicleParameters, road: str, seeds: range) -> dict[str, float]:
    """Return the median NRMSE [-] over seeds of each estimator on a road."""
    settings: dict[str, Any] = {"speed_kmh": SPEED_KMH, "vehicle": car, "length": LENGTH}
    drives = (simulate_record(road, seed=seed, **settings) for seed in seeds)
    medians = np.median([in_band_errors(ESTIMATORS, drive, car) for drive in drives], axis=0)
    return dict(zip(ESTIMATORS, medians.tolist(), strict=True))


def bounds(car: VehicleParameters) -> tuple[float, float]:
    """Return the bound on a class-C road without friction, and with friction as noise."""
    prior = RoadPrior(G_d0=256e-6, track=2.0 * car.front.y_t)
    v, mode = SPEED_KMH / 3.6, next(iter(car.modes))
    shared: dict[str, Any] = {"damping": equivalent_damping(car, mode, v, prior)}
    instruments = load_instruments("paper")
    linear, friction_as_noise = (
        bound(car, mode, v, instruments, prior, residual_as_noise=noise, **shared).pooled
        for noise in (False, True)
    )
    return linear, friction_as_noise


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Errors on vehicles of four makes.")
    parser.add_argument("--roads", default="iso_c,belgian_like")
    parser.add_argument("--seeds", type=int, default=1)
    chosen = parser.parse_args()
    print(f"{'vehicle':<24}{'road':<14}" + "".join(f"{name:>16}" for name in ESTIMATORS))
    for name in CARS:
        car = load_vehicle(name)
        for road in chosen.roads.split(","):
            row = errors(car, road, range(1, chosen.seeds + 1))
            print(
                f"{name:<24}{road:<14}" + "".join(f"{row[e]:16.3f}" for e in ESTIMATORS), flush=True
            )
        linear, with_friction = bounds(car)
        print(
            f"{name:<24}bound on class C {linear:.3f}, with friction as noise {with_friction:.3f}"
        )


if __name__ == "__main__":
    main()
