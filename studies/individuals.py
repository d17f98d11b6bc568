"""Errors on many individuals of one grade: is any of them lost?

    python -m studies.individuals RESULTS.jsonl

Each drives over a road of class D of its own at 54 km/h with mixed states, under the description
alone; none of these seeds decided anything. A row is appended to the results for each drive and
estimator; those that stand there are not computed again.
"""

from statistics import median

from studies.classes_and_speeds import LEAST_INSIDE, compute
from studies.study import Row, run_study, study_parser

COMPARED = ("map_smoother", "kalman_lag")
FIRST_SEED, INDIVIDUALS = 9500, 24

LOST = 0.4
"""Error above which a drive counts as lost."""


def summary(rows: list[Row]) -> str:
    """Return a line for each estimator."""
    lines = [
        f"{INDIVIDUALS} individuals of S1, described: in-band NRMSE and share inside 90 %",
        f"{'':<13} median  worst  (seed)  above {LOST:g}  least inside  below {LEAST_INSIDE:.0%}",
    ]
    for name in COMPARED:
        found = sorted((r for r in rows if r["name"] == name), key=lambda r: float(r["error"]))
        errors, inside = ([row[key] for row in found] for key in ("error", "inside"))
        lines.append(
            f"{name:<13} {median(errors):6.3f} {errors[-1]:6.3f}  ({found[-1]['seed']}) "
            f"{sum(x > LOST for x in errors):10d} {min(inside):13.0%} "
            f"{sum(x < LEAST_INSIDE for x in inside):10d}"
        )
    return "\n".join(lines)


def main() -> None:
    """Compute what is missing and print the table."""
    cases: list[Row] = [
        {"knows": "described", "road": "iso_d", "kmh": 54.0, "seed": seed, "name": name}
        for seed in range(FIRST_SEED, FIRST_SEED + INDIVIDUALS)
        for name in COMPARED
    ]
    chosen = study_parser("Errors on many individuals of one grade.").parse_args()
    run_study(chosen, cases, compute, summary, lambda rows, path: None)


if __name__ == "__main__":
    main()
