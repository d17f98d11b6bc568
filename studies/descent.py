"""Whether the descent of `map_smoother` ends at the optimum, on the drives of the report trial.

    python -m studies.descent rows.jsonl

The vehicle is as described, or the individual that was driven. The cost function in which the
descent from a level road ends, with its prior and noise, is minimized from the true road as well.
A row is a drive and a vehicle; those that the file has are not computed again.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

from estimators.common.odometer import calibrate_odometer
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.gauss_newton import GaussNewton, MapSolution, minimize
from estimators.map_smoother.objective import Linearization
from estimators.map_smoother.windows import whole_objective
from road_envs.drives.reading import read_drive
from road_envs.records.record import Profile, profile_stations
from road_envs.roads import realise_road
from road_envs.sensing.perturbed_vehicle import perturb_vehicle
from studies.report_trial import CASES, LENGTH, write_drive
from studies.study import Row, run_study, study_parser

STEPS, SETTLED = 60, 1e-4
"""Steps from the true road at most, and the relative fall of the cost of the last one."""

NEAR = 0.02
"""Relative difference of costs up to which the descent has ended at the optimum."""


def compute(road_class: str, kmh: int, seed: int, car: str) -> Row:
    """Return the cost where the descent from a level road ends, that where one from the true road
    does, that of the true road itself, and what the first leaves of the noise's power.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_drive((road_class, kmh, seed), folder)
        surface = realise_road(folder / "road.yaml", seed)
        drive = read_drive(folder / "phone_drive.csv", folder / "phone_drive.yaml")
    vehicle = drive.car if car == "described" else perturb_vehicle(drive.car, "S2", seed).car
    odometer = calibrate_odometer(drive.measured.record)
    settings = MapSmoother(draws=0, adapt=False, instruments=drive.sensors)
    prepared, _ = settings.prepare(odometer.record, vehicle, speed_std=odometer.speed_std)
    objective = whole_objective(prepared, settings.road_prior)
    solver = GaussNewton(settings.huber, prior_updates=settings.prior_updates)
    found = minimize(objective, solver)
    end, scale = found.linearization, found.noise_scale
    variance = [one.source.information / k for one, k in zip(end.passes, scale, strict=True)]
    end = end.with_noise(variance)
    s = profile_stations(LENGTH)
    u = end.objective.road.noise_of(Profile(s, surface.height(s)))
    truth = end.relinearize(end.objective.from_noise(u))
    best = _descended(replace(found, linearization=truth))
    costs = {"level": end.cost, "truth": best.cost, "at_truth": truth.cost}
    return costs | {"left": float(scale[0])}


def _descended(point: MapSolution) -> Linearization:
    """Return where steps under a fixed prior and noise end."""
    for _ in range(STEPS):
        before = point.linearization.cost
        point, _ = GaussNewton().step(point)
        if point.linearization.cost > (1.0 - SETTLED) * before:
            break
    return point.linearization


def summary(rows: list[Row]) -> str:
    """Return a line for each drive and vehicle, and how many descents ended at the optimum."""
    lines = ["class km/h seed  vehicle      cost  from the truth  at the truth  difference  noise"]
    for row in rows:
        lines.append(
            f"{row['road_class']:5s} {row['kmh']:4d} {row['seed']:4d}  {row['car']:9s} "
            f"{row['level']:7.0f} {row['truth']:15.0f} {row['at_truth']:13.0f} "
            f"{_difference(row):+10.1%} {row['left']:6.1f}"
        )
    for car in dict.fromkeys(row["car"] for row in rows):
        differences = [_difference(row) for row in rows if row["car"] == car]
        near = sum(x <= NEAR for x in differences)
        lines.append(
            f"{car}: {near} of {len(differences)} end at most {NEAR:.0%} above the cost that is "
            f"reached from the true road; worst {max(differences):+.1%}"
        )
    return "\n".join(lines)


def _difference(row: Row) -> float:
    return float(row["level"] / row["truth"] - 1.0)


def main() -> None:
    """Print what is reached from a level road, and what from the true one."""
    chosen = study_parser(__doc__.splitlines()[0]).parse_args()
    cases: list[Row] = [
        {"road_class": letter, "kmh": kmh, "seed": seed, "car": car}
        for car in ("described", "its own")
        for letter, kmh, seed in CASES
    ]
    run_study(chosen, cases, compute, summary, lambda rows, path: None)


if __name__ == "__main__":
    main()
