"""Coverage of the standard deviations of identified parameters, on individuals of each grade.

    python -m studies.identified_parameters RESULTS.jsonl --individuals blind S1 3
        [--individuals ...] [--plot FILE]

One line of JSON for each individual is appended to the results; those that stand there are not
computed again. `--individuals` is a division, a grade and a number of individuals. Each is
identified from one drive at 54 km/h over class D: `known` over 100 m that were measured with errors
of 0.5 mm, `blind` over 150 m that nobody measured. A row has, for each parameter, its error in
units of the tolerance and the standard deviation of the fit.

The frictions are left out: that of all struts and that of each are told apart by prior only. So are
elements that the individual does not have.
"""

from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from estimators.api import CalibrationDrive
from estimators.map_smoother.identification import identify
from estimators.map_smoother.identification_result import IdentificationResult
from leaderboard.evaluation.test_data import levelled
from leaderboard.report.plots import COLOURS, write_figure
from road_envs.drives.recording import simulate_record
from road_envs.roads import realise_road
from road_envs.sensing.perturbed_vehicle import GRADES, perturb_vehicle
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from road_envs.vehicle.tolerances import log_values
from studies.study import Row, run_study, study_parser

MIXED, SPEED_KMH, SURVEY_STD = {"front": "ride", "rear": "handling"}, 54.0, 0.0005
ROADS = {"known": (1_080_000, 100.0), "blind": (1_090_000, 150.0)}
"""First seed and length [m] of the roads of both divisions."""

DIVISIONS = tuple(ROADS)
FIRST_INDIVIDUAL = 1001
"""Seed of the first individual; those below were looked at in development."""

LIMIT = 3.0
"""Standard deviations within which a parameter should be."""


def individual_result(individual: int, grade: str, division: str) -> Row:
    """Return the result of one individual."""
    car = load_vehicle("land_rover_defender_110")
    true = perturb_vehicle(car, grade, individual).car
    result = calibrate(car, individual, grade, division)
    space, parameters = result.fit.space, {}
    for i, name in enumerate(space.names):
        try:
            value = log_values(true, (name,))[0]
        except (TypeError, ValueError):  # an element that the individual does not have
            continue
        if np.isfinite(value) and "friction" not in name:
            about = log_values(space.car, (name,))[0]
            error = result.fit.x[i] - (value - about) / space.std[i]
            parameters[name] = [round(float(error), 4), round(float(result.fit.std[i]), 5)]
    left = result.unexplained[0]
    return {
        "unexplained": [round(left[0].power, 1), round(left[1].power, 1)],
        "parameters": parameters,
    }


def calibrate(
    car: VehicleParameters, individual: int, grade: str, division: str
) -> IdentificationResult:
    """Identify an individual from a drive over a `known` road or over one that nobody measured."""
    first, length = ROADS[division]
    seed = first + individual
    record, profile = simulate_record(
        realise_road("iso_d", seed, length),
        speed_kmh=SPEED_KMH, mode=MIXED, seed=seed, individual=individual, grade=grade,
    )  # fmt: skip
    drive = CalibrationDrive(record)
    if division == "known":
        measured = levelled(profile, SURVEY_STD, np.random.default_rng(individual))
        drive = CalibrationDrive(record, measured, SURVEY_STD)
    return identify([drive], car, structure=None)


def deviations(row: Row) -> dict[str, float]:
    """Return the error of each parameter in its own standard deviations."""
    errors, std = np.array(list(row["parameters"].values())).T
    z = errors / std
    return dict(zip(row["parameters"], z.tolist(), strict=True))


def summary(rows: Sequence[Row]) -> str:
    """Return, for each division and grade, the share of parameters within LIMIT."""
    lines = [
        f"parameters within {LIMIT:g} of their own standard deviations, root mean square of the",
        "errors in these, median of the unexplained power, parameters that were missed most often",
        f"{'division':<10}{'grade':<7}{'individuals':>12}{'parameters':>12}{'within':>9}{'rms':>6}"
        f"{'unexplained':>13}",
    ]
    for division, grade in product(DIVISIONS, GRADES[1:]):
        chosen = [row for row in rows if (row["division"], row["grade"]) == (division, grade)]
        if not chosen:
            continue
        found = [item for row in chosen for item in deviations(row).items()]
        z = np.array([value for _, value in found])
        missed = Counter(name for name, value in found if abs(value) >= LIMIT).most_common(3)
        left = np.median([row["unexplained"][1] for row in chosen])
        line = (
            f"{division:<10}{grade:<7}{len(chosen):>12}{z.size:>12}"
            f"{np.mean(np.abs(z) < LIMIT):>9.1%}{np.sqrt(np.mean(z**2)):>6.2f}{left:>13.1f}  "
        )
        lines.append((line + ", ".join(f"{name} {n}" for name, n in missed)).rstrip())
    return "\n".join(lines)


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the distribution of the errors over their standard deviations, one panel a division."""

    def paint(figure: Any) -> None:
        panels = figure.subplots(1, len(DIVISIONS), sharey=True)
        for axes, division in zip(panels, DIVISIONS, strict=True):
            chosen = [row for row in rows if row["division"] == division]
            z = np.sort(np.abs([v for row in chosen for v in deviations(row).values()]))
            axes.plot(z, np.arange(1, z.size + 1) / z.size, color=COLOURS["left"])
            axes.axvline(LIMIT, color="0.7", lw=0.8)
            axes.set_title(f"{division}, {len(chosen)} individuals")
            axes.set_xlabel("error in own standard deviations")
            axes.set_xlim(0.0, 2.0 * LIMIT)
        panels[0].set_ylabel("share of the parameters")

    write_figure(paint, (7.2, 3.4), path)


def main() -> None:
    """Run the study."""
    parser = study_parser("Coverage of the standard deviations of identified parameters.")
    words = ("DIVISION", "GRADE", "NUMBER")
    parser.add_argument("--individuals", action="append", nargs=3, metavar=words)
    chosen = parser.parse_args()
    cases = [
        {"individual": FIRST_INDIVIDUAL + k, "grade": grade, "division": division}
        for division, grade, number in chosen.individuals or []
        for k in range(int(number))
    ]
    run_study(chosen, cases, individual_result, summary, draw)


if __name__ == "__main__":
    main()
