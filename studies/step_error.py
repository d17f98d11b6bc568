"""Error of the constant step by road, mode and speed, and while the struts switch.

    python -m studies.step_error

The error is the RMS difference of the three accelerations of the body from those of a step of 1/64
ms, relative to their RMS. Where the struts switch, they do so twice a second.
"""

import numpy as np

from road_envs.roads import load_road
from road_envs.simulation.drive import DriveSimulator
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import encode_command

ROADS = ("iso_d", "belgian", "bump_small", "bump_large_small")
SPEEDS_KMH = (14.5, 54.0)
MODES = ("ride", "handling", "switching")
STEPS = (1e-3, 5e-4, 2.5e-4)
REFERENCE_STEP = 1e-3 / 64
DURATION, HOLD = 6.0, 0.5
"""Longest drive, and time between two switches [s]."""


def accelerations(road: str, speed: float, mode: str, step: float) -> np.ndarray:
    """Return the accelerations (N, 3) of the body every millisecond, at a `speed` [m/s]."""
    car = load_vehicle("land_rover_defender_110")
    surface = load_road(road).realise(np.random.default_rng(1))
    first = "ride" if mode == "switching" else mode
    drive = DriveSimulator(build_plant(car), car, surface, speed, first, step)
    ratio = round(1e-3 / step)
    n = min(drive.steps_left, round(DURATION / step)) // ratio * ratio
    bytes_ = np.array([encode_command(first), encode_command("handling")], dtype=np.uint8)
    commands = bytes_[(np.arange(n) * step / HOLD).astype(int) % 2 * (mode == "switching")]
    return drive.advance(commands).acceleration[::ratio, :3]


def main() -> None:
    """Print the table."""
    heads = "".join(f"{1e3 * step:>10g} ms" for step in STEPS)
    print(f"{'road':<18}{'km/h':>6}  {'mode':<10}{heads}")
    for road in ROADS:
        for speed_kmh in SPEEDS_KMH:
            for mode in MODES:
                drive = road, speed_kmh / 3.6, mode
                exact = accelerations(*drive, REFERENCE_STEP)
                errors = []
                for step in STEPS:
                    found = accelerations(*drive, step)[: len(exact)]
                    difference = found - exact[: len(found)]
                    errors.append(np.sqrt(np.mean(difference**2) / np.mean(exact**2)))
                cells = "".join(f"{100 * error:>11.3g} %" for error in errors)
                print(f"{road:<18}{speed_kmh:>6g}  {mode:<10}{cells}")


if __name__ == "__main__":
    main()
