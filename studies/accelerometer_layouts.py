"""Error of the reconstruction over the number and the places of the accelerometers.

    python -m studies.accelerometer_layouts [--length M] [--roads N] [--part K]

For each layout, state and speed: the bound of linear estimation (`analysis.information_bound`), and
the NRMSE of two estimators with a vehicle model, pooled over the roads, which are of class D. All
accelerometers have the noise of the paper's; those on an axle have a range of 50 g.
"""

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from road_envs.analysis.information_bound import RoadPrior, bound
from road_envs.drives.recording import simulate_record
from road_envs.records.accelerometers import Accelerometer
from road_envs.sensing.instruments import Instruments, load_instruments
from road_envs.vehicle.parameters import load_vehicle
from studies.in_band_errors import in_band_errors

PAPER, HUBS = load_instruments("paper"), load_instruments("axle_ends")
FRONT_LEFT = Accelerometer(axle="front", ahead=-0.12, y=0.55)
LAYOUTS: dict[str, dict[str, Accelerometer]] = {
    "1 body, at the centre of mass": {"centre": Accelerometer(y=0.0)},
    "2 body, dashboard left and right": {
        "left": Accelerometer(axle="front", ahead=-0.9, y=0.5),
        "right": Accelerometer(axle="front", ahead=-0.9, y=-0.5),
    },
    "3 body, the paper's": PAPER.accelerometers,
    "4 body, over the wheels": {"LF": FRONT_LEFT, **PAPER.accelerometers},
    "2 on the front axle": {x: HUBS.accelerometers[x] for x in ("FL_hub", "FR_hub")},
    "4 on the axle ends": HUBS.accelerometers,
}
ESTIMATORS = ("wiener", "map_smoother")
CONDITIONS = [(v, mode) for v in (14.5, 54.0) for mode in ("ride", "handling")]


def errors(instruments: Instruments, v: float, mode: str, roads: int, length: float) -> list[float]:
    """Return the bound and the NRMSE of ESTIMATORS at `v` [km/h] on `roads` of `length` [m]."""
    car = load_vehicle("land_rover_defender_110")
    settings: dict[str, Any] = {"speed_kmh": v, "mode": mode, "length": length}
    drives = (
        simulate_record("iso_d", seed=seed, instruments=instruments, **settings)
        for seed in range(roads)
    )
    found = np.array([in_band_errors(ESTIMATORS, drive, car, speed_kmh=v) for drive in drives])
    floor = bound(car, mode, v / 3.6, instruments, RoadPrior()).pooled
    return [floor, *np.sqrt(np.mean(found**2, axis=0))]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--length", type=float, default=100.0)
    parser.add_argument("--roads", type=int, default=1)
    parser.add_argument("--part", type=int, choices=range(4), help="one of the four tables")
    chosen = parser.parse_args()
    console = Console(width=110)
    for v, mode in CONDITIONS if chosen.part is None else [CONDITIONS[chosen.part]]:
        table = Table("accelerometers", "bound", *ESTIMATORS, title=f"{mode}, {v} km/h", box=None)
        for name, layout in LAYOUTS.items():
            on_body = all(sensor.mounted == "body" for sensor in layout.values())
            instruments = replace(PAPER if on_body else HUBS, accelerometers=layout)
            row = errors(instruments, v, mode, chosen.roads, chosen.length)
            table.add_row(name, *(f"{x:.3f}" for x in row))
        console.print(table)
        console.print()


if __name__ == "__main__":
    main()
