"""Attainable error of the test drives, added on request to the scores of a board.

An estimator that knows the described vehicle, its instruments and the spectrum of the road attains
it to first order from data below BANDWIDTH (`estimators.map_smoother.attainable`). A drive takes
some seconds, so the errors of a condition are kept in the cache folder, by task and code. Test
drives of perturbed vehicles have none, as what they leave unexplained is not noise, nor have those
without noise.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from estimators.map_smoother.attainable import attainable_error
from leaderboard.evaluation.bound import fit_spectrum
from leaderboard.evaluation.comparison import scores_by_run
from leaderboard.evaluation.results import Result, content_digest, make_table
from leaderboard.evaluation.tasks import Condition, Task
from leaderboard.evaluation.test_data import RecordedDrive, simulate_drives
from leaderboard.running.board import Board
from road_envs.analysis.information_bound import RoadPrior
from road_envs.core.artifacts import Kind
from road_envs.core.code_digest import cache_home
from road_envs.records.record import scored_band
from road_envs.vehicle.parameters import VehicleParameters

_CODE = "leaderboard.evaluation.evaluate", attainable_error.__module__
_ATTAINABLE = Kind("attainable error", 1, _CODE)
BANDWIDTH = 100.0  # bandwidth [Hz] of the data; the estimators of this package use no more


def with_attainable(board: Board, report: Callable[[str], None] = lambda text: None) -> Board:
    """Return the board with `attainable_nrmse` and `attainable_efficiency` of every drive."""
    results, verified = dict(board.results), dict(board.verified)
    for task in board.tasks:
        found: dict[tuple[str, int], float] = {}
        for condition in task.conditions:
            if condition.grade == "S0" and task.bound and task.test.noise:
                report(f"{task.name}: attainable error, {condition.label}")
                errors = _attainable_errors(task, condition)
                found |= {(condition.label, k): error for k, error in errors.items()}
        results[task.name] = [_with_scores(result, found) for result in board.results[task.name]]
        pairs = zip(board.results[task.name], results[task.name], strict=True)
        for before, now in pairs if board.verified else ():
            verified[content_digest(now)] = board.verified.get(content_digest(before), ())
    return dataclasses.replace(board, results=results, verified=verified)


def _attainable_errors(task: Task, condition: Condition) -> dict[int, float]:
    """Return the attainable in-band NRMSE [-] by test drive; NaN where it is not defined."""

    def compute() -> dict[str, dict[str, float]]:
        drives, car = simulate_drives(task, task.test, condition), task.vehicle_of(condition)
        # keys as text: a file of JSON has no others
        return {"errors": {str(d.index): drive_error(task, condition, d, car) for d in drives}}

    def parse(data: Mapping[str, Any]) -> dict[int, float]:
        return {int(k): np.nan if x is None else x for k, x in data["errors"].items()}

    identity = _ATTAINABLE.identity(task.digest, condition.label)
    return _ATTAINABLE.find_or_make(cache_home(), identity, compute, parse)


def drive_error(
    task: Task, condition: Condition, drive: RecordedDrive, car: VehicleParameters
) -> float:
    """Return the attainable in-band NRMSE [-] of a drive with `car`, NaN if it is not defined."""
    road = fit_spectrum(drive.truth, scored_band(condition.speed_kmh / 3.6))
    if road is None:
        return np.nan
    prior = RoadPrior(G_d0=10.0 ** (road[0] / 10.0), w=road[1])
    try:
        return attainable_error(
            drive.record, drive.truth, car, prior, bandwidth=BANDWIDTH, instruments=task.instruments
        )
    except (ArithmeticError, ValueError):  # the motion is not finite; a frame that twists
        return np.nan


def _with_scores(result: Result, attainable: Mapping[tuple[str, int], float]) -> Result:
    """Return a result with two more scores of every run whose drive has an attainable error."""
    if result.scores is None:
        return result
    rows: list[tuple[Any, ...]] = []
    for run, scores in scores_by_run(result.scores).items():
        if np.isfinite(error := attainable.get(run[:2], np.nan)):
            scores = scores | {"attainable_nrmse": error}
            if (own := scores.get("nrmse", 0.0)) > 0.0:
                scores["attainable_efficiency"] = (error / own) ** 2
        rows += [(*run, name, value) for name, value in scores.items()]
    return dataclasses.replace(result, scores=make_table(rows))
