"""Work-precision diagram of the integrators and of other packages.

python -m studies.work_precision --out FILE.png
"""

import functools
import math
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table

from leaderboard.commands import (
    check_output_path,
    console,
    make_table,
    notices,
    print_json,
    progress_bar,
)
from leaderboard.commands.options import Json
from leaderboard.report.figures import rounded
from leaderboard.report.plots import write_figure
from road_envs.core.config import ConfigError
from road_envs.roads import load_road
from studies.bench.integrators import (
    MODE,
    SPEED,
    IntegrationProblem,
    PeerError,
    relative_error,
)

OURS = ("ours, constant step", "ours, adaptive")
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5)
SCIPY = {"RK45": TOLERANCES, "DOP853": TOLERANCES, "LSODA": TOLERANCES,
         "BDF": TOLERANCES[:3], "Radau": TOLERANCES[:3]}  # fmt: skip
OCTAVE = "Octave ode23s"

Timed = Callable[[float], tuple[np.ndarray, float]]


def precision(
    out: Annotated[
        Path | None, typer.Option(help="Plot of error over cost to write (.png).")
    ] = None,
    duration: Annotated[
        float, typer.Option(help="Duration in seconds; the road begins at 0.33 s.", min=0.5)
    ] = 3.0,
    road: Annotated[
        str | None,
        typer.Option(help="Road: a name of `road-recon list roads`, YAML or surface file."),
    ] = None,
    max_step: Annotated[
        float, typer.Option(help="Longest step in seconds of adaptive solvers.")
    ] = math.inf,
    json: Json = False,
) -> None:
    """Measure error over cost of the integrators and of other packages on one drive."""
    check_output_path(out, ".png", ".svg", ".pdf")
    if not max_step > 0:
        raise ConfigError(f"the longest step must be positive, got {max_step} s")
    surface = None if road is None else load_road(road).realise(np.random.default_rng(1))
    problem, rows, skipped = IntegrationProblem(duration, surface, max_step), [], []
    with progress_bar() as progress:
        progress("reference", 0.0)
        truth = problem.scipy("DOP853", 1e-9)
        methods = list(_methods(problem))
        for k, (name, unit, settings, run) in enumerate(methods):
            progress(name, (k + 1) / (len(methods) + 1))
            try:
                for setting in settings:
                    a, seconds = run(setting)
                    rows.append({"method": name, unit: setting, "error": relative_error(a, truth),
                                 "times_real_time": duration / seconds})  # fmt: skip
            except PeerError as error:
                skipped.append({"method": name, "skipped": str(error)})
    if out is not None:
        draw_precision(rows, OURS, f"{problem.surface.name}, {SPEED:g} m/s, {MODE}", out)
    if json:
        print_json(rows + skipped)
        return
    console.print(_table(rows))
    console.print()
    console.print(_speeds(rows))
    for row in skipped:
        notices.print(f"{row['method']} is skipped: {row['skipped']}")


def _methods(problem: IntegrationProblem) -> Iterator[tuple[str, str, tuple[float, ...], Timed]]:
    """Yield name, name of the setting, values of the setting, and a timed run for one value."""
    steps = (1e-3, 5e-4, 2.5e-4, 1.25e-4)
    yield OURS[0], "step", steps, lambda h: _timed(problem.fixed_step, h)
    yield OURS[1], "rtol", (1e-1, *TOLERANCES), lambda r: _timed(problem.adaptive, r)
    for name, tolerances in SCIPY.items():
        run = functools.partial(problem.scipy, name)
        yield f"SciPy {name}", "rtol", tolerances, functools.partial(_timed, run)
    yield "SUNDIALS CVODE", "rtol", TOLERANCES, lambda r: _timed(problem.cvode, r)
    yield OCTAVE, "rtol", TOLERANCES[:2], problem.octave


def _timed(run: Callable[[float], np.ndarray], setting: float) -> tuple[np.ndarray, float]:
    """Return the solution and the median CPU time [s] of at least three runs and half a second."""
    a = run(setting)  # the first run may have to compile
    times: list[float] = []
    while len(times) < 3 or sum(times) < 0.5:
        begin = time.process_time()
        run(setting)
        times.append(time.process_time() - begin)
    return a, statistics.median(times)


def _table(rows: list[dict[str, Any]]) -> Table:
    def cells(row: dict[str, Any]) -> tuple[str, ...]:
        setting = f"h = {1e3 * row['step']:g} ms" if "step" in row else f"rtol {row['rtol']:g}"
        speed = f"{rounded(row['times_real_time'], 3):g}"
        return row["method"], setting, f"{100 * row['error']:.3g} %", speed

    heads = ("method", "setting", "error", "x real time")
    return make_table(heads, map(cells, rows), title="error against cost", texts=("setting",))


def speeds_at_equal_error(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Speed of each method [times real time] at the error of our largest constant step.

    Interpolated between the rows of a method in log error and log speed; NaN for one whose errors
    do not enclose that error.
    """
    error = max(row["error"] for row in rows if row["method"] == OURS[0])
    speeds = {}
    for name in dict.fromkeys(row["method"] for row in rows):
        points = sorted(
            (row["error"], row["times_real_time"]) for row in rows if row["method"] == name
        )
        known, speed = np.log(points).T
        at = np.interp(math.log(error), known, speed, left=math.nan, right=math.nan)
        speeds[name] = math.exp(at)
    return speeds


def _speeds(rows: list[dict[str, Any]]) -> Table:
    speeds = speeds_at_equal_error(rows)
    fastest = speeds[OURS[0]]
    error = max(row["error"] for row in rows if row["method"] == OURS[0])
    cells = [
        (name, *(f"{rounded(x, 2):g}" for x in (speed, fastest / speed)))
        for name, speed in speeds.items()
        if math.isfinite(speed) and name != OURS[0]
    ]
    title = f"speed at {100 * error:.3g} % error, that of h = 1 ms"
    return make_table(("method", "x real time", "h = 1 ms is faster by"), cells, title=title)


def draw_precision(
    rows: list[dict[str, Any]], ours: tuple[str, ...], drive: str, path: Path
) -> None:
    """Plot error over cost of every method, one line each; `ours` are emphasised."""

    def paint(figure: Any) -> None:
        axes = figure.subplots()
        for k, name in enumerate(dict.fromkeys(row["method"] for row in rows)):
            chosen = [row for row in rows if row["method"] == name]
            cost = [1.0 / row["times_real_time"] for row in chosen]
            error = [100.0 * row["error"] for row in chosen]
            style = {"lw": 2.4, "ms": 7} if name in ours else {"lw": 1.1, "ms": 5}
            axes.loglog(cost, error, "os^Dv<>Pp"[k % 9] + "-", label=name, color=f"C{k}", **style)
        axes.set(
            xlabel="seconds of computing for one second of driving",
            ylabel="error of the body's accelerations [%]",
            title=f"{drive}: error against cost",
        )
        axes.grid(which="major", color="0.9")
        axes.legend(frameon=False)

    write_figure(paint, (8.5, 5.5), path)


if __name__ == "__main__":
    typer.run(precision)
