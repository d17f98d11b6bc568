"""CPU time of an identification and of adapting, as measured by `bench`.

    python -m studies.bench.identification_speed

All drives are those of a vehicle of S1 over class D at 54 km/h, in mixed states. Times are those of
the process, of which the libraries' threads are kept to one, after a run that compiles.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from estimators.api import CalibrationDrive
from estimators.common.blas import single_blas_thread
from estimators.map_smoother.estimator import MapSmoother
from estimators.map_smoother.identification import identify
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Record
from road_envs.vehicle.parameters import load_vehicle
from studies.bench.speed import benchmark_row

INDIVIDUAL = 1501
SPEED_KMH = 54.0
LENGTH = 300.0
"""Length [m] of the drive that identifies."""

ADAPTING_LENGTHS = (100.0, 200.0, 300.0)
"""Lengths [m] of the drives to which the smoother adapts."""


def drive(length: float, seed: int) -> Record:
    """Return the record of one drive."""
    return simulate_record(
        "iso_d", speed_kmh=SPEED_KMH, mode={"front": "ride", "rear": "handling"},
        seed=seed, individual=INDIVIDUAL, grade="S1", length=length,
    )[0]  # fmt: skip


def cpu_time(run: Callable[[], object]) -> float:
    """Return the CPU time [s] of `run`."""
    begin = time.process_time()
    run()
    return time.process_time() - begin


@single_blas_thread()
def identification_speed() -> list[dict[str, Any]]:
    """Measure an identification from one drive, and adapting against the plain smoother."""
    car = load_vehicle("land_rover_defender_110")
    plain, adapting = MapSmoother(adapt=False), MapSmoother()
    adapting.estimate(drive(60.0, 1), car)
    records = [drive(length, k) for k, length in enumerate(ADAPTING_LENGTHS)]
    without, with_fit = (
        sum(cpu_time(partial(smoother.estimate, record, car)) for record in records)
        for smoother in (plain, adapting)
    )
    ratio = with_fit / without
    record = drive(LENGTH, 7)
    seconds = cpu_time(lambda: identify([CalibrationDrive(record)], car))
    return [
        benchmark_row(
            f"identify a vehicle from {LENGTH:.0f} m that nobody measured", f"{seconds:.0f} CPU-s",
            "<= 60", seconds, seconds=seconds,
        ),
        benchmark_row(
            "map_smoother adapting to the drive, against the plain one",
            f"{ratio:.1f} x, {with_fit:.1f} CPU-s", "<= 3 x", ratio,
            "most of it: systems of equations as long as the road, for each of 28 parameters and "
            "each sample that traces need, in the first two of six steps of the parameters; after "
            "each of them the road follows by one or two of its own",
            ratio=ratio, seconds=with_fit,
        ),
    ]  # fmt: skip


if __name__ == "__main__":
    for row in identification_speed():
        print(f"{row['what']:<64}{row['measured']:>20}{row['aim']:>9}")
