"""Scores of the board of foreign plants by plant and car, from the long table of a board.

    python -m studies.plants_by_car BOARD/export/plants.parquet [--estimator NAME]

A row holds the medians of the drives of a division, a plant and a car, or of all cars. `own` is the
error of `map_smoother` where our own simulator drives the told car over the same roads with the
same instruments, and the estimator knows it: what the readings tell.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from estimators.map_smoother.estimator import MapSmoother
from leaderboard.evaluation.tasks import load_task
from leaderboard.scoring import score
from road_envs.drives.recording import simulate_record

SCORES = ("nrmse", "coverage_90", "iri_bias", "iri_error_relative")
HEAD = ("division", "plant", "car", "error", "own", "in 90 %", "IRI bias", "IRI error")
TASKS = ("plants_told", "plants_known", "plants_blind")


def by_car(table: pd.DataFrame, estimator: str) -> pd.DataFrame:
    """Return the scores of an estimator by division, plant and car, and of all cars of a plant."""
    conditions = pd.DataFrame(
        {"task": name, "condition": one.label, "plant": one.plant, "car": one.car}
        for name in TASKS
        for one in load_task(name).conditions
    )
    chosen = table[(table["estimator"] == estimator) & table["score"].isin(SCORES)]
    rows = chosen.merge(conditions, on=["task", "condition"], validate="many_to_one")
    every = rows.assign(car="all")
    means = pd.concat([rows, every]).groupby(["task", "plant", "car", "score"])["value"].median()
    return means.unstack("score")[list(SCORES)].loc[list(TASKS)]


def own_errors() -> pd.Series:
    """Return the error on drives of our own simulator by division, plant and car, or all cars."""
    found = []
    for task in map(load_task, TASKS):
        for condition in task.conditions:
            car, speed = task.vehicle_of(condition), condition.speed_kmh
            for _, road, seed in task.drives_of(task.test, condition):
                surface = road.realise(np.random.default_rng(seed))
                record, truth = simulate_record(
                    surface, speed_kmh=speed, seed=seed, vehicle=car, instruments=task.instruments
                )
                estimate = MapSmoother(adapt=False).estimate(record, car)
                error = score(estimate, truth, speed_kmh=speed)["nrmse"]
                found += [
                    {"task": task.name, "plant": condition.plant, "car": name, "own": error}
                    for name in (condition.car, "all")
                ]
    return pd.DataFrame(found).groupby(["task", "plant", "car"])["own"].median()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="The board of foreign plants by plant and car.")
    parser.add_argument("table", type=Path)
    parser.add_argument("--estimator", default="map_smoother")
    chosen = parser.parse_args()
    rows, own = by_car(pd.read_parquet(chosen.table), chosen.estimator), own_errors()
    print(f"{chosen.estimator}: error, share inside 90 % intervals, and the IRI")
    print("{:<10}{:<12}{:<20}{:>8}{:>8}{:>9}{:>12}{:>11}".format(*HEAD))
    for task, plant, car in rows.index:
        error, inside, bias, relative = rows.loc[task, plant, car]
        print(
            f"{task.removeprefix('plants_'):<10}{plant:<12}{car:<20}{error:>8.3f}"
            f"{own[task, plant, car]:>8.3f}"
            f"{100.0 * inside:>9.0f}{bias:>+7.2f} mm/m{100.0 * relative:>9.1f} %"
        )


if __name__ == "__main__":
    main()
