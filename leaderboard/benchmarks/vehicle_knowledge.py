"""Error of `map_smoother` over what it knows of the vehicle, on individuals of a grade.

    python -m leaderboard.benchmarks.vehicle_knowledge RESULTS.jsonl [--individuals N] [--plot FILE]

One line of JSON for each individual and drive is appended to the results; those that stand there
are not computed again. What is known of the vehicle:

| told | its description |
| adapted | its description, fitted to the very drive |
| blind | fitted to another drive, over a road that nobody measured |
| known | fitted to 100 m at 54 km/h over a road measured with errors of 0.5 mm |
| true | the individual itself |
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from estimators.api import CalibrationDrive
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.identification import Identification, identify
from leaderboard.metrics.heights import nrmse
from leaderboard.report.plots import COLOURS, write_figure
from road_envs.data.record import Profile, Record, scored_band
from road_envs.data.recording import simulate_record
from road_envs.roads import realise_road
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.perturbed_vehicle import perturb_vehicle

MIXED = {"front": "ride", "rear": "handling"}
DRIVES: dict[str, tuple[float, Any, float]] = {
    "ride, 14.5 km/h": (14.5, "ride", 100.0),
    "mixed, 54 km/h": (54.0, MIXED, 200.0),
}
KNOWLEDGE = ("told", "adapted", "blind", "known", "true")
SURVEY_STD = 0.0005
TEST_SEED, KNOWN_SEED, BLIND_SEED = 70_000, 80_000, 90_000
"""First seeds of the test roads, and of the roads of both calibrations."""


def calibrations(car: VehicleParameters, seed: int) -> dict[str, Identification]:
    """Identify one individual from a drive over a known and from one over an unknown road."""
    record, profile = _drive(seed, KNOWN_SEED, (54.0, MIXED, 100.0))
    error = SURVEY_STD * np.random.default_rng(seed).standard_normal(profile.z.shape)
    measured = Profile(profile.s, profile.z + error)
    unknown, _ = _drive(seed, BLIND_SEED, (54.0, MIXED, 300.0))
    return {
        "known": identify([CalibrationDrive(record, measured, SURVEY_STD)], car),
        "blind": identify([CalibrationDrive(unknown)], car),
    }


def deviations(result: Identification, true: VehicleParameters) -> list[float]:
    """Return the errors of the fitted parameters in posterior standard deviations.

    The frictions are left out: that of all struts and that of each are told apart by prior only.
    """
    space = result.fit.space
    error = (result.fit.x[: space.size] - space.to_vector(true)) / result.std[: space.size]
    chosen = ["friction" not in name for name in space.names]
    return [round(float(z), 3) for z in error[chosen]]


def individual_results(seed: int) -> Iterator[dict[str, Any]]:
    """Yield the results of one individual, drive by drive."""
    car = load_vehicle("land_rover_defender_110")
    true = perturb_vehicle(car, "S1", seed).car
    found = calibrations(car, seed)
    cars = {"told": car, "adapted": car, "true": true} | {k: r.car for k, r in found.items()}
    for name, drive in DRIVES.items():
        record, truth = _drive(seed, TEST_SEED, drive)
        errors = {}
        for knowledge in KNOWLEDGE:
            smoother = MapSmoother(draws=0, adapt=knowledge == "adapted")
            estimate = smoother.estimate(record, cars[knowledge])
            band = scored_band(float(record.v.mean()))
            errors[knowledge] = round(nrmse(truth.z, estimate.z, truth.ds, band).pooled, 4)
        z = {k: deviations(r, true) for k, r in found.items()}
        yield {"individual": seed, "drive": name, "nrmse": errors, "deviations": z}


def _drive(seed: int, first_road: int, drive: tuple[float, Any, float]) -> tuple[Record, Profile]:
    kmh, mode, length = drive
    road = realise_road("iso_d", first_road + seed, length)
    return simulate_record(road, speed_kmh=kmh, mode=mode, seed=seed, grade="S1")


def summary(rows: list[dict[str, Any]]) -> str:
    """Return medians and worst errors, and how many parameters are within three deviations."""
    lines = [f"{'drive':<18}{'n':>3}  " + "".join(f"{k:>15}" for k in KNOWLEDGE)]
    for drive in DRIVES:
        errors = [row["nrmse"] for row in rows if row["drive"] == drive]
        if errors:
            cells = ([e[k] for e in errors] for k in KNOWLEDGE)
            text = "".join(f"  {np.median(c):.3f} ({max(c):.3f})" for c in cells)
            lines.append(f"{drive:<18}{len(errors):>3}  {text}")
    for k in ("known", "blind"):
        unique = {row["individual"]: row["deviations"][k] for row in rows}
        z = np.abs(np.concatenate(list(unique.values())))
        lines.append(f"{k}: {np.mean(z < 3.0):.1%} of {z.size} parameters within 3 deviations")
    return "\n".join(["median (worst) in-band NRMSE of map_smoother on S1", *lines])


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the error of each individual over what is known of the vehicle."""

    def paint(figure: Any) -> None:
        panels = figure.subplots(1, len(DRIVES), sharey=True)
        for axes, drive in zip(panels, DRIVES, strict=True):
            errors = [row["nrmse"] for row in rows if row["drive"] == drive]
            for e in errors:
                axes.plot(KNOWLEDGE, [e[k] for k in KNOWLEDGE], color="0.8", lw=0.8)
            median = [np.median([e[k] for e in errors]) for k in KNOWLEDGE]
            axes.plot(KNOWLEDGE, median, "o-", color=COLOURS["left"], label="median")
            axes.set(title=f"{drive}, {len(errors)} individuals", ylim=(0.0, None))
            axes.set_xlabel("what is known of the vehicle")
        panels[0].set_ylabel("in-band NRMSE of map_smoother")
        panels[0].legend(frameon=False)

    write_figure(paint, (9.0, 4.0), path)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="Error over knowledge of the vehicle.")
    parser.add_argument("results", type=Path)
    parser.add_argument("--individuals", type=int, default=0)
    parser.add_argument("--plot", type=Path)
    chosen = parser.parse_args()
    text = chosen.results.read_text(encoding="utf-8") if chosen.results.exists() else ""
    rows = [json.loads(line) for line in text.splitlines()]
    done = {row["individual"] for row in rows}
    for seed in range(1, chosen.individuals + 1):
        if seed not in done:
            rows += (new := list(individual_results(seed)))
            with chosen.results.open("a", encoding="utf-8") as file:
                file.writelines(json.dumps(row) + "\n" for row in new)
    print(summary(rows))
    if chosen.plot:
        draw(rows, chosen.plot)


if __name__ == "__main__":
    main()
