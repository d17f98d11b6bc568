"""Turns, stops and hard braking: errors, intervals, and the share of the road that is marked.

    python -m studies.manoeuvres RESULTS.jsonl

The described Land Rover, as it is, drives over roads of classes B to D, and turns, changes the lane
or stops, which no estimator is told. A row is appended to the results for each drive and estimator;
those that stand there are not computed again.
"""

from typing import Any

import numpy as np

from estimators.estimation import estimate
from leaderboard.scoring import score
from road_envs.drives.recording import true_profile
from road_envs.records.record import Profile, Record
from road_envs.roads import realise_road
from road_envs.sensing.data_logger import DataLogger
from road_envs.sensing.instruments import load_instruments
from road_envs.simulation.drive import DriveSimulator
from road_envs.simulation.manoeuvres import LaneChange, Manoeuvre, SteadyTurn
from road_envs.simulation.speed import SpeedProfile
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.parameters import DEFAULT_STEP, GRAVITY, load_vehicle
from road_envs.vehicle.suspension import decode_commands, encode_command
from studies.study import Row, run_study, study_parser

COMPARED = ("map_smoother", "kalman_lag", "wiener")
MIXED = {"front": "ride", "rear": "handling"}
SEED, LENGTH, SHORTEST = 9060, 150.0, 8.0


def _turn(g: float, hold: float) -> SteadyTurn:
    return SteadyTurn(a_y=g * GRAVITY, begin=4.0, hold=hold)


def _stops(v: float, count: int) -> SpeedProfile:
    """Return a drive at `v` [m/s] with `count` stops of 3 s, at 2 m/s² each way."""
    parts = [(1.0, v), (0.5 * v, 0.0), (3.0, 0.0), (0.5 * v, v)] * count
    times, speeds = np.cumsum([part for part, _ in parts]).tolist(), [v for _, v in parts]
    return SpeedProfile(t=(0.0, *times), v=(v, *speeds))


DRIVES: dict[str, tuple[str, float, Any, Manoeuvre | SpeedProfile | None]] = {
    "straight, C, 36 km/h, ride": ("iso_c", 36.0, "ride", None),
    "curve of 0.2 g, C, 36 km/h, ride": ("iso_c", 36.0, "ride", _turn(0.2, 3.0)),
    "curve of 0.2 g, C, 36 km/h, handling": ("iso_c", 36.0, "handling", _turn(0.2, 3.0)),
    "curve of 0.3 g, B, 54 km/h, ride": ("iso_b", 54.0, "ride", _turn(0.3, 3.0)),
    "curve of 0.2 g, D, 36 km/h, ride": ("iso_d", 36.0, "ride", _turn(0.2, 3.0)),
    "lane of 1 m, B, 54 km/h, ride": ("iso_b", 54.0, "ride", LaneChange(v=15.0, offset=1.0)),
    "lane of 1 m, C, 54 km/h, mixed": ("iso_c", 54.0, MIXED, LaneChange(v=15.0, offset=1.0)),
    "ISO 3888-1, C, 54 km/h, handling": ("iso_c", 54.0, "handling", LaneChange(v=15.0)),
    "five stops, C, 36 km/h, ride": ("iso_c", 36.0, "ride", _stops(10.0, 5)),
}
"""Road, speed [km/h], mode, and manoeuvre or speed of each drive."""


def drive(name: str) -> tuple[Record, Profile]:
    """Return the record of a drive, and the true profile. It lasts SHORTEST [s] at least."""
    road, kmh, mode, manoeuvre = DRIVES[name]
    car, instruments = load_vehicle("land_rover_defender_110"), load_instruments("paper")
    speed = manoeuvre if isinstance(manoeuvre, SpeedProfile) else kmh / 3.6
    turn = None if isinstance(manoeuvre, SpeedProfile) else manoeuvre
    surface = realise_road(road, SEED, max(LENGTH, SHORTEST * kmh / 3.6))
    plant = build_plant(car, manoeuvres=manoeuvre is not None)
    simulator = DriveSimulator(plant, car, surface, speed, mode, DEFAULT_STEP, turn)
    byte = encode_command(mode, car)
    motion = simulator.advance(np.full(simulator.steps_left, byte, dtype=np.uint8))
    logger = DataLogger(instruments, car, DEFAULT_STEP, np.random.default_rng(SEED))
    a = np.concatenate([logger.sample(motion), logger.flush()], axis=1)
    t = np.arange(a.shape[1]) / instruments.fs
    distance, v, _ = simulator.speed_profile.at(t)
    s = simulator.start + logger.odometer(distance)
    states = decode_commands(np.full(t.size, byte))
    record = Record(t, a, v, s, *states, surface.length, instruments.layout)
    return record, true_profile(surface)


def compute(case: str, name: str) -> Row:
    """Return error, share of the errors inside 90 %, and share of the road that is marked."""
    record, truth = drive(case)
    found = estimate(name, record)
    scores = score(found, truth, speed_kmh=DRIVES[case][1])
    marked = 0.0 if found.unsure is None else float(found.unsure.mean())
    return {
        "error": scores["nrmse"],
        "inside": scores["coverage_90"],
        "marked": marked,
    }


def summary(rows: list[Row]) -> str:
    """Return a table, a row for each drive."""
    found = {(row["case"], row["name"]): row for row in rows}
    lines = [
        "in-band NRMSE, share of the errors inside the intervals of 90 % and of the road that is",
        "marked as not known, in percent",
        f"{'':<38}" + "".join(f"{name:>20}" for name in COMPARED),
    ]
    for case in DRIVES:
        cells = [
            f"{row['error']:.2f} {100 * row['inside']:>3.0f} {100 * row['marked']:>3.0f}"
            for row in (found[case, name] for name in COMPARED)
        ]
        lines.append(f"{case:<38}" + "".join(f"{cell:>20}" for cell in cells))
    return "\n".join(lines)


def main() -> None:
    """Compute what is missing and print the table."""
    chosen = study_parser("Turns and stops.").parse_args()
    cases = [{"case": case, "name": name} for case in DRIVES for name in COMPARED]
    run_study(chosen, cases, compute, summary, lambda rows, path: None)


if __name__ == "__main__":
    main()
