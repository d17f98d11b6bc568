"""The drives of foreign plants that the board `plants` keeps.

    python -m studies.plant_records [--again]

Drives that are kept are not driven again without `--again`. Needs the extra `plants`.
"""

import argparse
import dataclasses

import numpy as np

from leaderboard.evaluation.kept_drives import kept_path
from leaderboard.evaluation.tasks import Condition, load_task
from road_envs.core import config
from road_envs.drives.recording import write_record
from road_envs.plants.driving import simulate_on_plant
from road_envs.roads import Road

TASKS = ("plants_told", "plants_known", "plants_blind")
PLACES = 4
"""Decimal places [m/s²] of the accelerations, a hundredth of the noise: they make files small."""


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
        if path.exists() and not again:
            continue
        record, _ = simulate_on_plant(
            plant, surface, speed_kmh=speed, seed=seed, vehicle=car, instruments=instruments
        )
        record = dataclasses.replace(record, a=np.round(record.a, PLACES))
        about = {"plant": plant, "vehicle": car, "road": surface.name, "seed": seed}
        write_record(path, record, about | {"speed_kmh": speed, "instruments": instruments})
        print(path.name, flush=True)


if __name__ == "__main__":
    main()
