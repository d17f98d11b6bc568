"""Errors beside position fixes that wander as those of a receiver, and beside exact ones.

    python -m studies.receiver_positions RESULTS.jsonl [--estimator NAME ...]

Each drive is one of the described vehicle over 300 m, whose speed signal errs by up to 2 % and
whose fixes pull the odometer back within 10 m; only the noise of the fixes differs. Columns:
in-band NRMSE at fixed stations and after local alignment, share of errors inside the 90 % interval
after it, error of the IRI [mm/m], and the deviation of the stations that the estimate states [m].
The last lines are the medians of all drives, and the worst ones. A row is appended to the results
for each drive and estimator; those that stand there are not computed again.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimators.estimation import estimate
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.registry import compute_scores
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Record
from road_envs.sensing.data_logger import DataLogger, load_instruments
from road_envs.sensing.sensor_faults import SensorFaults
from road_envs.vehicle.parameters import DEFAULT_STEP, load_vehicle
from studies.study import Row, run_study, study_parser

CAR, FIRST_SEED, LENGTH = load_vehicle("land_rover_defender_110"), 9600, 300.0
DRIVES = [(r, v, n) for r in ("iso_c", "iso_d") for v in (36.0, 54.0) for n in (1.0, 2.0, 3.0)]
ESTIMATORS = ["map_smoother", "kalman_rts", "kalman_lag", "wiener"]
SHOWN = ("nrmse", "nrmse_aligned", "coverage_90_aligned", "iri_error")


def with_fixes(record: Record, noise: float, seed: int) -> Record:
    """Return a record whose odometer follows fixes of this `noise` [m]."""
    error = float(np.random.default_rng((seed, 5)).uniform(-0.02, 0.02))
    faults = SensorFaults(speed=error, position_fix_length=10.0, position_noise=noise)
    rng = np.random.default_rng(seed)
    logger = DataLogger(load_instruments("paper"), CAR, DEFAULT_STEP, rng, faults)
    s = record.s[0] + logger.odometer(record.s - record.s[0])
    return replace(record, s=s, v=logger.speed_gain * record.v)


def compute(name: str, road: str, kmh: float, seed: int, noise: float) -> Row:
    """Return the scores of an estimator on a drive with fixes of this `noise` [m]."""
    record, truth = simulate_record(road, speed_kmh=kmh, mode="handling", seed=seed, length=LENGTH)
    found = estimate(name, with_fixes(record, noise, seed), CAR)
    scored = ScoredEstimate(truth, found, kmh / 3.6, bumps=False, wandering=True)
    scores = compute_scores(scored)
    return {"scores": [scores[key] for key in SHOWN], "s_std": found.s_std}


def summary(rows: list[Row]) -> str:
    """Return a line for each drive and estimator, then medians and worst."""
    heads = ("estimator", "road", "km/h", "noise", "fixed", "aligned", "in 90 %", "IRI", "± m")
    lines = [("{:<13}{:<7}" + "{:>8}" * 7).format(*heads)]
    found: dict[tuple[str, bool], list[list[float]]] = {}
    for row in rows:
        name, noise = row["name"], row["noise"]
        found.setdefault((name, noise > 0.0), []).append(row["scores"])
        begin = f"{name:<13}{row['road']:<7}{row['kmh']:>8g}{noise:>8g}"
        stated = f"{row['s_std']:>8.1f}" if row["s_std"] else f"{'–':>8}"
        lines.append(begin + cells(row["scores"]) + stated)
    for (name, wandering), scores in found.items():
        table, fixes = np.array(scores), "receiver" if wandering else "exact"
        worst = [*table.max(axis=0)[:2], table[:, 2].min(), table[:, 3].max()]
        for word, line in (("median", np.median(table, axis=0)), ("worst", worst)):
            lines.append(f"{name:<13}{word:<7}{fixes:>16}{cells(line)}")
    return "\n".join(lines)


def main() -> None:
    """Compute what is missing and print the table."""
    parser = study_parser("Errors beside fixes that wander.")
    parser.add_argument("--estimator", nargs="+", default=ESTIMATORS)
    chosen = parser.parse_args()
    cases = [
        {"name": name, "road": road, "kmh": kmh, "seed": FIRST_SEED + k, "noise": std}
        for k, (road, kmh, noise) in enumerate(DRIVES)
        for name in chosen.estimator
        for std in (0.0, noise)
    ]
    run_study(chosen, cases, compute, summary, lambda rows, path: None)


def cells(row: Sequence[float] | np.ndarray) -> str:
    """Return the scores of a row in columns."""
    return "".join(f"{score:>8.3f}" for score in row)


if __name__ == "__main__":
    main()
