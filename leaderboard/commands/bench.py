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
from scipy.integrate import solve_ivp

import estimators
from leaderboard.commands import console, print_json, progress_bar
from leaderboard.commands.drives import Json
from road_envs.dataset import record_drive
from road_envs.dynamics import N_DOF, plant
from road_envs.integrator import state_rate
from road_envs.roads import load_road, with_length
from road_envs.sensors import load_instruments
from road_envs.simulate import Drive
from road_envs.suspension import command
from road_envs.vehicle import load_vehicle

CAR, SPEED = "land_rover_defender_110", 15.0
COMPARED = 3.0
"""Drive [s] on which integrators are compared; the reference makes it dear."""


def bench(json: Json = False) -> None:
    """Measure speed and memory against peers, and print what was found."""
    parts: dict[str, Callable[[], list[dict[str, Any]]]] = {
        "integrators": _integrators,
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
    table = Table("what", "measured", "aim", "", title="roadrecon bench")
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


class _Problem:
    """A class-D road at 15 m/s in ride mode: body accelerations every millisecond."""

    def __init__(self):
        self.car = load_vehicle(CAR)
        self.plant = plant(self.car)
        road = with_length(load_road("iso_d"), SPEED * COMPARED + 20.0)
        self.surface = road.realise(np.random.default_rng(1))
        self.t = 0.001 * np.arange(round(COMPARED / 0.001))

    def start(self, step: float) -> Drive:
        return Drive(self.plant, self.car, self.surface, SPEED, "ride", step)

    def ours(self, step: float) -> np.ndarray:
        drive, every = self.start(step), round(0.001 / step)
        byte = command("ride")
        motion = drive.advance(np.full(self.t.size * every, byte, dtype=np.uint8))
        return motion.acceleration[::every, :3]

    def peer(self, method: str, rtol: float) -> np.ndarray:
        drive, surface = self.start(0.001), self.surface
        road = (surface.padded, surface.start, surface.ds)
        rate = np.empty(2 * N_DOF)

        def right_hand_side(t: float, y: np.ndarray) -> np.ndarray:
            s = drive.start + SPEED * t
            state_rate(*self.plant.arrays, drive.memory, *road, s, SPEED, y, rate)
            return rate

        solution = solve_ivp(
            lambda t, y: right_hand_side(t, y).copy(),
            (0.0, float(self.t[-1])),
            drive.state,
            method=method,
            t_eval=self.t,
            rtol=rtol,
            atol=1e-3 * rtol,
        )
        rates = [
            right_hand_side(t, y)[N_DOF : N_DOF + 3].copy()
            for t, y in zip(self.t, np.ascontiguousarray(solution.y.T), strict=True)
        ]
        return np.array(rates)


def _integrators() -> list[dict[str, Any]]:
    """The fixed-step drive against LSODA at the loosest tolerance that is as accurate."""
    problem = _Problem()
    reference = problem.peer("DOP853", 1e-9)
    scale = np.sqrt(np.mean(reference**2))

    def error(a: np.ndarray) -> float:
        return float(np.sqrt(np.mean((a - reference) ** 2)) / scale)

    seconds = _median_time(lambda: problem.ours(0.001), 21)
    accuracy = error(problem.ours(0.001))
    rtol = next(
        r
        for r in (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5)
        if error(problem.peer("LSODA", r)) < accuracy
    )
    peer = _median_time(lambda: problem.peer("LSODA", rtol), 3)
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
