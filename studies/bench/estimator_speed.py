"""Time of estimators, of their training and of a board, and memory of many drives."""

import statistics
import time
from functools import partial
from typing import Any

import numpy as np

import estimators
from leaderboard.entries.entry import needs_training
from road_envs.drives.recording import simulate_record
from road_envs.roads import load_road, with_length
from road_envs.sensing.data_logger import load_instruments
from road_envs.vehicle.parameters import load_vehicle
from studies.bench import levenberg_marquardt
from studies.bench.integrators import PeerError
from studies.bench.machine import measure_machine
from studies.bench.speed import benchmark_row, median_time, run_in_new_process


def training() -> list[dict[str, Any]]:
    """Time of a training of `static_lm`, and of peers to the same error."""
    samples = levenberg_marquardt.samples()
    seconds = median_time(lambda: levenberg_marquardt.train_ours(samples, 100), 3)
    error = float(levenberg_marquardt.train_ours(samples, levenberg_marquardt.EPOCHS).train[-1])
    # a symmetric product of hidden derivatives, activations and errors for each epoch
    weights = samples.start.hidden.size + samples.start.output.shape[1] + len(samples.t)
    work = 1e-9 * levenberg_marquardt.EPOCHS * weights**2 * samples.t.shape[1]
    what = f"static_lm, 100 epochs on {samples.t.shape[1]} samples"
    rows = [benchmark_row(what, f"{seconds:.2f} s", "< 3 s", seconds, seconds=seconds)]
    for name, peer in levenberg_marquardt.PEERS.items():
        try:  # turn by turn: the pace of a machine changes
            pairs = [
                (peer(samples, error), levenberg_marquardt.time_ours(samples)) for _ in range(3)
            ]
        except PeerError as missing:
            rows.append(benchmark_row(f"static_lm against {name}", str(missing)))
            continue
        ratio = statistics.median(theirs / own for theirs, own in pairs)
        peer_seconds, own = (min(times) for times in zip(*pairs, strict=True))
        why = (
            f"the products of J'J alone are {work:.1f} GFLOP, {work / own:.0f} GFLOP/s of the "
            f"core's {2e-9 * measure_machine().one_thread:.0f}"
        )
        least = "more than " if peer_seconds >= levenberg_marquardt.TIME_LIMIT else ""
        what = f"static_lm against {name}, to one training error, CPU time on one thread"
        text = f"{least}{np.floor(10.0 * ratio) / 10.0:.1f} x faster"  # not rounded up to the aim
        rows.append(benchmark_row(what, text, ">= 5 x", ratio, why, ratio=ratio))
    return rows


TIMED_ESTIMATORS = (("map_smoother", 100.0, 1.0), ("kalman_lag", 100.0, 0.4), ("tcn", 1000.0, 1.0))
"""Timed estimators, length [m] of the road at 14.5 km/h, and target time [s]."""

LIMITS = {
    "map_smoother": "about 10 linearizations, each 28 000 steps with 700 operations for each of 43 "
    "columns of the tangent, 8 GFLOP in all, and 220 products that read its 6 MB twice",
    "kalman_lag": "for each of 9 300 blocks of 3 ms the tangent of three steps along 32 to 40 "
    "directions, and 0.7 million operations in products of matrices of 50 to 200 columns, 6 GFLOP",
}
"""Work behind each time, the reason of a missed target."""

FULL_BOARD_METRES = 420 * 300.0
"""Metres that `leaderboard --board new_road --full` drives."""

FULL_BOARD_PACE = 0.61
"""Mean time of that board for a metre, at 14.5, 30 and 54 km/h, over the time at 14.5 km/h."""


def estimator_speed() -> list[dict[str, Any]]:
    """Time of TIMED_ESTIMATORS on one drive each."""
    car, paper = load_vehicle("land_rover_defender_110"), load_instruments("paper")
    rows = []
    for name, metres, aim in TIMED_ESTIMATORS:
        road = with_length(load_road("iso_d"), metres).realise(np.random.default_rng(1))
        record, _ = simulate_record(
            road, vehicle=car, speed_kmh=14.5, mode="ride", instruments=paper, seed=1
        )
        estimator = estimators.create(name)
        seconds = median_time(partial(estimator.estimate, record, car), 3)
        what = f"{name}, {metres:.0f} m at 14.5 km/h"
        text = f"{seconds:.2f} s"
        why = LIMITS.get(name, "")
        rows.append(benchmark_row(what, text, f"< {aim:g} s", seconds, why, seconds=seconds))
    return rows


def full_board() -> list[dict[str, Any]]:
    """Extrapolate the full board of new roads from one estimate by each entry that is trained."""
    short, long = (
        simulate_record(
            with_length(load_road("iso_d"), metres), speed_kmh=14.5, mode="ride", seed=1
        )[0]
        for metres in (20.0, 100.0)
    )
    car, spent = load_vehicle("land_rover_defender_110"), {}
    for name in estimators.REGISTRY:
        estimator = estimators.create(name)
        if not needs_training(estimator):
            estimator.estimate(short, car)  # loads its compiled code
            begin = time.perf_counter()
            estimator.estimate(long, car)
            spent[name] = time.perf_counter() - begin
    total = sum(spent.values())
    minutes = total / 100.0 * FULL_BOARD_METRES * FULL_BOARD_PACE / 2.0 / 60.0
    worst = sorted(spent, key=lambda name: -spent[name])[:3]
    shares = ", ".join(f"{name} {100 * spent[name] / total:.0f} %" for name in worst)
    return [
        benchmark_row(
            f"full new-road board, {len(spent)} entries, two cores, by their time for 100 m",
            f"{minutes:.0f} min", "<= 30 min", minutes, f"shares: {shares}",
            minutes=minutes, **spent,
        )
    ]  # fmt: skip


def several_passes() -> list[dict[str, Any]]:
    """Time of `map_smoother` on four passes against one."""
    road = with_length(load_road("iso_d"), 100.0).realise(np.random.default_rng(1))
    mode = {"front": "ride", "rear": "handling"}
    records = [
        simulate_record(road, speed_kmh=54.0, mode=mode, seed=seed)[0] for seed in range(1, 5)
    ]
    one = median_time(lambda: estimators.estimate("map_smoother", records[0]), 3)
    four = median_time(lambda: estimators.estimate("map_smoother", records), 3)
    what, ratio = "map_smoother, four passes over 100 m at 54 km/h against one", four / one
    return [benchmark_row(what, f"{ratio:.1f} x the time", "<= 6 x", ratio, ratio=ratio)]


DRIVES_SCRIPT = """
import resource, time
import numpy as np
from road_envs.drives.recording import simulate_record
from road_envs.roads import load_road
from road_envs.sensing.data_logger import load_instruments
from road_envs.vehicle.parameters import load_vehicle

car, paper = load_vehicle("land_rover_defender_110"), load_instruments("paper")
road, begin = load_road("iso_d"), time.perf_counter()
for seed in range(1000):
    surface = road.realise(np.random.default_rng(seed))
    simulate_record(
        surface, vehicle=car, speed_kmh=54.0, mode="ride", instruments=paper, seed=seed
    )
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(peak, time.perf_counter() - begin)
"""


def drives_memory() -> list[dict[str, Any]]:
    """Memory and time of 100 km of drives, one by one."""
    peak, seconds = map(float, run_in_new_process(DRIVES_SCRIPT).split())
    what = "100 km of drives at 54 km/h, one by one"
    return [benchmark_row(what, f"{peak:.2f} GiB, {seconds:.0f} s", "< 2 GiB", peak, gib=peak)]
