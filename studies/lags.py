"""How early how much of a road is known: errors of `kalman_lag` by lag and state of the struts.

    python -m studies.lags RESULTS.jsonl

The described Land Rover, as it is, drives over roads of class D at 54 km/h. The last column is of
`kalman_rts`, which has the whole drive. A row is appended to the results for each drive and lag;
those that stand there are not computed again.
"""

from statistics import mean

from estimators.estimation import estimate
from leaderboard.scoring import score
from road_envs.drives.recording import simulate_record
from studies.study import Row, run_study, study_parser

LAGS = (0.0, 1.0, 2.8, 4.79, 8.0, 15.0, None)
"""Distances [m] from the front axle back to a station that is emitted; None is the whole drive."""

STATES = ("ride/ride", "handling/handling", "ride/handling", "handling/ride")
SPEED, SEEDS = 54.0, (9650, 9651)


def compute(state: str, lag: float | None, seed: int) -> Row:
    """Return the error in the state front/rear of the struts at a lag."""
    front, rear = state.split("/")
    record, truth = simulate_record(
        "iso_d", speed_kmh=SPEED, mode={"front": front, "rear": rear}, seed=seed
    )
    if lag is None:
        found = estimate("kalman_rts", record)
    else:
        found = estimate("kalman_lag", record, lag=lag)
    return {"error": score(found, truth, speed_kmh=SPEED)["nrmse"]}


def summary(rows: list[Row]) -> str:
    """Return a line for each state, a column for each lag."""
    titles = ["whole drive" if lag is None else f"{lag:g} m" for lag in LAGS]
    lines = [
        f"in-band NRMSE by lag, mean of {len(SEEDS)} roads of class D, {SPEED:g} km/h",
        f"{'front/rear':<20}" + "".join(f"{title:>12}" for title in titles),
    ]
    for state in STATES:
        found = [
            mean(row["error"] for row in rows if (row["state"], row["lag"]) == (state, lag))
            for lag in LAGS
        ]
        lines.append(f"{state:<20}" + "".join(f"{error:12.3f}" for error in found))
    return "\n".join(lines)


def main() -> None:
    """Compute what is missing and print the table."""
    chosen = study_parser("Errors of the Kalman filter by its lag.").parse_args()
    cases = [
        {"state": state, "lag": lag, "seed": seed}
        for state in STATES for lag in LAGS for seed in SEEDS
    ]  # fmt: skip
    run_study(chosen, cases, compute, summary, lambda rows, path: None)


if __name__ == "__main__":
    main()
