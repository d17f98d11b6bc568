"""Errors and intervals on every class of road at every speed, worst beside median.

    python -m studies.classes_and_speeds RESULTS.jsonl [--field] [--plot FILE]

Each cell has drives over other roads with other individuals, of which none decided anything. An
individual of grade S1 (manufacture) is "known" if the estimators are given its own parameters,
without tolerances, and "described" if they are given the description alone. With --field each
individual is of grade S3 (manufacture, structure and instruments), under the description alone. A
row is appended to the results for each drive and estimator; those that stand there are not computed
again.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from estimators.estimation import estimate
from leaderboard.drive_report.posterior_iri import posterior_iri
from leaderboard.scoring import score
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Estimate, Profile
from road_envs.sensing.perturbed_vehicle import perturb_vehicle
from road_envs.vehicle.parameters import load_vehicle
from studies.study import Row, run_study, study_parser

MIXED = {"front": "ride", "rear": "handling"}
CONDITIONS: dict[float, tuple[Any, float]] = {
    14.5: ("ride", 100.0),
    36.0: (MIXED, 100.0),
    54.0: (MIXED, 100.0),
    100.0: (MIXED, 200.0),
}
"""State of the struts and length [m] of the drives at a speed [km/h]."""

ROADS = ("iso_a", "iso_b", "iso_c", "iso_d")
COMPARED = ("map_smoother", "kalman_lag", "wiener", "tcn")
FIRST_SEED, INDIVIDUALS = 9100, 3
LEAST_INSIDE = 0.8
"""Share of the errors in the intervals of 90 % below which they are too narrow."""

QUESTIONS: dict[bool, dict[str, tuple[str, ...]]] = {
    True: {"field": COMPARED},
    False: {"known": COMPARED, "described": COMPARED},
}
"""Estimators by what is known of the car, of individuals of grade S3 and of S1."""


def cases(questions: dict[str, tuple[str, ...]]) -> list[Row]:
    """Return a case for each drive and estimator of the `questions`."""
    return [
        {"knows": knows, "road": road, "kmh": kmh, "seed": FIRST_SEED + 100 * k + i, "name": name}
        for knows, names in questions.items()
        for road in ROADS
        for k, kmh in enumerate(CONDITIONS)
        for i in range(INDIVIDUALS)
        for name in names
    ]


def compute(knows: str, road: str, kmh: float, seed: int, name: str) -> Row:
    """Return error, share of errors inside, largest error of the IRI and share of IRI inside."""
    (mode, length), grade = CONDITIONS[kmh], "S3" if knows == "field" else "S1"
    car = load_vehicle("land_rover_defender_110")
    record, truth = simulate_record(
        road, speed_kmh=kmh, mode=mode, seed=seed, grade=grade, length=length
    )
    own = perturb_vehicle(car, grade, seed).car
    found = estimate(name, record, replace(own, tolerances={}) if knows == "known" else car)
    scores, (low, middle, high) = score(found, truth, speed_kmh=kmh), iri_ratios(found, truth)
    return {
        "error": scores["nrmse"],
        "inside": scores["coverage_90"],
        "iri_error": float(np.max(np.abs(middle - 1.0))),
        "iri_inside": float(np.mean((low <= 1.0) & (high >= 1.0))),
        "noted": any("vehicle" in note or "trained at" in note for note in found.notes),
    }


def iri_ratios(found: Estimate, truth: Profile) -> np.ndarray:
    """Return low, median and high of each IRI over the true one (3, K), by 100 m and wheel path."""
    edges = np.arange(0.0, truth.s[-1] + 1.0, 100.0)
    true = posterior_iri(Estimate(truth.s, truth.z), edges).median
    return (np.array(posterior_iri(found, edges)) / true).reshape(3, -1)


def _values(rows: list[Row], key: str, **case: object) -> list[float]:
    return [row[key] for row in rows if case.items() <= row.items()]


def _table(title: str, names: Iterable[str], cell: Callable[[dict[str, Any]], str]) -> str:
    """Return a table with a line for each estimator and road, and a column for each speed."""
    head = f"{'':<14}{'road':<13}" + "".join(f"{kmh:>9g} km/h" for kmh in CONDITIONS)
    lines = [
        f"{name:<14}{road:<13}"
        + "".join(f"{cell({'name': name, 'road': road, 'kmh': kmh}):>14}" for kmh in CONDITIONS)
        for name in names
        for road in ROADS
    ]
    return "\n".join([title, head, *lines])


def errors(rows: list[Row], knows: str, names: Iterable[str] = COMPARED) -> str:
    """Return the table of errors and of the shares inside the intervals of the worst drive."""

    def cell(case: dict[str, Any]) -> str:
        found, inside = (_values(rows, key, knows=knows, **case) for key in ("error", "inside"))
        return f"{median(found):.2f} {max(found):.2f} {100 * min(inside):>3.0f}"

    title = (
        f"{knows}: in-band NRMSE, median and worst, and share of the errors in the intervals of\n"
        "90 % in percent on the drive where it is least"
    )
    return "\n".join([_table(title, names, cell), *(silent(rows, knows, name) for name in names)])


def silent(rows: list[Row], knows: str, name: str) -> str:
    """Return how many drives are wrong without a word: intervals too narrow, no note."""
    drives = [row for row in rows if row["knows"] == knows and row["name"] == name]
    wrong = [row for row in drives if row["inside"] < LEAST_INSIDE]
    unnoted = sum(not row["noted"] for row in wrong)
    return (
        f"{name}: {len(wrong)} of {len(drives)} drives have less than {LEAST_INSIDE:.0%} inside, "
        f"{unnoted} of them without a note on vehicle or speed"
    )


def described(rows: list[Row]) -> str:
    """Return the table of the errors beside those with the car's own parameters."""

    def cell(case: dict[str, Any]) -> str:
        own, found = (
            median(_values(rows, "error", knows=k, **case)) for k in ("known", "described")
        )
        inside = _values(rows, "inside", knows="described", **case)
        return f"{found / own:.2f} {100 * median(inside):>3.0f}"

    title = "described: median error over that of the known car, median of the shares"
    return _table(title, COMPARED, cell)


