"""The drives of foreign plants that the board `plants` keeps.

    python -m studies.plant_records [--again]

Drives that are kept, with the road, vehicle and instruments of today, are not driven again without
`--again`. Needs the extra `plants`.
"""

import argparse
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from leaderboard.evaluation.tasks import Condition, load_task
from leaderboard.kept_drives import facts, kept_path, kept_record
from road_envs.core import config
from road_envs.drives.recording import write_record
from road_envs.plants.driving import simulate_on_plant
from road_envs.roads import Road
from road_envs.sensing.instruments import load_instruments

TASKS = ("plants_told", "plants_known", "plants_blind")
PLACES = 2
"""Decimal places [m/s²] of the accelerations: their rounding is a thirtieth of the noise."""


def needed() -> set[tuple[Condition, Road, float, int, str]]:
    """Return plant and car, road, speed [km/h], seed and instruments of all drives."""
    drives = set()
    for task in map(load_task, TASKS):
        for condition in task.conditions:
            for _, road, seed in task.drives_of(task.test, condition):
                drives.add((condition, road, condition.speed_kmh, seed, task.instruments))
                for run in task.calibration:
                    at = seed + run.seed_offset
                    drives.add((condition, run.driven_road, run.speed_kmh, at, task.instruments))
    return drives


def main() -> None:
    """Drive what is missing."""
    parser = argparse.ArgumentParser(description="Kept drives of foreign plants.")
    parser.add_argument("--again", action="store_true")
    again = parser.parse_args().again
    (config.folder() / "plants").mkdir(exist_ok=True)
    for condition, road, speed, seed, instruments in sorted(needed(), key=repr):
        plant, car = condition.plant, condition.car
        assert plant is not None
        assert car is not None
        surface = road.realise(np.random.default_rng(seed))
        path = kept_path(plant, car, surface.name, speed, seed)
        known = facts(surface, car, load_instruments(instruments))
        if kept_record(path, surface, known) is not None and not again:
            continue
        record, _ = simulate_on_plant(
            plant, surface, speed_kmh=speed, seed=seed, vehicle=car, instruments=instruments
        )
        about = {"plant": plant, "vehicle": car, "road": surface.name, "seed": seed}
        about |= {"speed_kmh": speed, **known}
        write_record(path, record, about)
        pack(path)
        print(path.name, flush=True)


def pack(path: Path) -> None:
    """Round the accelerations of a record, and write it as small as Parquet can."""
    table = pq.read_table(path)
    for i, name in enumerate(table.column_names):
        if name.startswith("a_"):
            rounded = np.round(table[name].to_numpy(), PLACES)
            table = table.set_column(i, name, pa.array(rounded))
    coded = [name for name in table.column_names if name.startswith("a_")]
    split = dict.fromkeys(("t", "v", "s"), "BYTE_STREAM_SPLIT")
    settings = {"use_dictionary": coded, "column_encoding": split}
    pq.write_table(table, path, compression="zstd", compression_level=19, **settings)


if __name__ == "__main__":
    main()
