"""`bench`: speed and memory against peers on the same problem in the same run.

Absolute times of a shared machine prove little, so every comparison is a ratio of medians.
"""

import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rich.table import Table

import estimators
from leaderboard.commands import console, print_json, progress_bar
from leaderboard.commands.drives import Json
from leaderboard.peers import CAR, Problem, relative_error
from road_envs.dataset import record_drive
from road_envs.lanes import Fleet
from road_envs.roads import load_road
from road_envs.sensors import load_instruments
from road_envs.suspension import command
from road_envs.vehicle import load_vehicle

COMPARED = 3.0
"""Drive [s] on which integrators are compared; the reference makes it dear."""


FLEET = 64
"""Vehicles in the lanes' measurement."""


def bench(json: Json = False) -> None:
    """Measure speed and memory against peers, and print what was found."""
    parts: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "integrators": _integrators,
        "lanes": _lanes,
        "environment": _environment,
        "training": _training,
        "start-up": _start_up,
        "memory": _memory,
    }
    rows = []
    with progress_bar() as progress:
        for k, (name, measure) in enumerate(parts.items()):
            progress(name, k / len(parts))
            rows += measure()
    if json:
        print_json(rows)
        return
    table = Table("what", "measured", "aim", "", title="roadrecon bench", box=None)
    for row in rows:
        verdict = {True: "met", False: "MISSED", None: ""}[row["met"]]
        table.add_row(row["what"], row["measured"], row["aim"], verdict)
    console.print(table)


def _row(what: str, measured: str, aim: str = "", met: bool | None = None, **numbers: float):
    return {"what": what, "measured": measured, "aim": aim, "met": met, **numbers}


def _median_time(run: Callable[[], object], times: int = 5) -> float:
    run()
    spans = []
    for _ in range(times):
        begin = time.perf_counter()
        run()
        spans.append(time.perf_counter() - begin)
    return statistics.median(spans)


def _integrators() -> list[dict[str, Any]]:
    """The fixed-step drive against LSODA at the loosest tolerance that is as accurate."""
    problem = Problem(COMPARED)
    reference = problem.scipy("DOP853", 1e-9)
    seconds = _median_time(lambda: problem.fixed(0.001), 21)
    accuracy = relative_error(problem.fixed(0.001), reference)
    rtol = next(
        r
        for r in (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5)
        if relative_error(problem.scipy("LSODA", r), reference) < accuracy
    )
    peer = _median_time(lambda: problem.scipy("LSODA", rtol), 3)
    ratio = peer / seconds
    return [
        _row(
            "one vehicle, 1 ms step",
            f"{COMPARED / seconds:.0f} x real time",
            factor=COMPARED / seconds,
        ),
        _row("error of body acceleration at 1 ms", f"{100 * accuracy:.2f} %", error=accuracy),
        _row(
            f"against SciPy LSODA (compiled right-hand side, rtol {rtol:g})",
            f"{ratio:.0f} x faster",
            ">= 400 x",
            ratio >= 400,
            ratio=ratio,
        ),
    ]


def _lanes() -> list[dict[str, Any]]:
    """A fleet of vehicles, all signals written, second by second."""
    problem, byte, steps = Problem(10.0), command("ride"), 1000
    commands = np.full((FLEET, steps), byte, dtype=np.uint8)

    def rate(threads: int) -> float:
        fleet = Fleet([problem.start(0.001) for _ in range(FLEET)], threads)
        signals = fleet.signals(steps)
        return FLEET * steps * 0.001 / _median_time(lambda: fleet.advance(commands, signals))

    one, two = rate(1), rate(2)
    alone = problem.start(0.001)
    single = steps * 0.001 / _median_time(lambda: alone.advance(commands[0]))
    return [
        _row(
            f"{FLEET} vehicles in lanes, one core",
            f"{one:.0f} vehicle-seconds per second",
            ">= 10000",
            one >= 10_000,
            rate=one,
        ),
        _row(
            f"{FLEET} vehicles in lanes, two threads",
            f"{two:.0f} vehicle-seconds per second",
            ">= 20000",
            two >= 20_000,
            rate=two,
        ),
        _row(
            "lanes against one vehicle at a time, one core",
            f"{one / single:.1f} x",
            ">= 2.5 x",
            one >= 2.5 * single,
            ratio=one / single,
        ),
    ]


def _environment() -> list[dict[str, Any]]:
    import gymnasium

    import road_envs

    env = gymnasium.make(road_envs.ID, road="iso_d", length=1000.0)
    env.reset(seed=0)
    per_step = _median_time(lambda: [env.step(0) for _ in range(100)]) / 100
    return [
        _row("environment step of 50 ms", f"{1e6 * per_step:.0f} µs", microseconds=1e6 * per_step)
    ]


def _training() -> list[dict[str, Any]]:
    car, instruments = load_vehicle(CAR), load_instruments("ideal")
    surface = load_road("belgian_training").realise(np.random.default_rng(1))
    pair = record_drive(car, surface, speed_kmh=14.5, mode="ride", instruments=instruments, seed=1)
    network: Any = estimators.create("static_lm")
    begin = time.perf_counter()
    fitted = network.fit([pair[0]], [pair[1]], car, 1)
    seconds = time.perf_counter() - begin
    epochs = fitted.training.epochs
    return [
        _row(
            f"static_lm on one 100 m scenario ({epochs} epochs)",
            f"{seconds:.2f} s",
            "< 5 s",
            seconds < 5.0,
            seconds=seconds,
        )
    ]


def _fresh(code: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout


def _start_up() -> list[dict[str, Any]]:
    code = (
        "import time; t = time.perf_counter(); import sys, gymnasium, road_envs;"
        "gymnasium.make('RoadRecon-v0'); print(time.perf_counter() - t, 'torch' in sys.modules)"
    )
    answers = [_fresh(code).split() for _ in range(4)]
    seconds = statistics.median(float(s) for s, _ in answers[1:])
    torch = answers[-1][1] == "True"
    said = f"{seconds:.2f} s{', with torch' if torch else ', without torch'}"
    aim = "< 1.5 s, without torch"
    return [
        _row(
            "import road_envs and gym.make", said, aim, seconds < 1.5 and not torch, seconds=seconds
        )
    ]


DRIVES = """
import resource, time
import numpy as np
from road_envs.dataset import record_drive
from road_envs.roads import load_road
from road_envs.sensors import load_instruments
from road_envs.vehicle import load_vehicle

car, paper = load_vehicle("land_rover_defender_110"), load_instruments("paper")
road, begin = load_road("iso_d"), time.perf_counter()
for seed in range(1000):
    surface = road.realise(np.random.default_rng(seed))
    record_drive(car, surface, speed_kmh=54.0, mode="ride", instruments=paper, seed=seed)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(peak, time.perf_counter() - begin)
"""


def _memory() -> list[dict[str, Any]]:
    peak, seconds = map(float, _fresh(DRIVES).split())
    what = "100 km of drives at 54 km/h, one by one"
    return [_row(what, f"{peak:.2f} GiB, {seconds:.0f} s", "< 2 GiB", peak < 2.0, gib=peak)]
