"""Error of `map_smoother` on the cars of other projects, told each car's own description.

    python -m studies.plants RESULTS.jsonl [--plot FILE]

One line of JSON for each drive of 100 m is appended to the results; those that stand there are not
computed again. The vehicle that the estimator is told has the numbers of the plant: the vehicle
file, of `commonroad` with its linear struts (`road_envs.plants.commonroad_car.as_driven`). With
`side` false it is told that vehicle without side motion. `own` is the error where our own simulator
drives the told vehicle over the same road and the estimator knows it: what the readings tell. The
plot has the responses of the body's roll to the difference of the wheel paths.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import csd, welch

from estimators.map_smoother.estimator import MapSmoother
from leaderboard.metrics.heights import band_pass, nrmse, uncertainty
from leaderboard.report.plots import COLOURS, write_figure
from road_envs.drives.recording import simulate_record
from road_envs.plants.commonroad_car import as_driven
from road_envs.plants.driving import PLANTS, RUN_IN, simulate_on_plant
from road_envs.records.record import scored_band
from road_envs.records.roughness import iri
from road_envs.roads import realise_road
from road_envs.sensing.instruments import SensorLocation
from road_envs.vehicle.linear_model import frequency_response, linearise
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from studies.study import Row, run_study, study_parser

CARS = ("bmw_320i", "volkswagen_vanagon", "jeep_cherokee", "defender_110_coils")
DRIVES = (
    ("iso_c", 36.0),
    ("belgian_like", 36.0),
    ("iso_b", 90.0),
    ("iso_d", 90.0),
)
"""Roads and speeds [km/h]; the first is driven without side motion in the model as well."""

ROAD_SEED, LENGTH = 11, 100.0
CASES = [
    {"plant": plant, "car": car, "road": road, "speed_kmh": v, "side": side}
    for road, v in DRIVES
    for side in ((True, False) if road == DRIVES[0][0] else (True,))
    for car in CARS
    for plant in sorted(PLANTS)
]


def told_vehicle(plant: str, car: str) -> VehicleParameters:
    """Return the vehicle of a plant, as its builder would describe it."""
    described = load_vehicle(car)
    return as_driven(described) if plant == "commonroad" else described


def drive_result(plant: str, car: str, road: str, speed_kmh: float, side: bool) -> Row:
    """Return errors, coverage and roughness of one drive."""
    surface, told = realise_road(road, ROAD_SEED, LENGTH), told_vehicle(plant, car)
    record, truth = simulate_on_plant(
        plant, surface, speed_kmh=speed_kmh, seed=ROAD_SEED, vehicle=load_vehicle(car)
    )
    found = MapSmoother().estimate(record, told if side else told.sliding)
    own, own_truth = simulate_record(
        surface, speed_kmh=speed_kmh, seed=ROAD_SEED, vehicle=told, instruments="paper"
    )
    known = MapSmoother(adapt=False).estimate(own, told)
    band = scored_band(speed_kmh / 3.6)
    y, a = band_pass(np.stack([truth.z, found.z]), truth.ds, band)
    mean, half = (
        float(np.linalg.norm(part @ (a - y)) / np.linalg.norm(part @ y))
        for part in (np.array([0.5, 0.5]), np.array([0.5, -0.5]))
    )
    assert found.z_std is not None
    indices = [float(np.mean([iri(z, x.ds) for z in x.z])) for x in (truth, found)]
    return {
        "nrmse": nrmse(truth.z, found.z, truth.ds, band).pooled,
        "own": nrmse(own_truth.z, known.z, own_truth.ds, band).pooled,
        "mean": mean,
        "difference": half,
        "coverage_90": uncertainty(y, a, found.z_std).coverage_90,
        "iri": indices[0],
        "iri_error": indices[1] / indices[0] - 1.0,
        "notes": list(found.notes),
    }


def summary(rows: list[Row]) -> str:
    """Return the medians over roads and speeds by plant and car, and all drives below."""
    head = (
        f"{'error':>7}{'own':>9}{'mean':>9}{'difference':>12}  in 90 %  IRI bias  IRI RMSE  noted"
    )
    lines = [f"{'median, told the description':<40}{head}"]
    for side in (True, False):
        for plant in sorted(PLANTS):
            for car in CARS:
                key = {"plant": plant, "car": car, "side": side}
                chosen = [row for row in rows if key.items() <= row.items()]
                lines.append(f"{plant:<12}{car:<20}{_label(side):<8}" + _numbers(chosen))
    lines.append("\neach drive")
    for row in rows:
        place = f"{row['plant']:<12}{row['car']:<20}{_label(row['side']):<8}"
        lines.append(f"{place}{row['road']:<14}{row['speed_kmh']:5.0f} km/h" + _numbers([row]))
    return "\n".join(lines)


def _label(side: bool) -> str:
    return "side" if side else "sliding"


def _numbers(rows: Sequence[Row]) -> str:
    if not rows:
        return "  not computed"
    medians = [np.median([row[k] for row in rows]) for k in ("nrmse", "own", "mean", "difference")]
    error = np.array([row["iri_error"] for row in rows])
    coverage = np.mean([row["coverage_90"] for row in rows])
    noted = sum(bool(row["notes"]) for row in rows)
    return (
        f"{medians[0]:7.3f}{medians[1]:9.3f}{medians[2]:9.3f}{medians[3]:12.3f}{coverage:9.2f}"
        f"  {error.mean():+8.1%}  {np.sqrt(np.mean(error**2)):8.1%}  {noted} of {len(rows)}"
    )


def roll_responses(car: str, f: np.ndarray, v: float) -> dict[str, np.ndarray]:
    """Return the gains (F,) [rad/s² per m] of roll to the difference of the wheel paths by model.

    Those of the plants are spectral estimates of a drive over 200 m of class C.
    """
    points = [SensorLocation(0.0, 0.0), SensorLocation(0.0, 1.0)]
    surface, described = realise_road("iso_c", ROAD_SEED, 200.0), load_vehicle(car)
    found, h = {}, 1e-3
    for plant, build in sorted(PLANTS.items()):
        centre, left = build(described, points).drive(surface, -RUN_IN, v, 205.0 / v, h)
        z = surface.height(-RUN_IN + v * h * np.arange(centre.size))
        own, power = welch(z[0] - z[1], 1.0 / h, nperseg=4000)
        cross = csd(z[0] - z[1], left - centre, 1.0 / h, nperseg=4000)[1]
        found[plant] = np.interp(f, own, np.abs(cross) / power)
    linear = as_driven(described)
    places = {"centre": (0.0, 0.0), "left": (0.0, 1.0)}
    told = {"commonroad": linear, "mujoco": replace(linear, side=described.side)}
    models = {f"model of {plant}": car for plant, car in told.items()}
    for name, each in {**models, "model, sliding": linear.sliding}.items():
        model = linearise(each, "passive", places, speed=v)
        H = frequency_response(model, v, f=f)
        found[name] = np.abs((H[:, 1] - H[:, 0]) @ [0.5, -0.5])
    return found


def draw(rows: list[Row], path: Path) -> None:
    """Draw the responses of roll and the errors by plant and car."""
    f, colours = np.geomspace(0.5, 15.0, 200), list(COLOURS.values())

    def paint(figure: Any) -> None:
        axes = figure.subplots(2, len(CARS), sharey="row")
        for (above, below), car in zip(axes.T, CARS, strict=True):
            above.set_title(car, fontsize=9)
            above.set_xlabel("frequency [Hz]")
            for name, gain in roll_responses(car, f, 10.0).items():
                style, plant = "-" if name in PLANTS else "--", name.removeprefix("model of ")
                colour = colours[sorted(PLANTS).index(plant)] if plant in PLANTS else "0.6"
                above.loglog(f, gain, style, color=colour, label=name, linewidth=1.2)
            for k, plant in enumerate(sorted(PLANTS)):
                for side, marker in ((False, "x"), (True, "o")):
                    key = {"plant": plant, "car": car, "side": side}
                    errors = [row["nrmse"] for row in rows if key.items() <= row.items()]
                    at = np.full(len(errors), k + (0.12 if side else -0.12))
                    label = f"{plant}, {_label(side)}"
                    below.plot(at, errors, marker, color=colours[k], label=label)
            below.set_xticks(range(len(PLANTS)), sorted(PLANTS))
        axes[1, 0].set_ylim(0.0, None)  # of all cars, once their errors are drawn
        axes[0, 0].set_ylabel("roll per path difference\n[rad/s² per m]")
        axes[1, 0].set_ylabel("in-band error (NRMSE)")
        axes[0, 0].legend(fontsize=7)
        axes[1, 0].legend(fontsize=7, loc="upper left")

    write_figure(paint, (9.0, 5.6), path)


def main() -> None:
    """Compute what is missing; print and draw all results."""
    chosen = study_parser("map_smoother on foreign plants").parse_args()
    run_study(chosen, CASES, drive_result, summary, draw)


if __name__ == "__main__":
    main()
