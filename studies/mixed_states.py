"""Road that a drive reveals in mixed states of the suspension: errors and bounds by pair of states.

    python -m studies.mixed_states [--roads N]

Class-D roads of 100 m at 14.5 and 54 km/h, straight on, in the described car. `fir_ridge` is fitted
to drives over other roads in the same pair of states; `iterated_wiener` needs no training. Means
over both speeds of interquartile means over roads, and paired 95 % bootstrap intervals over roads
of the difference from handling on both axles.
"""

import argparse
import json
from typing import Any

import numpy as np

import estimators
from leaderboard.entries.entry import LocalSession, reconstruct_all
from leaderboard.evaluation.bound import fit_spectrum, pooled_bound
from leaderboard.metrics import heights
from leaderboard.metrics.bootstrap import Resampled, resample
from road_envs.drives.recording import simulate_record
from road_envs.records.record import scored_band
from road_envs.roads import realise_road
from road_envs.sensing.data_logger import load_instruments
from road_envs.vehicle.parameters import load_vehicle

CAR, SENSORS = "land_rover_defender_110", "paper"
SPEEDS = (54.0, 14.5)
PAIRS = (("ride", "ride"), ("handling", "handling"), ("ride", "handling"), ("handling", "ride"))
REFERENCE = ("handling", "handling")
TEST_SEED, TRAINING_SEEDS, LENGTH = 5001, range(1, 11), 100.0
ESTIMATORS = ("fir_ridge", "iterated_wiener")


def case(pair: tuple[str, str], speed: float, roads: int) -> dict[str, np.ndarray]:
    """Return the bound and the errors (roads,) of a pair of states at a speed."""
    mode = {"front": pair[0], "rear": pair[1]}
    car, instruments = load_vehicle(CAR), load_instruments(SENSORS)

    def drive(seed: int) -> Any:
        surface = realise_road("iso_d", seed, LENGTH)
        return simulate_record(
            surface, vehicle=car, speed_kmh=speed, mode=mode, instruments=instruments, seed=seed
        )

    training = [drive(seed) for seed in TRAINING_SEEDS]
    tests = [drive(TEST_SEED + k) for k in range(roads)]
    band = scored_band(speed / 3.6)
    spectrum = fit_spectrum(tests[0][1], band)
    bound = np.nan
    if spectrum is not None:
        bound = pooled_bound(CAR, SENSORS, json.dumps(mode), speed / 3.6, *spectrum)
    columns = {"bound": np.full(roads, bound)}
    for name in ESTIMATORS:
        estimator = estimators.create(name, **({"shipped": False} if name == "fir_ridge" else {}))
        session, records = LocalSession(estimator, car), [record for record, _ in tests]
        (found,) = reconstruct_all(session, training, records, [1])
        columns[name] = np.array(
            [
                heights.nrmse(truth.z, one.z, truth.ds, band).pooled
                for (_, truth), one in zip(tests, found.estimates, strict=True)
            ]
        )
    return columns


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="What mixed states reveal of the road.")
    parser.add_argument("--roads", type=int, default=8)
    roads = parser.parse_args().roads
    found: dict[tuple[str, str], dict[str, Resampled]] = {}
    for pair in PAIRS:
        cases = [case(pair, speed, roads) for speed in SPEEDS]
        found[pair] = {
            name: resample([one[name][:, None, None] for one in cases], [0.5, 0.5])
            for name in cases[0]
        }
    print(
        f"{'front/rear':20s}{'bound':>7s}",
        *(f"{n:>17s} {'more than handling':>27s}" for n in ESTIMATORS),
    )
    for pair, columns in found.items():
        cells = [f"{'/'.join(pair):20s}{columns['bound'].interval().mean:7.3f}"]
        for name in ESTIMATORS:
            own, other = columns[name], found[REFERENCE][name]  # paired road by road
            apart, drawn = own.replicates - other.replicates, min(own.n_drawn, other.n_drawn)
            more = Resampled(own.mean - other.mean, apart, drawn).interval()
            text = f"{more.mean:+.3f} ({more.low:+.3f} to {more.high:+.3f})"
            text = "" if pair == REFERENCE else text
            cells.append(f"{own.interval().mean:17.3f} {text:>27s}")
        print(*cells)


if __name__ == "__main__":
    main()
