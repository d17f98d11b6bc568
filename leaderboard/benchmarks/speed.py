"""Speed and memory of the simulator, as measured by `bench`: integrators, fleet, environments.

Absolute times on a shared machine are unreliable, so results are ratios of medians of one run where
possible. A row that misses its target states why.
"""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from leaderboard.benchmarks.integrators import IntegrationProblem, PeerError, relative_error
from leaderboard.benchmarks.machine import measure_machine
from road_envs.simulation.fleet import Fleet, integrate_lanes
from road_envs.simulation.lanes import aligned_zeros
from road_envs.simulation.normal_numbers import fill_normal, generator_state
from road_envs.simulation.rosenbrock import ACCELERATION
from road_envs.simulation.simd import LANES
from road_envs.vehicle.suspension import encode_command

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

CHAIN_MULTIPLY_ADDS, CHAIN_DIVISIONS = 72, 3
"""Operations in the longest chain of a step, in which each needs the result of the one before."""

TOLERANCES = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5)

COMPILED_NOTE = (
    "the peers call this project's compiled right-hand side and Jacobian on a road with a "
    "continuous slope, where they run 10 to 50 times as fast as with one in Python"
)


def benchmark_row(
    what: str,
    measured: str,
    aim: str = "",
    met: bool | None = None,
    why: str = "",
    **numbers: float,
) -> dict[str, Any]:
    """Return one row of the table; `why` explains a missed target."""
    reason = {"why": why} if why and met is False else {}
    return {"what": what, "measured": measured, "aim": aim, "met": met, **reason, **numbers}


def median_time(run: Callable[[], object], times: int = 5) -> float:
    """Return the median time [s] of `run`, after one warm-up run."""
    run()
    spans = []
    for _ in range(times):
        begin = time.perf_counter()
        run()
        spans.append(time.perf_counter() - begin)
    return statistics.median(spans)


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
    seconds = median_time(lambda: problem.fixed_step(0.001), 21)
    accuracy = relative_error(problem.fixed_step(0.001), reference)
    rows = [
        _one_vehicle(),
        benchmark_row(
            "error of body acceleration at 1 ms", f"{100 * accuracy:.2f} %", error=accuracy
        ),
    ]
    peers: dict[str, tuple[Callable[[float], Any], float | None]] = {
        "SciPy LSODA": (lambda rtol: problem.scipy("LSODA", rtol), 65.0),
        "SUNDIALS CVODE": (problem.cvode, 50.0),
        "SciPy Radau": (lambda rtol: problem.scipy("Radau", rtol), None),
    }
    for name, (solve, aim) in peers.items():
        rows.append(_compare_with(name, solve, aim, reference, accuracy, seconds))
    try:
        _, octave_seconds = problem.octave(1e-3)
        ratio = octave_seconds / seconds
        rows.append(
            benchmark_row(
                "against Octave ode23s (rtol 1e-3)",
                f"{ratio:.0f} x faster",
                ">= 27000 x",
                ratio >= 27000,
                ratio=ratio,
            )
        )
    except PeerError as error:
        rows.append(benchmark_row("against Octave ode23s", f"skipped: {error}"))
    return rows


def _one_vehicle() -> dict[str, Any]:
    """Time a drive of 10 s, and bound it by the machine's measured throughput and latency."""
    problem = IntegrationProblem(10.0)
    commands = np.full(problem.t.size, encode_command("ride"), dtype=np.uint8)
    spans = []
    for _ in range(31):
        drive = problem.new_drive()
        begin = time.process_time()
        drive.advance(commands)
        spans.append(time.process_time() - begin)
    factor, machine = 10.0 / statistics.median(spans), measure_machine()
    ns = 1e6 / factor
    # at best every multiplication is part of a multiply-add
    instructions = STEP_ADDITIONS + STEP_COMPARISONS
    throughput = 1e9 * LANES * instructions / machine.one_thread
    chain = 1e9 * (CHAIN_MULTIPLY_ADDS * machine.multiply_add + CHAIN_DIVISIONS * machine.division)
    return benchmark_row(
        "one vehicle, one core, 1 ms step, all signals written",
        f"{factor:.0f} x real time",
        ">= 4000 x",
        factor >= 4000,
        f"a step takes {ns:.0f} ns. It is at least {instructions} instructions, which take "
        f"{throughput:.0f} ns if they wait for nothing; its longest chain, {CHAIN_MULTIPLY_ADDS} "
        f"multiply-adds and {CHAIN_DIVISIONS} divisions that wait for each other, takes "
        f"{chain:.0f} ns; look-ups in tables and moves come on top",
        factor=factor,
        throughput=throughput,
        chain=chain,
    )


def _compare_with(name, solve, aim, reference, accuracy, seconds) -> dict[str, Any]:
    try:
        rtol = next(r for r in TOLERANCES if relative_error(solve(r), reference) < accuracy)
    except PeerError as error:
        return benchmark_row(f"against {name}", f"skipped: {error}")
    ratio = median_time(lambda: solve(rtol), 3) / seconds
    what = f"against {name} (rtol {rtol:g})"
    return benchmark_row(
        what,
        f"{ratio:.0f} x faster",
        "" if aim is None else f">= {aim:.0f} x",
        None if aim is None else ratio >= aim,
        COMPILED_NOTE,
        ratio=ratio,
    )