def roughness(rows: list[Row]) -> str:
    """Return the table of the IRI by `map_smoother`."""

    def cell(case: dict[str, Any]) -> str:
        found, inside = (_values(rows, key, **case) for key in ("iri_error", "iri_inside"))
        return f"{median(found):.0%} {max(found):.0%} {100 * float(np.mean(inside)):>3.0f}"

    title = (
        "field: largest error of an IRI of the drive, median and worst, and share of the IRI in\n"
        "their intervals of 95 % in percent"
    )
    return _table(title, COMPARED[:1], cell)


def draw(rows: list[Row], path: Path) -> None:
    """Draw the errors of the last question by speed, a panel for each road."""
    from matplotlib.figure import Figure

    figure, knows = Figure(figsize=(9.0, 3.3), layout="constrained"), rows[-1]["knows"]
    for axes, road in zip(figure.subplots(1, len(ROADS), sharey=True), ROADS, strict=True):
        for name in sorted({row["name"] for row in rows if row["knows"] == knows}):
            case = {"knows": knows, "road": road, "name": name}
            errors = [median(_values(rows, "error", kmh=kmh, **case)) for kmh in CONDITIONS]
            axes.semilogy(list(CONDITIONS), errors, marker="o", label=name)
        axes.set(title=road, xlabel="speed [km/h]")
    figure.axes[0].set_ylabel("in-band NRMSE")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.savefig(path, dpi=120)


def main() -> None:
    """Compute what is missing and print the tables."""
    parser = study_parser("Errors and intervals by class and speed.")
    parser.add_argument("--field", action="store_true", help="individuals of grade S3")
    chosen = parser.parse_args()
    questions = QUESTIONS[chosen.field]

    def summary(rows: list[Row]) -> str:
        tables = [errors(rows, *question) for question in questions.items()]
        return "\n\n".join([*tables, roughness(rows) if chosen.field else described(rows)])

    run_study(chosen, cases(questions), compute, summary, draw)


if __name__ == "__main__":
    main()
