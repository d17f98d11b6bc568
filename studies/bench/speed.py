"""Speed and memory of the simulator, as measured by `bench`: integrators, fleet, environments.

Absolute times on a shared machine are unreliable, so results are ratios of medians of one run where
possible. A row that misses its target states why.
"""

import operator
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from road_envs.kernels.normal_numbers import fill_normal, generator_state
from road_envs.kernels.simd import LANES
from road_envs.roads import load_road
from road_envs.simulation.drive import DriveSimulator
from road_envs.simulation.lanes import aligned_zeros
from road_envs.simulation.rosenbrock import ACCELERATION
from road_envs.simulation.substeps import MAX_RATE_CHANGE, SUBSTEPS
from road_envs.vehicle.suspension import encode_command
from studies.bench.fleet import Fleet, integrate_lanes
from studies.bench.integrators import (
    MODE,
    SPEED,
    IntegrationProblem,
    PeerError,
    relative_error,
)
from studies.bench.machine import measure_machine

COMPARISON_DURATION = 3.0
"""Drive [s] for the comparison of integrators; the reference solution makes longer ones slow."""

FLEET_SIZE = 64
"""Vehicles of the fleet benchmark."""

N_ENVIRONMENTS = 1024

STEP_ADDITIONS, STEP_MULTIPLICATIONS, STEP_DIVISIONS, STEP_COMPARISONS = 673, 512, 60, 96
"""Operations of `rosenbrock.step` for one vehicle, as `tests/support/count_operations.py` counts
them."""

STEP_LOOK_UPS = 24
"""Cubics that a step reads: two of each strut in both stages, and the road under each wheel at two
instants."""

CHAIN_MULTIPLY_ADDS = 72
"""Multiply-adds in the longest chain of a step, each of which needs the result of the last one."""

CHAIN_DIVISIONS = 3
"""Divisions in that chain."""

ENVIRONMENT_OPERATIONS = 155
"""Additions, multiplications and comparisons of an environment beyond the drive, per vehicle and
step: 26 for each of three sensors (mounting 3, noise 1, range 4, anti-alias filter of two sections
18), W_k filter of four sections 37, costs 20, failures 20."""

TOLERANCES = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5)

COMPILED_NOTE = (
    "the peers call this project's compiled right-hand side and Jacobian on a road with a "
    "continuous slope, where they run 10 to 50 times as fast as with one in Python"
)


RELATIONS = {">=": operator.ge, "<=": operator.le, "<": operator.lt}


def benchmark_row(
    what: str,
    measured: str,
    aim: str = "",
    value: float | None = None,
    why: str = "",
    **numbers: float,
) -> dict[str, Any]:
    """Return one row of the table.

    `aim` is a relation and a bound of `value`, with a unit; `why` explains a missed one.
    """
    row: dict[str, Any] = {"what": what, "measured": measured, "aim": aim, "met": None}
    if value is not None:
        relation, bound, *_ = aim.split()
        row["met"] = RELATIONS[relation](value, float(bound))
    if why and row["met"] is False:
        row["why"] = why
    return row | numbers


