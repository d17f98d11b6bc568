"""Every shipped road, at shipped speeds and states: how far out is an estimate at worst?

    python -m studies.shipped_roads RESULTS.jsonl

The described Land Rover, as it is, drives over each road of `configs/roads`, and `map_smoother`
estimates it. A row is appended to the results for each drive; those that stand there are not
computed again.
"""

from statistics import median

import numpy as np

from estimators.estimation import estimate
from leaderboard.scoring import score
from road_envs.core.config import names
from road_envs.drives.recording import simulate_record
from studies.study import Row, run_study, study_parser

MIXED = {"front": "ride", "rear": "handling"}
CONDITIONS: dict[str, tuple[float, str | dict[str, str]]] = {
    "14.5 km/h, ride": (14.5, "ride"),
    "14.5 km/h, handling": (14.5, "handling"),
    "54 km/h, ride": (54.0, "ride"),
    "54 km/h, mixed": (54.0, MIXED),
    "100 km/h, mixed": (100.0, MIXED),
}
"""Speed [km/h] and state of the struts of each drive."""

SEED, ESTIMATOR = 9700, "map_smoother"

FARTHEST = 3.0
"""Range of an estimate over that of the road above which it is beyond all measure."""


def compute(road: str, condition: str) -> Row:
    """Return the ranges [m] of road and estimate, and the latter's error and intervals."""
    speed, mode = CONDITIONS[condition]
    record, truth = simulate_record(road, speed_kmh=speed, mode=mode, seed=SEED)
    found = estimate(ESTIMATOR, record)
    scores = score(found, truth, speed_kmh=speed)
    true, reached = np.ptp(truth.z, axis=1), np.ptp(found.z, axis=1)
    worst = int(np.argmax(reached - true))
    return {
        "true": float(true[worst]),
        "reached": float(reached[worst]),
        "error": scores["nrmse"],
        "inside": scores["coverage_90"],
        "noted": bool(found.notes),
    }


def summary(rows: list[Row]) -> str:
    """Return a line for each road, worst of all conditions beside the median."""
    lines = [
        f"{ESTIMATOR}: range of the road, and that of the estimate where it exceeds it most;",
        "error, median and worst, share inside 90 % at least, and estimates with a note",
        f"{'':<32}  road m  estimate m  {'':<20} error  worst  inside  noted",
    ]
    for road in dict.fromkeys(row["road"] for row in rows):
        drives = [row for row in rows if row["road"] == road]
        far = max(drives, key=lambda row: float(row["reached"] - row["true"]))
        errors = [row["error"] for row in drives]
        lines.append(
            f"{road:<32} {far['true']:7.3f} {far['reached']:11.3f}  {far['condition']:<20} "
            f"{median(errors):5.2f} {max(errors):6.2f} {min(r['inside'] for r in drives):7.0%} "
            f"{sum(row['noted'] for row in drives):3d}/{len(drives)}"
        )
    raised = [row for row in rows if row["true"] > 0.0]
    worst = max(raised, key=lambda row: float(row["reached"] / row["true"]))
    beyond = sum(row["reached"] > FARTHEST * row["true"] for row in raised)
    lines.append(
        f"{beyond} of {len(raised)} estimates have {FARTHEST:g} times the range of their road; the "
        f"most is {worst['reached'] / worst['true']:.2f} times ({worst['road']}, "
        f"{worst['condition']})"
    )
    return "\n".join(lines)


def main() -> None:
    """Compute what is missing and print the table."""
    chosen = study_parser("Every shipped road, at shipped speeds and states.").parse_args()
    cases = [{"road": road, "condition": one} for road in names("roads") for one in CONDITIONS]
    run_study(chosen, cases, compute, summary, lambda rows, path: None)


if __name__ == "__main__":
    main()
