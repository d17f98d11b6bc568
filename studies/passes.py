"""Error of one road from several passes over it, against their number and their mix.

    python -m studies.passes RESULTS.jsonl [--roads NAME ...] [--plot FILE]

One line of JSON for each road and grade is appended to the results; those that stand there are not
computed again. `map_smoother` estimates each pass alone, pairs of passes, and four together, in two
sets: four passes at one speed in one state, and four at different speeds in different states
(CONDITIONS). All odometers but that of the first pass of a set are displaced by up to 2 m and
scaled by up to 1 %. Errors are those in the band of the fastest pass, so that they can be compared.
Beside them stands the bound of the linear vehicle for that many passes, whose information adds.
With S1 the vehicle of all passes is one individual that differs from its description, with good
instruments.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import estimators
from estimators.map_smoother.estimator import MapSmoother
from leaderboard.metrics.heights import nrmse
from leaderboard.report.plots import COLOURS, write_figure
from road_envs.analysis.information_bound import (
    N_FREQUENCIES,
    Mode,
    Posterior,
    RoadPrior,
    measurement,
    posterior,
)
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Profile, Record, scored_band
from road_envs.records.roughness import CLASSES
from road_envs.roads import realise_road
from road_envs.sensing.instruments import Instruments, load_instruments
from road_envs.sensing.perturbed_vehicle import perturb_vehicle
from road_envs.vehicle.parameters import VehicleParameters, load_vehicle
from studies.study import Row, run_study, study_parser

Condition = tuple[float, Any]
FRONT_RIDE = {"front": "ride", "rear": "handling"}
REAR_RIDE = {"front": "handling", "rear": "ride"}
CONDITIONS: dict[str, tuple[Condition, ...]] = {
    "same": ((54.0, FRONT_RIDE),) * 4,
    "mixed": ((54.0, FRONT_RIDE), (30.0, "handling"), (40.0, REAR_RIDE), (14.5, "ride")),
}
ALONE, TOGETHER = ((0,), (1,), (2,), (3,)), (0, 1, 2, 3)
GROUPS = {"same": (*ALONE[:2], (0, 1), TOGETHER), "mixed": (*ALONE, (0, 1), (2, 3), TOGETHER)}
"""Passes that are estimated together."""

SINGLES = {mix: sum(len(group) == 1 for group in groups) for mix, groups in GROUPS.items()}
"""Number of passes of each set that are estimated alone."""

ROADS = ("iso_b", "iso_c", "iso_d", "belgian_like", "random_bumps", "iso_c", "iso_d", "iso_b")
"""Roads, of which each has a seed of its own."""

LENGTH, FIRST_SEED = 100.0, 50_000
SMOOTHER = MapSmoother(draws=0)
"""The estimator, without samples for standard deviations."""

OFFSET, SCALE_ERROR = 2.0, 0.01
"""Largest error of an odometer [m], and of its scale."""


def drives(number: int, grade: str, mix: str) -> tuple[list[Record], Profile]:
    """Return the records of four passes over a road, with exact odometers, and the truth."""
    seed, car = FIRST_SEED + number, load_vehicle("land_rover_defender_110")
    road = realise_road(ROADS[number], seed, LENGTH)
    true = perturb_vehicle(car, grade, seed).car
    made = [
        simulate_record(road, speed_kmh=v, mode=mode, seed=10 * seed + k, vehicle=true)
        for k, (v, mode) in enumerate(CONDITIONS[mix])
    ]
    return [record for record, _ in made], made[0][1]


def displaced(records: Sequence[Record], seed: int) -> list[Record]:
    """Return the records with errors of all odometers but the first."""
    rng = np.random.default_rng(seed)
    found = list(records[:1])
    for record in records[1:]:
        scale, offset = 1.0 + SCALE_ERROR * rng.uniform(-1.0, 1.0), OFFSET * rng.uniform(-1.0, 1.0)
        found.append(replace(record, s=scale * record.s + offset, v=scale * record.v))
    return found


def road_results(road: int, grade: str) -> Row:
    """Return errors, CPU times and bounds of both sets of passes over one of the ROADS."""
    band = scored_band(max(v for v, _ in CONDITIONS["mixed"]) / 3.6)
    row: Row = {"name": ROADS[road]}
    for mix in CONDITIONS:
        records, truth = drives(road, grade, mix)
        errors, seconds = [], []
        for group in GROUPS[mix]:
            chosen = displaced([records[k] for k in group], FIRST_SEED + road)
            begin = time.process_time()
            found = estimators.estimate(SMOOTHER, chosen if len(group) > 1 else chosen[0])
            seconds.append(round(time.process_time() - begin, 2))
            errors.append(round(nrmse(truth.z, found.z, truth.ds, band).pooled, 4))
        bounds = _bounds(road, mix, band)
        row[mix] = {"nrmse": errors, "seconds": seconds, "bound": bounds}
    return row


class OperatingPoint(NamedTuple):
    """A vehicle in a `mode` at `v` [m/s], in which it passes over a road."""

    car: VehicleParameters
    mode: Mode
    v: float


def bound_of_passes(
    passes: Sequence[OperatingPoint],
    instruments: Instruments,
    prior: RoadPrior,
    *,
    n: np.ndarray | None = None,
) -> Posterior:
    """Return the least error of linear reconstruction of one road from several passes over it.

    The noise of the passes is independent, so that their information H* R^-1 H adds. `n`
    [cycles/m] is by default the band of the fastest.
    """
    if n is None:
        n = np.linspace(*scored_band(max(one.v for one in passes)), N_FREQUENCIES)
    parts = [measurement(*one, instruments, prior, n) for one in passes]
    H = np.concatenate([H for H, _ in parts], axis=1)
    R, first = np.zeros((n.size, H.shape[1], H.shape[1]), dtype=complex), 0
    for _, one in parts:
        inside = slice(first, first + one.shape[1])
        R[:, inside, inside], first = one, inside.stop
    return posterior(n, H, prior.spectrum(n), R)


def _bounds(number: int, mix: str, band: tuple[float, float]) -> list[float] | None:
    """Return the bound of each of the GROUPS on an ISO road, None on others."""
    if not ROADS[number].startswith("iso_"):
        return None
    car = load_vehicle("land_rover_defender_110")
    prior = RoadPrior(G_d0=CLASSES[ROADS[number][-1].upper()])
    passes = [OperatingPoint(car, mode, v / 3.6) for v, mode in CONDITIONS[mix]]
    n = np.linspace(*band, 1001)
    instruments = load_instruments("paper")
    return [
        round(bound_of_passes([passes[k] for k in g], instruments, prior, n=n).pooled, 4)
        for g in GROUPS[mix]
    ]


def by_number(values: Sequence[float], mix: str) -> dict[int, float]:
    """Return the mean of `values`, one for each of the GROUPS, by the number of passes."""
    sizes = [len(group) for group in GROUPS[mix]]
    return {
        size: float(np.mean([x for x, k in zip(values, sizes, strict=True) if k == size]))
        for size in sorted(set(sizes))
    }


def summary(rows: list[Row]) -> str:
    """Return errors by the number of passes, their ratios to one pass, and times."""
    lines = ["in-band NRMSE of map_smoother, mean of the passes (pairs) of each set"]
    for grade in sorted({row["grade"] for row in rows}):
        chosen = [row for row in rows if row["grade"] == grade]
        head = "".join(f"{mix + ' ' + str(k):>10}" for mix in CONDITIONS for k in (1, 2, 4))
        lines += ["", f"{grade}: {'road':<14}{head}"]
        for row in chosen:
            cells = [x for mix in CONDITIONS for x in by_number(row[mix]["nrmse"], mix).values()]
            lines.append(f"    {row['name']:<14}" + "".join(f"{x:>10.4f}" for x in cells))
        for mix in CONDITIONS:
            one, two, four = (
                np.array([by_number(row[mix]["nrmse"], mix)[k] for row in chosen])
                for k in (1, 2, 4)
            )
            best = np.array([min(row[mix]["nrmse"][: SINGLES[mix]]) for row in chosen])
            lines.append(
                f"{grade} {mix}: two passes {np.median(two / one):.2f}, four "
                f"{np.median(four / one):.2f} times the error of one (worst "
                f"{np.max(four / one):.2f}), {np.median(four / best):.2f} times that of the best "
                "one (median of the roads)"
            )
            bounded = [by_number(row[mix]["bound"], mix) for row in chosen if row[mix]["bound"]]
            if bounded:
                ratio = np.median([each[4] / each[1] for each in bounded])
                lines.append(f"{grade} {mix}: the bound of four is {ratio:.2f} times that of one")
            times = [row[mix]["seconds"] for row in chosen]
            cost = np.median([each[-1] / np.mean(each[: SINGLES[mix]]) for each in times])
            lines.append(f"{grade} {mix}: four passes take {cost:.1f} times the CPU time of one")
    return "\n".join(lines)


def draw(rows: list[Row], path: Path) -> None:
    """Draw error and bound over the number of passes, for each grade."""
    grades = sorted({row["grade"] for row in rows})

    def paint(figure: Any) -> None:
        panels = figure.subplots(1, len(grades), sharey=True, squeeze=False)[0]
        for axes, grade in zip(panels, grades, strict=True):
            chosen = [row for row in rows if row["grade"] == grade]
            for mix, colour in zip(CONDITIONS, (COLOURS["left"], COLOURS["right"]), strict=True):
                each = [by_number(row[mix]["nrmse"], mix) for row in chosen]
                for one in each:
                    axes.plot(list(one), list(one.values()), color=colour, lw=0.7, alpha=0.3)
                median = [np.median([one[k] for one in each]) for k in (1, 2, 4)]
                label = f"{mix} speed and state"
                axes.plot((1, 2, 4), median, "o-", color=colour, label=label)
                bounds = [by_number(row[mix]["bound"], mix) for row in chosen if row[mix]["bound"]]
                median = [np.median([one[k] for one in bounds]) for k in (1, 2, 4)]
                axes.plot((1, 2, 4), median, ":", color=colour, label=f"bound (ISO roads), {mix}")
            axes.set(title=f"{grade}, {len(chosen)} roads", xscale="log", yscale="log")
            axes.set_xticks((1, 2, 4), ("1", "2", "4"), minor=False)
            ticks = (0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3)
            axes.set_yticks(ticks, [f"{x:g}" for x in ticks], minor=False)
            axes.minorticks_off()
            axes.set_xlabel("passes")
        panels[0].set_ylabel("in-band NRMSE of map_smoother")
        panels[0].legend(frameon=False)

    write_figure(paint, (9.0, 4.2), path)


def main() -> None:
    """Run the study."""
    parser = study_parser("Error over the number of passes.")
    parser.add_argument("--roads", type=int, default=0, help="number of roads with S0")
    parser.add_argument("--varied", type=int, default=0, help="number of roads with S1")
    chosen = parser.parse_args()
    numbers = {"S0": chosen.roads, "S1": chosen.varied}
    cases = [{"road": k, "grade": grade} for grade, n in numbers.items() for k in range(n)]
    run_study(chosen, cases, road_results, summary, draw)


if __name__ == "__main__":
    main()
