"""Largest heave acceleration that adaptive solvers find over an isolated bump.

    python -m studies.missed_bumps

At rest on level ground every error estimate is zero, so that steps grow until a bump fits between
two of them. A solver that is not installed is left out.
"""

import math

import numpy as np
import typer

from leaderboard.commands import console, make_table, notices
from road_envs.roads import load_road
from studies.bench.integrators import IntegrationProblem, PeerError

ROAD, DURATION = "bump_small", 2.5
"""Road and duration [s] of the drive."""

CASES = ((1e-3, math.inf), (1e-6, math.inf), (1e-3, 0.01))
"""Relative tolerance and longest step [s] of each column."""

METHODS = ("RK45", "DOP853", "LSODA", "BDF", "Radau")


def largest_heave(name: str, rtol: float, max_step: float) -> float:
    """Largest heave acceleration [m/s²] that a method of SciPy, or CVODE, finds over the bump.

    Raises PeerError if CVODE is not installed.
    """
    surface = load_road(ROAD).realise(np.random.default_rng(1))
    problem = IntegrationProblem(DURATION, surface, max_step)
    found = problem.cvode(rtol) if name == "CVODE" else problem.scipy(name, rtol)
    return float(np.abs(found[:, 0]).max())


def main() -> None:
    """Print what each solver finds, with free and with limited steps, and the truth."""
    rows = []
    for name in (*METHODS, "CVODE"):
        try:
            found = [f"{largest_heave(name, *case):.1f}" for case in CASES]
        except PeerError as error:
            notices.print(f"{name} is skipped: {error}")
            continue
        rows.append((f"{'SUNDIALS' if name == 'CVODE' else 'SciPy'} {name}", *found))
    heads = [
        f"rtol {rtol:g}{'' if math.isinf(step) else f', steps to {1e3 * step:g} ms'}"
        for rtol, step in CASES
    ]
    truth = largest_heave("DOP853", 1e-9, 1e-3)
    title = f"largest heave acceleration over {ROAD} [m/s²], {truth:.1f} in truth"
    console.print(make_table(("method", *heads), rows, title=title))


if __name__ == "__main__":
    typer.run(main)
