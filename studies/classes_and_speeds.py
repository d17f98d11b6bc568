"""Errors and intervals on every class of road at every speed, worst beside median.

    python -m studies.classes_and_speeds RESULTS.jsonl [--field] [--plot FILE]

Each cell has drives over other roads with other individuals, of which none decided anything. An
individual of grade S1 (manufacture) is "known" if the estimators are given its own parameters, and
"described" if they are given the description alone. With --field each individual is of grade S3
(manufacture, structure and instruments), under the description alone. A row is appended to the
results for each drive and estimator; those that stand there are not computed again.
"""

from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from estimators.estimation import estimate
from leaderboard.api import score
from leaderboard.drive_report.posterior_iri import posterior_iri
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

ROADS = ("iso_a", "iso_b", "iso_c", "iso_d", "belgian_like")
COMPARED = ("map_smoother", "kalman_lag", "wiener", "tcn")
FITTED = ("map_smoother", "wiener")
"""Estimators that fit the vehicle to the drive unless they are told that it is known."""

FIRST_SEED, INDIVIDUALS = 9100, 3


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
    settings = {"adapt": False} if knows == "known" and name in FITTED else {}
    told = perturb_vehicle(car, grade, seed).car if knows == "known" else car
    found = estimate(name, record, told, **settings)
    scores, (low, middle, high) = score(found, truth, speed_kmh=kmh), iri_ratios(found, truth)
    return {
        "error": scores["nrmse"],
        "inside": scores["coverage_90"],
        "iri_error": float(np.max(np.abs(middle - 1.0))),
        "iri_inside": float(np.mean((low <= 1.0) & (high >= 1.0))),
        "noted": any("vehicle" in note for note in found.notes),
    }


def iri_ratios(found: Estimate, truth: Profile) -> np.ndarray:
    """Return low, median and high of each IRI over the true one (3, K), by 100 m and wheel path."""
    edges = np.arange(0.0, truth.s[-1] + 1.0, 100.0)
    true = posterior_iri(Estimate(truth.s, truth.z), edges).median
    return (np.array(posterior_iri(found, edges)) / true).reshape(3, -1)


def _values(rows: list[Row], key: str, **case: object) -> list[float]:
    return [row[key] for row in rows if case.items() <= row.items()]


def _table(title: str, head: str, cell: Callable[[dict[str, Any]], str]) -> str:
    """Return a table with a line for each road and speed."""
    lines = [
        f"{road:<13}{kmh:>5g}{cell({'road': road, 'kmh': kmh})}"
        for road in ROADS
        for kmh in CONDITIONS
    ]
    return "\n".join([title, f"{'road':<13}{'km/h':>5}{head}", *lines])


def compared(rows: list[Row], knows: str) -> str:
    """Return the table of all estimators."""

    def cell(case: dict[str, Any]) -> str:
        text = ""
        for name in COMPARED:
            case = {**case, "knows": knows, "name": name}
            errors, inside = (_values(rows, key, **case) for key in ("error", "inside"))
            text += f"{median(errors):>7.2f} ({max(errors):.2f}) {100 * min(inside):>3.0f}"
        return text

    title = (
        f"{knows} car: in-band NRMSE, median (worst), and share of errors in the 90 % intervals\n"
        "of the worst drive in percent"
    )
    return _table(title, "".join(f"{name:>18}" for name in COMPARED), cell)


def described(rows: list[Row]) -> str:
    """Return the table of `map_smoother` under the description and with the car's parameters."""

    def cell(case: dict[str, Any]) -> str:
        case = {**case, "name": "map_smoother"}
        own = median(_values(rows, "error", knows="known", **case))
        errors, inside, noted = (
            _values(rows, key, knows="described", **case) for key in ("error", "inside", "noted")
        )
        return (
            f"{own:>8.3f}{median(errors):>11.3f}{median(errors) / own:>7.2f}{max(errors):>8.3f}"
            f"{100 * median(inside):>9.0f}{100 * min(inside):>7.0f}"
            f"{sum(noted):>6.0f} of {len(noted)}"
        )

    title = (
        "map_smoother with the car's own parameters and under its description: in-band NRMSE,\n"
        "medians and worst; share of errors in the 90 % intervals, median and least"
    )
    head = f"{'own':>8}{'described':>11}{'ratio':>7}{'worst':>8}{'in 90 %':>9}{'least':>7}"
    return _table(title, f"{head}{'noted':>11}", cell)


def roughness(rows: list[Row]) -> str:
    """Return the table of the IRI by `map_smoother`, a column for each speed."""
    lines = []
    for road in ROADS:
        text = f"{road:<13}"
        for kmh in CONDITIONS:
            case: dict[str, Any] = {"road": road, "kmh": kmh, "name": "map_smoother"}
            errors, inside = (_values(rows, key, **case) for key in ("iri_error", "iri_inside"))
            cell = f"{median(errors):.0%} ({max(errors):.0%})"
            text += f"{cell:>11}{100 * float(np.mean(inside)):>4.0f}"
        lines.append(text)
    title = (
        "field car: largest error of the IRI of a drive by map_smoother, median (worst), and\n"
        "share of IRI inside their 95 % intervals in percent"
    )
    head = f"{'km/h':<13}" + "".join(f"{kmh:>15g}" for kmh in CONDITIONS)
    return "\n".join([title, head, *lines])


def draw(rows: list[Row], path: Path) -> None:
    """Draw the errors of the last question by speed, a panel for each road."""
    from matplotlib.figure import Figure

    figure, knows = Figure(figsize=(10.0, 3.0), layout="constrained"), rows[-1]["knows"]
    for axes, road in zip(figure.subplots(1, len(ROADS), sharey=True), ROADS, strict=True):
        for name in sorted({row["name"] for row in rows if row["knows"] == knows}):
            case = {"knows": knows, "road": road, "name": name}
            errors = [median(_values(rows, "error", kmh=kmh, **case)) for kmh in CONDITIONS]
            axes.semilogy(list(CONDITIONS), errors, marker="o", label=name)
        axes.set(title=road, xlabel="speed [km/h]")
    figure.axes[0].set_ylabel("in-band NRMSE")
    figure.axes[-1].legend(fontsize="small")
    figure.savefig(path, dpi=120)


def main() -> None:
    """Compute what is missing and print the tables."""
    parser = study_parser("Errors and intervals by class and speed.")
    parser.add_argument("--field", action="store_true", help="individuals of grade S3")
    chosen = parser.parse_args()
    if chosen.field:
        run_study(
            chosen, cases({"field": COMPARED}), compute,
            lambda rows: f"{compared(rows, 'field')}\n\n{roughness(rows)}", draw,
        )  # fmt: skip
    else:
        run_study(
            chosen, cases({"known": COMPARED, "described": COMPARED[:1]}), compute,
            lambda rows: f"{compared(rows, 'known')}\n\n{described(rows)}", draw,
        )  # fmt: skip


if __name__ == "__main__":
    main()