def fleet_throughput() -> list[dict[str, Any]]:
    """Measure vehicle-seconds per second of a fleet and of the vector environment."""
    problem, byte, steps = IntegrationProblem(25.0), encode_command("ride"), 1000  # all on the road
    commands = np.full((FLEET_SIZE, steps), byte, dtype=np.uint8)
    accelerations = range(ACCELERATION, ACCELERATION + 7)

    def rate(threads: int, columns) -> float:
        fleet = Fleet([problem.new_drive(0.001) for _ in range(FLEET_SIZE)], threads, columns)
        signals = fleet.allocate_signals(steps)
        return FLEET_SIZE * steps * 0.001 / median_time(lambda: fleet.advance(commands, signals), 9)

    one, two, whole = rate(1, accelerations), rate(2, accelerations), rate(1, range(29))
    bare = _kernel_alone(problem, commands[:LANES].T)
    alone = problem.new_drive(0.001)
    single = steps * 0.001 / median_time(lambda: alone.advance(commands[0]), 9)
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
            "<= 62 ns", bare <= 62.0, step_cost, nanoseconds=bare),
        benchmark_row(f"{FLEET_SIZE} vehicles in a fleet, one core", f"{one:.0f} {unit}, {share}",
            ">= 14000", one >= 1.4e4, step_cost, rate=one, operations=operations / ns),
        benchmark_row(f"{FLEET_SIZE} vehicles in a fleet, two threads", f"{two:.0f} {unit}",
            ">= 26000", two >= 2.6e4, threads, rate=two),
        benchmark_row("the same, one core, all 29 signals written", f"{whole:.0f} {unit}",
            rate=whole),
        benchmark_row("fleet against one vehicle at a time, one core", f"{one / single:.1f} x",
            ">= 2.5 x", one >= 2.5 * single, ratio=one / single),
        *_vector_environment(one),
    ]  # fmt: skip


def _kernel_alone(problem: IntegrationProblem, commands: np.ndarray) -> float:
    """Return the time [ns] per vehicle and step of one block under `commands` (n, LANES)."""
    fleet = Fleet([problem.new_drive() for _ in range(LANES)], 1, range(0))
    (block,), signals = fleet.blocks, fleet.allocate_signals(len(commands))[0]
    inputs = block.drive_inputs(np.ascontiguousarray(commands))

    def run() -> None:
        integrate_lanes(block.lanes, block.roads, inputs, fleet.columns, signals)

    return 1e9 * median_time(run, 21) / (LANES * len(commands))


def _vector_environment(fleet_rate: float) -> list[dict[str, Any]]:
    from road_envs.envs.vector import RoadReconVectorEnv

    envs = RoadReconVectorEnv(N_ENVIRONMENTS, road="iso_d", truth=False)
    envs.reset(seed=0)
    actions = np.zeros(N_ENVIRONMENTS, dtype=int)
    steps = 20
    driven = N_ENVIRONMENTS * steps * envs.setup.interval
    rate = driven / median_time(lambda: [envs.step(actions) for _ in range(steps)], 5)
    noise = aligned_zeros(3, 1000)
    state = np.repeat(generator_state(np.random.default_rng(0))[:, None], LANES, axis=1)
    drawing = 1e6 * median_time(lambda: fill_normal(state, LANES, noise), 21) / LANES
    share = rate / fleet_rate
    return [
        benchmark_row(
            f"vector environment, {N_ENVIRONMENTS} vehicles, observations included",
            f"{rate:.0f} vehicle-seconds per second: {100 * share:.0f} % of the fleet",
            ">= 90 %",
            share >= 0.9,
            f"{1e6 / rate:.0f} ns per vehicle and ms, {1e6 / fleet_rate:.0f} of them the drive and "
            f"{drawing:.0f} normal numbers of three accelerometers as NumPy draws them; "
            "the rest filters, sums the costs, and writes observations and infos",
            rate=rate,
            share=share,
        )
    ]


def environment_overhead() -> list[dict[str, Any]]:
    """Measure a step of the scalar environment, and its overhead over the drive alone."""
    from road_envs.envs.road_recon import RoadReconEnv
    from road_envs.simulation.drive import DriveSimulator

    env = RoadReconEnv(road="iso_d", length=1000.0)
    env.reset(seed=0)
    setup, commands = env.setup, np.zeros(50, dtype=np.uint8)
    surface = setup.road.realise(np.random.default_rng(0))
    drive = DriveSimulator(setup.plant, setup.car, surface, 14.5 / 3.6)
    step = median_time(lambda: [env.step(0) for _ in range(100)], 9) / 100
    motion = median_time(lambda: [drive.advance(commands) for _ in range(100)], 9) / 100
    rest = 1e6 * (step - motion)
    fleet = Fleet([DriveSimulator(setup.plant, setup.car, surface, 14.5 / 3.6)], 1, range(29))
    signals, one = fleet.allocate_signals(50), commands[None]
    block = median_time(lambda: [fleet.advance(one, signals) for _ in range(100)], 9) / 100
    return [
        benchmark_row("environment step of 50 ms", f"{1e6 * step:.0f} µs", microseconds=1e6 * step),
        benchmark_row(
            "the same beyond the drive alone",
            f"{rest:.0f} µs",
            "<= 15 µs",
            rest <= 15.0,
            "for results equal to the vector environment, one vehicle is simulated in a block of "
            f"eight lanes, which takes {1e6 * (block - motion):.0f} µs more than the drive alone",
            microseconds=rest,
        ),
    ]


PPO_SCRIPT = """
import time
import numpy as np, torch
from stable_baselines3 import PPO
from road_envs.policies.training import MultiScenarioVecEnv

torch.set_num_threads(1)
observe = ["accelerations", "planar", "struts"]
case = {"road": "iso_d", "control": "axle", "truth": False, "observe": observe}
envs = MultiScenarioVecEnv([case], 32, 0, 10.0, 25, paired_baseline=True)
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
            what, f"{whole:.0f} CPU-s", "<= 25", whole <= 25.0, why,
            seconds=whole, environments=simulated,
        )
    ]  # fmt: skip
