"""Trial of what few sensors can tell: IRI of the road from one to four phones in a car.

Individuals of grade S2 of a saloon, off the description that the report has, drive over roads of
class A to C at 50 to 100 km/h. The IRI of each segment should lie in its 95 % interval in 85 to
99 % of them, whatever the sensors, and more of them should not be worse than one.

    python -m studies.few_sensors rows.jsonl [--fast]

A vehicle is fitted to three sensors or more, which takes most of the time, so that they have fewer
drives; with --fast none is fitted, and they alone are driven. A row of the file is a drive, so that
a trial that was stopped goes on where it ended.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.drive_report.conditions import load_conditions
from leaderboard.drive_report.report import ReportSettings, make_report
from road_envs.drives.logger_tables.description import PLACES
from road_envs.drives.reading import read_drive
from road_envs.drives.recording import simulate_record, write_record
from road_envs.records.accelerometers import Accelerometer
from road_envs.roads import realise_road
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle
from studies.phone_reports import compare, road

VEHICLE, FIRST_SEED = "bmw_320i", 801
"""Described vehicle, and the seed of the first drive; no drive of these seeds decided anything."""

DRIVES = (("A", 50), ("A", 100), ("B", 70), ("B", 100), ("C", 50), ("C", 70))
"""Road classes and speeds [km/h] of the drives of each layout."""

LEFT, RIGHT = 0.55, -0.55
LAYOUTS = {
    "one": {"PHONE": PLACES["dashboard"]},
    "two, centre line": {"FRONT": PLACES["dashboard"], "REAR": PLACES["trunk"]},
    "two, both sides": {
        "FL": Accelerometer(axle="front", ahead=-0.12, y=LEFT),
        "FR": Accelerometer(axle="front", ahead=-0.12, y=RIGHT),
    },
    "three": load_instruments("phone").accelerometers,
    "four": {
        "FL": Accelerometer(axle="front", ahead=-0.12, y=LEFT),
        "FR": Accelerometer(axle="front", ahead=-0.12, y=RIGHT),
        "RL": Accelerometer(axle="rear", ahead=-0.62, y=LEFT),
        "RR": Accelerometer(axle="rear", ahead=-0.62, y=RIGHT),
    },
}
"""Accelerometers by the words of the table."""

FITTED = ("three", "four")
"""Layouts to which a vehicle is fitted."""


def run_case(case: tuple[str, int, bool]) -> dict[str, Any]:
    """Simulate the drive of a layout and a seed, report it, and return the errors of the report."""
    name, seed, fast = case
    letter, speed = DRIVES[(seed - FIRST_SEED) % len(DRIVES)]
    surface = realise_road(road(letter, seed), seed)
    phones = replace(load_instruments("phone"), accelerometers=LAYOUTS[name])
    record, _ = simulate_record(
        surface, speed_kmh=speed, vehicle=VEHICLE, instruments=phones, grade="S2", seed=seed
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.parquet"
        write_record(path, record, {}, load_vehicle(VEHICLE).modes)
        drive = read_drive(path, vehicle=VEHICLE)._replace(sensors="phone")
    chosen = ReportSettings(conditions=load_conditions("hpms"), settings={}, fast=fast)
    began = time.process_time()
    (result,) = make_report([drive], chosen, lambda *_: None).drives
    seconds = time.process_time() - began
    rough = any("treat IRI and heights as rough" in note for note in result.notes)
    found = {name: np.asarray(x).tolist() for name, x in compare(result, surface, seed).items()}
    return {"case": case, "seconds": seconds, "rough": rough, **found}


def run_cases(cases: Sequence[tuple[str, int, bool]], path: Path) -> list[dict[str, Any]]:
    """Return the rows of `cases`; those that the file at `path` lacks are computed and appended."""
    kept = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    rows = {tuple(row["case"]): row for row in map(json.loads, kept)}
    missing = [case for case in cases if case not in rows]
    with path.open("a", encoding="utf-8") as file, ProcessPoolExecutor() as pool:
        for row in pool.map(run_case, missing):
            print(json.dumps(row), file=file, flush=True)
            rows[row["case"]] = row
    return [rows[case] for case in cases]


def main() -> None:
    """Print for each layout how IRI and interval agree with the roads that were driven."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path, help="one line of JSON for each drive")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--drives", type=int, default=len(DRIVES), help="of one and two sensors")
    parser.add_argument("--fits", type=int, default=len(DRIVES), help="drives of three and four")
    parser.add_argument("--fast", action="store_true", help="fit no vehicle to the drives")
    options = parser.parse_args()
    names = FITTED if options.fast else LAYOUTS
    cases = [
        (name, options.first_seed + k, options.fast)
        for name in names
        for k in range(options.fits if name in FITTED else options.drives)
    ]
    print(
        f"{'sensors':18s} drives segments   bias   RMSE  worst  within 15 %  inside 95 %  "
        "width (log)  rough  CPU-s per km"
    )
    found, worse = run_cases(cases, options.results), list[str]()
    for name in names:
        rows = [row for row in found if row["case"][0] == name]
        error, inside, width = (
            np.concatenate([row[key] for row in rows]) for key in ("iri", "inside", "width")
        )
        cost = 1e3 * sum(row["seconds"] for row in rows) / sum(row["length"] for row in rows)
        print(
            f"{name:18s} {len(rows):6d} {error.size:8d} {error.mean():+6.1%} {_rms(error):6.1%} "
            f"{error[np.argmax(np.abs(error))]:+6.0%} {np.mean(np.abs(error) < 0.15):12.0%} "
            f"{inside.mean():12.0%} {np.nanmedian(width):12.2f} "
            f"{sum(row['rough'] for row in rows):6d} {cost:13.0f}"
        )
        seeds = {row["case"][1] for row in rows}
        alone = [row["iri"] for row in found if row["case"][0] == "one" and row["case"][1] in seeds]
        if alone and _rms(error) > _rms(np.concatenate(alone)):
            worse.append(name)
    if not options.fast:
        print(f"worse than one sensor over the same roads by RMSE: {'; '.join(worse) or 'none'}")


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


if __name__ == "__main__":
    main()