def median_time(
    run: Callable[[], object], times: int = 5, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Return the median time [s] of `run` by a `clock`, after one warm-up run."""
    run()
    spans = []
    for _ in range(times):
        begin = clock()
        run()
        spans.append(clock() - begin)
    return statistics.median(spans)


cpu_time = partial(median_time, clock=time.process_time)
"""Median CPU time [s] of what runs on one core, which other work on the machine hardly changes."""


def run_in_new_process(code: str, **variables: str) -> str:
    """Return the output of Python code in a new interpreter, which keeps bytecode of modules."""
    ours = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    return subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        capture_output=True,
        text=True,
        env=ours | variables,
    ).stdout


def integrator_speed() -> list[dict[str, Any]]:
    """Compare the fixed-step integrator with peers of at least its accuracy."""
    problem = IntegrationProblem(COMPARISON_DURATION)
    reference = problem.scipy("DOP853", 1e-9)
    seconds = cpu_time(lambda: problem.fixed_step(0.001), 21)
    accuracy = relative_error(problem.fixed_step(0.001), reference)
    error = f"{100 * accuracy:.2f} %"
    rows = [
        _one_vehicle(),
        benchmark_row("error of body acceleration at 1 ms", error, error=accuracy),
    ]
    peers: dict[str, tuple[Callable[[float], Any], str]] = {
        "SciPy LSODA": (lambda rtol: problem.scipy("LSODA", rtol), ">= 65 x"),
        "SUNDIALS CVODE": (problem.cvode, ">= 50 x"),
        "SciPy Radau": (lambda rtol: problem.scipy("Radau", rtol), ""),
    }
    for name, (solve, aim) in peers.items():
        try:
            rtol = next(r for r in TOLERANCES if relative_error(solve(r), reference) < accuracy)
        except PeerError as missing:
            rows.append(benchmark_row(f"against {name}", f"skipped: {missing}"))
            continue
        peer_seconds = cpu_time(partial(solve, rtol), 3)
        rows.append(_against(f"{name} (rtol {rtol:g})", peer_seconds / seconds, aim, COMPILED_NOTE))
    try:
        _, peer_seconds = problem.octave(1e-3)
        rows.append(_against("Octave ode23s (rtol 1e-3)", peer_seconds / seconds, ">= 27000 x"))
    except PeerError as missing:
        rows.append(benchmark_row("against Octave ode23s", f"skipped: {missing}"))
    return rows


def _against(peer: str, ratio: float, aim: str, why: str = "") -> dict[str, Any]:
    value = ratio if aim else None
    return benchmark_row(f"against {peer}", f"{ratio:.0f} x faster", aim, value, why, ratio=ratio)


def _one_vehicle() -> dict[str, Any]:
    """Time a drive of 10 s, and bound it by the machine's measured throughput and latency."""
    problem = IntegrationProblem(10.0)
    commands = np.full(problem.t.size, encode_command("ride"), dtype=np.uint8)
    drives = iter([problem.new_drive() for _ in range(32)])
    factor = 10.0 / cpu_time(lambda: next(drives).advance(commands), 31)
    machine = measure_machine()
    ns = 1e6 / factor
    # at best every multiplication is part of a multiply-add
    instructions = STEP_ADDITIONS + STEP_COMPARISONS
    throughput = 1e9 * LANES * instructions / machine.one_thread
    chain = 1e9 * (CHAIN_MULTIPLY_ADDS * machine.multiply_add + CHAIN_DIVISIONS * machine.division)
    return benchmark_row(
        "one vehicle, one core, 1 ms step, all signals written",
        f"{factor:.0f} x real time", ">= 4000 x", factor,
        f"a step takes {ns:.0f} ns. It is at least {instructions} instructions, which take "
        f"{throughput:.0f} ns if they wait for nothing; its longest chain, {CHAIN_MULTIPLY_ADDS} "
        f"multiply-adds and {CHAIN_DIVISIONS} divisions that wait for each other, takes "
        f"{chain:.0f} ns; look-ups in tables and moves come on top",
        factor=factor, throughput=throughput, chain=chain,
    )  # fmt: skip


def fleet_throughput() -> list[dict[str, Any]]:
    """Measure vehicle-seconds per second of a fleet and of the vector environment."""
    problem, byte, steps = IntegrationProblem(25.0), encode_command("ride"), 1000  # all on the road
    commands = np.full((FLEET_SIZE, steps), byte, dtype=np.uint8)
    accelerations = range(ACCELERATION, ACCELERATION + 7)

    def rate(threads: int, columns) -> float:
        fleet = Fleet([problem.new_drive(0.001) for _ in range(FLEET_SIZE)], threads, columns)
        signals, timed = fleet.allocate_signals(steps), cpu_time if threads == 1 else median_time
        return FLEET_SIZE * steps * 0.001 / timed(lambda: fleet.advance(commands, signals), 9)

    one, two, whole = rate(1, accelerations), rate(2, accelerations), rate(1, range(29))
    bare = _kernel_alone(problem, commands[:LANES].T)
    alone = problem.new_drive(0.001)
    single = steps * 0.001 / cpu_time(lambda: alone.advance(commands[0]), 9)
    unit = "vehicle-seconds per second"
    machine = measure_machine()
    ns, peak = 1e6 / one, 2e-9 * machine.one_thread
    operations = STEP_ADDITIONS + STEP_MULTIPLICATIONS + STEP_DIVISIONS
    least = 1e9 * (STEP_ADDITIONS + STEP_COMPARISONS) / machine.one_thread
    share = f"{100 * operations / ns / peak:.0f} % of the core's multiply-adds"
    step_cost = (
        f"{operations} operations in {ns:.0f} ns, of which the kernel takes {bare:.0f}, are "
        f"{operations / ns:.0f} of the core's {peak:.0f} GFLOP/s. The {least:.0f} ns that it needs "
        f"for them at least leave out {STEP_LOOK_UPS} look-ups, for which each lane's address and "
        "row go through the units that multiply and add, and the parts of steps on steep road"
    )
    silent = rate(2, range(0)) / rate(1, range(0))
    threads = (
        f"two threads of multiply-adds alone gain {machine.second_thread:.2f} x here, the fleet "
        f"{two / one:.2f} x, and {silent:.2f} x if it writes no signals, which are "
        f"{8e-6 * len(accelerations) * two:.1f} GB/s of both threads"
    )
    return [
        benchmark_row("multiply-adds in registers, one thread", f"{peak:.0f} GFLOP/s", rate=peak),
        benchmark_row("the same, two threads against one", f"{machine.second_thread:.2f} x",
            ratio=machine.second_thread),
        benchmark_row("step of a vehicle in a block of a fleet, kernel alone", f"{bare:.0f} ns",
            "<= 62 ns", bare, step_cost, nanoseconds=bare),
        benchmark_row(f"{FLEET_SIZE} vehicles in a fleet, one core", f"{one:.0f} {unit}, {share}",
            ">= 14000", one, step_cost, rate=one, operations=operations / ns),
        benchmark_row(f"{FLEET_SIZE} vehicles in a fleet, two threads", f"{two:.0f} {unit}",
            ">= 26000", two, threads, rate=two),
        benchmark_row("the same, one core, all 29 signals written", f"{whole:.0f} {unit}",
            rate=whole),
        benchmark_row("fleet against one vehicle at a time, one core", f"{one / single:.1f} x",
            ">= 2.5 x", one / single, ratio=one / single),
        _own_roads(),
        *_vector_environment(one, bare, 1e-9 * machine.one_thread),
    ]  # fmt: skip


def _kernel_alone(problem: IntegrationProblem, commands: np.ndarray) -> float:
    """Return the time [ns] per vehicle and step of one block under `commands` (n, LANES)."""
    fleet = Fleet([problem.new_drive() for _ in range(LANES)], 1, range(0))
    (block,), signals = fleet.blocks, fleet.allocate_signals(len(commands))[0]
    inputs = block.drive_inputs(np.ascontiguousarray(commands))

    def run() -> None:
        integrate_lanes(block.lanes, block.roads, inputs, fleet.columns, signals)

    return 1e9 * cpu_time(run, 21) / (LANES * len(commands))


def _own_roads() -> dict[str, Any]:
    """Time a fleet over a road each, where a block divides a step as soon as one vehicle must."""
    problem, steps = IntegrationProblem(0.0), 500
    roads = [load_road("iso_d").realise(np.random.default_rng(k)) for k in range(FLEET_SIZE)]
    drives = [DriveSimulator(problem.plant, problem.car, z, SPEED, MODE, 0.001) for z in roads]
    at = drives[0].start - np.array([[0.0], [problem.car.wheelbase]])
    s = at + SPEED * 0.001 * np.arange(steps * 10)
    rise = [SPEED * (z.slope(s + 0.0005 * SPEED) - z.slope(s)) for z in roads]
    steep = (np.abs(rise) > MAX_RATE_CHANGE).any(axis=(1, 2))
    share = 100.0 * steep.reshape(-1, LANES, s.shape[1]).any(axis=1).mean()
    fleet = Fleet(drives, 1, range(ACCELERATION, ACCELERATION + 7))
    commands = np.full((FLEET_SIZE, steps), encode_command(MODE), dtype=np.uint8)
    signals = fleet.allocate_signals(steps)
    ns = 1e9 * cpu_time(lambda: fleet.advance(commands, signals), 9) / (FLEET_SIZE * steps)
    return benchmark_row(
        f"{FLEET_SIZE} vehicles over a class-D road each at {3.6 * SPEED:g} km/h, one core",
        f"{ns:.0f} ns per vehicle and ms; {share:.0f} % of the blocks' steps, "
        f"{100 * steep.mean():.1f} % of the vehicles', take {SUBSTEPS} parts more",
        nanoseconds=ns,
        share=share,
    )


def _vector_environment(fleet_rate: float, kernel_ns: float, per_ns: float) -> list[dict[str, Any]]:
    """Measure the vector environment; the core takes `per_ns` multiply-adds in a nanosecond."""
    from road_envs.envs.vector import RoadReconVectorEnv

    envs = RoadReconVectorEnv(N_ENVIRONMENTS, road="iso_d", truth=False)
    envs.reset(seed=0)
    actions, steps = np.zeros(N_ENVIRONMENTS, dtype=int), 20

    def drive() -> None:
        for _ in range(steps):
            envs.step(actions)

    rate = N_ENVIRONMENTS * steps * envs.setup.interval / cpu_time(drive, 9)
    noise, streams = aligned_zeros(3, 50), np.random.default_rng(0).spawn(LANES)
    state = np.stack([generator_state(stream) for stream in streams], axis=1)
    drawing = 1e9 * cpu_time(lambda: fill_normal(state, LANES, noise), 99) / (50 * LANES)
    ns, percent = 1e6 / rate, 100.0 * rate / fleet_rate
    why = (
        f"of {ns:.0f} ns per vehicle and ms the fleet takes {1e6 / fleet_rate:.0f}, its kernel "
        f"{kernel_ns:.0f}, and {drawing:.1f} three normal numbers as NumPy draws them: a product "
        "of 128 bits, two look-ups and a branch each, which vehicles take in turn; with these "
        f"alone it would be {100 / (1 + 1e-6 * drawing * fleet_rate):.0f} %. The rest are "
        f"{ENVIRONMENT_OPERATIONS} operations that filter, sum costs and look for failures, at "
        f"least {ENVIRONMENT_OPERATIONS / per_ns:.1f} ns, and "
        f"{4 * envs.fleet.observation_size / 50:.0f} bytes of observations"
    )
    unit = "vehicle-seconds per second"
    return [
        benchmark_row(
            f"vector environment, {N_ENVIRONMENTS} vehicles, observations included",
            f"{rate:.0f} {unit}", ">= 12600", rate, why, rate=rate,
        ),
        benchmark_row(
            "the same against the fleet", f"{percent:.0f} %", ">= 90 %", percent, why, share=percent
        ),
    ]  # fmt: skip


def environment_overhead() -> list[dict[str, Any]]:
    """Measure a step of the scalar environment, and its overhead over the drive alone."""
    from road_envs.envs.road_recon import RoadReconEnv

    env = RoadReconEnv(road="iso_d", length=1000.0)
    env.reset(seed=0)
    setup, commands = env.setup, np.zeros(50, dtype=np.uint8)
    surface = setup.road.realise(np.random.default_rng(0))
    drive = DriveSimulator(setup.plant, setup.car, surface, 14.5 / 3.6)
    step = cpu_time(lambda: [env.step(0) for _ in range(100)], 9) / 100
    motion = cpu_time(lambda: [drive.advance(commands) for _ in range(100)], 9) / 100
    rest = 1e6 * (step - motion)
    fleet = Fleet([DriveSimulator(setup.plant, setup.car, surface, 14.5 / 3.6)], 1, range(29))
    signals, one = fleet.allocate_signals(50), commands[None]
    block = cpu_time(lambda: [fleet.advance(one, signals) for _ in range(100)], 9) / 100
    return [
        benchmark_row("environment step of 50 ms", f"{1e6 * step:.0f} µs", microseconds=1e6 * step),
        benchmark_row(
            "the same beyond the drive alone", f"{rest:.0f} µs", "<= 15 µs", rest,
            "for results equal to the vector environment, one vehicle is simulated in a block of "
            f"eight lanes, which takes {1e6 * (block - motion):.0f} µs more than the drive alone",
            microseconds=rest,
        ),
    ]  # fmt: skip


PPO_SCRIPT = """
import time
import numpy as np, torch
from stable_baselines3 import PPO
from road_envs.envs.sb3 import RoadReconVecEnv
from road_envs.policies.feature_env import FeatureVecEnv

torch.set_num_threads(1)
observe = ["accelerations", "planar", "struts"]
case = {"road": "iso_d", "control": "axle", "truth": False, "observe": observe}
envs = RoadReconVecEnv(64, **case)
envs = FeatureVecEnv(envs, 0, action_repeat=25, paired_baseline=True)
model = PPO("MlpPolicy", envs, n_steps=15, batch_size=480, n_epochs=10, device="cpu")
model.learn(480)
begin = time.process_time()
model.learn(1920, reset_num_timesteps=False)
middle = time.process_time()
for _ in range(60):
    envs.step(np.zeros(32, dtype=int))
print(middle - begin, time.process_time() - middle)
"""


def training_cost() -> list[dict[str, Any]]:
    """Measure PPO with the settings of the shipped policy, and its environments alone."""
    what = "PPO, a million environment steps, and as many of paired baselines"
    try:
        out = run_in_new_process(PPO_SCRIPT, OMP_NUM_THREADS="1")
    except subprocess.CalledProcessError:
        return [benchmark_row(what, "skipped: pip install road-envs[learn]")]
    whole, simulated = (1e6 * float(x) / (60 * 32 * 25) for x in out.split())
    why = (
        f"the environments take {simulated:.0f} CPU-s of it, the networks' updates and choices in "
        f"Stable-Baselines3 {whole - simulated:.0f}"
    )
    return [
        benchmark_row(
            what, f"{whole:.0f} CPU-s", "<= 25", whole, why,
            seconds=whole, environments=simulated,
        )
    ]  # fmt: skip
