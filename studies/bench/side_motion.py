"""Time of a vehicle with side motion over that of the same vehicle without, as measured by `bench`.

python -m studies.bench.side_motion
"""

from dataclasses import replace
from typing import Any

import numpy as np

from road_envs.roads import load_road, with_length
from road_envs.simulation.drive import DriveSimulator
from road_envs.simulation.rosenbrock import ACCELERATION
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.suspension import encode_command
from studies.bench.fleet import Fleet
from studies.bench.speed import FLEET_SIZE, benchmark_row, cpu_time

CAR, MODE, SPEED, STEPS = "bmw_320i", "passive", 15.0, 1000


def side_motion_cost() -> list[dict[str, Any]]:
    """Measure one vehicle and a fleet, each with side motion against without."""
    car = load_vehicle(CAR)
    one, many = (
        [time(one_car) for one_car in (car, replace(car, side=None))]
        for time in (_one_vehicle, _fleet)
    )
    return [
        benchmark_row(f"{what} with side motion, against without", f"{ratio:.2f} x the time",
            "<= 1.25 x", ratio, ratio=ratio)
        for what, ratio in (("one vehicle", one[0] / one[1]),
                            (f"{FLEET_SIZE} vehicles in a fleet", many[0] / many[1]))
    ]  # fmt: skip


def _new_drive(car: VehicleParameters) -> DriveSimulator:
    road = with_length(load_road("iso_d"), 400.0).realise(np.random.default_rng(1))
    return DriveSimulator(build_plant(car), car, road, SPEED, MODE, 0.001)


def _one_vehicle(car: VehicleParameters) -> float:
    commands = np.full(STEPS, encode_command(MODE), dtype=np.uint8)
    drives = iter([_new_drive(car) for _ in range(32)])
    return cpu_time(lambda: next(drives).advance(commands), 31)


def _fleet(car: VehicleParameters) -> float:
    commands = np.full((FLEET_SIZE, STEPS), encode_command(MODE), dtype=np.uint8)
    fleet = Fleet(
        [_new_drive(car) for _ in range(FLEET_SIZE)], 1, range(ACCELERATION, ACCELERATION + 7)
    )
    signals = fleet.allocate_signals(STEPS)
    return cpu_time(lambda: fleet.advance(commands, signals), 9)


if __name__ == "__main__":
    for row in side_motion_cost():
        print(f"{row['what']:<64}{row['measured']:>20}{row['aim']:>10}")
