"""Estimates of measured half-rounds and off-road ride courses, on which wheels leave the ground.

    python -m studies.severe_surfaces FOLDER

FOLDER holds `halfround_4in.crg` and `detrended_rms_course_2in.crg` of Project Chrono's data. Higher
surfaces are these with their heights multiplied. The vehicle is as described, in ride mode; both
wheel paths are the same. An estimate diverges if its greatest height, from its mean, is several
times the true one.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from estimators.estimation import estimate
from leaderboard.scoring import score
from road_envs.drives.recording import simulate_record
from road_envs.roads import load_road
from road_envs.roads.surface import Surface
from road_envs.vehicle.parameters import load_vehicle

ESTIMATORS = ("map_smoother", "kalman_lag", "tcn")
HALF_ROUND, COURSE = "halfround_4in.crg", "detrended_rms_course_2in.crg"
SURFACES = (
    ("half-round, 4 in", HALF_ROUND, 1.0, (20.0, 80.0), 30.0),
    ("half-round, 6 in", HALF_ROUND, 1.5, (20.0, 80.0), 30.0),
    ("course, 1 in RMS", COURSE, 0.5, (95.0, 155.0), 30.0),
    ("course, 2 in RMS", COURSE, 1.0, (95.0, 155.0), 20.0),
    ("course, 3 in RMS", COURSE, 1.5, (95.0, 155.0), 14.5),
    ("course, 4 in RMS", COURSE, 2.0, (95.0, 155.0), 10.0),
)
"""Name, file, factor of its heights, stations [m] that are driven, speed [km/h]."""


def load_part(path: Path, factor: float, stations: tuple[float, float]) -> Surface:
    """Return a part of a surface with its heights multiplied, level where it begins."""
    whole = load_road(path).realise(np.random.default_rng(0))
    first, last = np.searchsorted(whole.s, stations)
    z = factor * whole.z[:, first:last]
    return replace(whole, z=z - z[:, :1])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Errors on severe measured surfaces.")
    parser.add_argument("folder", type=Path)
    folder, car = parser.parse_args().folder, load_vehicle("land_rover_defender_110")
    print("in-band NRMSE, and the estimate's greatest height over the true one")
    print(f"{'surface':<18}{'km/h':>6}" + "".join(f"{name:>16}" for name in ESTIMATORS))
    for name, file, factor, stations, speed_kmh in SURFACES:
        surface = load_part(folder / file, factor, stations)
        record, truth = simulate_record(surface, speed_kmh=speed_kmh, mode="ride", seed=1)
        cells = []
        for estimator in ESTIMATORS:
            found = estimate(estimator, record, car)
            heights = [np.abs(z - z.mean(axis=1, keepdims=True)).max() for z in (found.z, truth.z)]
            cells.append(f"{score(found, truth)['nrmse']:.2f} ({heights[0] / heights[1]:.2f})")
        print(f"{name:<18}{speed_kmh:>6g}" + "".join(f"{x:>16}" for x in cells), flush=True)


if __name__ == "__main__":
    main()
