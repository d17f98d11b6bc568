"""Processor time until the first step, and memory and time of long drives, in new processes."""

import statistics
import tempfile
from typing import Any

from studies.bench.speed import benchmark_row, run_in_new_process

HELP_SCRIPT = """
import contextlib, io, sys, time
from leaderboard import cli
sys.argv = ["road-recon", "--help"]
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
    cli.main()
print(time.process_time())
"""

MAKE_SCRIPT = """
import sys, time
import gymnasium, road_envs
env = gymnasium.make("RoadRecon-v0")
print(float("nan") if "torch" in sys.modules else time.process_time())
"""

FIRST_STEP_SCRIPT = """
import time
import gymnasium, road_envs
env = gymnasium.make("RoadRecon-v0")
env.reset(seed=0)
env.step(0)
print(time.process_time())
"""

IMPORTS_SCRIPT = """
import time
import gymnasium, numba, pydantic, scipy.special, yaml
print(time.process_time())
"""

HOUR_SCRIPT = """
import resource
import gymnasium, road_envs
env = gymnasium.make("RoadRecon-v0", road="iso_d", max_episode_steps=10**9).unwrapped
env.reset(seed=0)
def drive(steps):
    for k in range(steps):
        *_, terminated, truncated, info = env.step(k % 2)
        if terminated or truncated:
            env.reset()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
begin = drive(12_000)
print((drive(60_000) - begin) / 1024)
"""


def start_up_cost() -> list[dict[str, Any]]:
    """Measure help, import and first step, as CPU time of a new interpreter, and its growth.

    What the libraries take to import, without any code of this project, is the limit of the rest.
    """

    def seconds(script: str, times: int = 3, **variables: str) -> float:
        return statistics.median(
            float(run_in_new_process(script, **variables)) for _ in range(times)
        )

    with tempfile.TemporaryDirectory() as folder:
        cold = seconds(FIRST_STEP_SCRIPT, 1, XDG_CACHE_HOME=folder)
        warm = seconds(FIRST_STEP_SCRIPT, XDG_CACHE_HOME=folder)
        make = seconds(MAKE_SCRIPT, XDG_CACHE_HOME=folder)
    help_text, imports = seconds(HELP_SCRIPT), seconds(IMPORTS_SCRIPT)
    grown = float(run_in_new_process(HOUR_SCRIPT))
    limit = (
        f"its libraries alone take {imports:.2f} s to import, a quarter of it SciPy's special "
        "functions, which import all of NumPy; Numba takes 0.05 s to load what it compiled"
    )
    rows = [
        ("road-recon --help", help_text, 0.3, limit),
        ("import road_envs and gym.make, without torch", make, 0.5, limit),
        ("first step, with compiled code", warm, 0.6, limit),
        ("first step, without compiled code", cold, 8.0,
            "some sixty kernels are typed and lowered by Numba, in Python, and optimised by LLVM"),
    ]  # fmt: skip
    return [
        *(
            benchmark_row(what, f"{x:.2f} CPU-s", f"<= {aim:g}", x, why, seconds=x)
            for what, x, aim, why in rows
        ),
        benchmark_row("libraries of the environment, imported alone", f"{imports:.2f} CPU-s"),
        benchmark_row(
            "memory gained in the last 50 minutes of an hour's driving",
            f"{grown:.1f} MiB", "<= 5 MiB", grown, mib=grown,
        ),
    ]  # fmt: skip
