"""Cost against work: processor time by vehicles, length of the road, entries and rows of a board.

    python -m studies.scaling --out FILE.png

A slope of 1 on logarithmic scales is a cost in proportion to the work. Below 1, a part of the cost
is the same for any work; above, the cost of a piece of work grows with their number.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.table import Table

import estimators
from estimators.baselines.flat import FlatEstimator
from leaderboard.commands import check_output_path, console, notices, print_json, progress_bar
from leaderboard.commands.options import Json
from leaderboard.evaluation import evaluate, store
from leaderboard.evaluation.results import Result
from leaderboard.evaluation.tasks import Task, load_task
from leaderboard.report.plots import write_figure
from leaderboard.report.sentences import build_report
from leaderboard.report.site import write_site
from leaderboard.running.board import load_board
from road_envs.core.atomic_io import TempFolder, write_text
from road_envs.core.extras import optional_import
from road_envs.drives.recording import simulate_record
from road_envs.roads import load_road, with_length
from road_envs.simulation.rosenbrock import ACCELERATION
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import encode_command
from studies.bench.fleet import Fleet
from studies.bench.integrators import IntegrationProblem

VEHICLES, STEPS = (64, 128, 256, 512, 1024, 2048), 250
LENGTHS, SPEED_KMH = (50.0, 100.0, 200.0, 400.0), 54.0
"""Lengths [m] of the estimated roads; a simulation is SIMULATED times as long."""
SIMULATED = 4.0
ENTRIES = (2, 4, 8, 16, 32)
ROWS = (16, 32, 64, 128)
ESTIMATORS = ("map_smoother", "kalman_lag", "wiener", "tcn", "fir_ridge")


class CostCurve(NamedTuple):
    """Processor time `seconds` of `what` for each amount of `work` in a `unit`."""

    what: str
    unit: str
    work: tuple[float, ...]
    seconds: tuple[float, ...]

    @property
    def slope(self) -> float:
        """Slope of the straight line through the logarithms, by least squares."""
        return float(np.polyfit(np.log(self.work), np.log(self.seconds), 1)[0])

    @property
    def last_slope(self) -> float:
        """Slope of the logarithms between the two largest amounts of work."""
        return float(np.diff(np.log(self.seconds))[-1] / np.diff(np.log(self.work))[-1])

    def row(self) -> dict[str, Any]:
        """Return the curve and its slope as JSON types."""
        return {**self._asdict(), "slope": self.slope, "last_slope": self.last_slope}


def measurements() -> list[Callable[[], CostCurve]]:
    """Return the functions that measure a curve each."""
    estimations = [partial(_estimator, name) for name in ESTIMATORS]
    return [_vehicles, _simulation, *estimations, _entries, _rows]


def _curve(
    what: str, unit: str, work: Sequence[float], prepare: Callable[[Any], Callable[[], object]]
) -> CostCurve:
    """Time what `prepare` returns for each amount of work, after one run with the least."""
    prepare(work[0])()
    seconds = []
    for amount in work:
        run = prepare(amount)
        spans: list[float] = []
        while len(spans) < 2 or (len(spans) < 3 and sum(spans) < 0.5):
            begin = time.process_time()
            run()
            spans.append(time.process_time() - begin)
        seconds.append(min(spans))
    return CostCurve(what, unit, tuple(map(float, work)), tuple(seconds))


def _vehicles() -> CostCurve:
    problem, byte = IntegrationProblem(10.0), encode_command("ride")

    def prepare(n: int) -> Callable[[], object]:
        columns = range(ACCELERATION, ACCELERATION + 7)
        fleet = Fleet([problem.new_drive(0.001) for _ in range(n)], 1, columns)
        signals = fleet.allocate_signals(STEPS)
        commands = np.full((n, STEPS), byte, dtype=np.uint8)
        return lambda: fleet.advance(commands, signals)

    return _curve(f"fleet, {1e-3 * STEPS:g} s", "vehicles", VEHICLES, prepare)


def _drive(metres: float) -> Any:
    road = with_length(load_road("iso_d"), metres)
    return simulate_record(road, speed_kmh=SPEED_KMH, mode="ride", seed=1)[0]


def _simulation() -> CostCurve:
    work = [SIMULATED * length for length in LENGTHS]
    return _curve("simulate_record", "m", work, lambda metres: lambda: _drive(metres))


def _estimator(name: str) -> CostCurve:
    estimator, car = estimators.create(name), load_vehicle("land_rover_defender_110")

    def prepare(metres: float) -> Callable[[], object]:
        record = _drive(metres)
        return lambda: estimator.estimate(record, car)

    return _curve(name, "m", LENGTHS, prepare)


def _small_task() -> Task:
    """Return the first condition of the main board, on roads of 50 m."""
    task = load_task("new_road")
    test = dataclasses.replace(task.test, number=4, design=(), length=50.0)
    return dataclasses.replace(task, conditions=task.conditions[-1:], test=test, title="Rows")


def _entries() -> CostCurve:
    task = _small_task()

    def prepare(n: int) -> Callable[[], object]:
        entries = {f"entry_{k}": FlatEstimator() for k in range(n)}
        return lambda: evaluate.run_task(task, entries, (1,))

    return _curve("evaluation of 4 drives", "entries", ENTRIES, prepare)


def _rows() -> CostCurve:
    task = _small_task()
    (result,) = evaluate.run_task(task, {"flat": FlatEstimator()}, (1,))
    with TempFolder() as folder:

        def prepare(n: int) -> Callable[[], object]:
            store_rows(task, result, n, folder / str(n))
            return lambda: write_board(task, folder / str(n))

        return _curve("tables and site", "rows", ROWS, prepare)


def store_rows(task: Task, result: Result, n: int, out: Path) -> None:
    """Store a result `n` times, as of different entries."""
    for k in range(n):
        row = dataclasses.replace(result, estimator=f"entry_{k:05d}", role="entry")
        write_text(store.row_path(out, task.name, row.estimator), store.to_text(row))


def write_board(task: Task, out: Path) -> None:
    """Read the stored rows; compute all tables and write the site."""
    board = load_board([task], out)
    write_site(board, build_report(board), out)


def draw(curves: Sequence[CostCurve], path: Path) -> None:
    """Draw the curves by unit on logarithmic scales, with a line of slope 1 in each panel."""
    with optional_import("a figure"):
        from matplotlib.ticker import LogLocator

    units = list(dict.fromkeys(curve.unit for curve in curves))

    def paint(figure: Any) -> None:
        for axes, unit in zip(figure.subplots(2, 2).ravel(), units, strict=True):
            shown = [curve for curve in curves if curve.unit == unit]
            for curve in shown:
                label = f"{curve.what}: {curve.slope:.2f}"
                axes.loglog(curve.work, curve.seconds, marker="o", ms=3.5, lw=1.2, label=label)
            ticks = sorted({x for curve in shown for x in curve.work})
            x = np.array([ticks[0], ticks[-1]])
            y = max(curve.seconds[0] for curve in shown) * 1.6
            axes.loglog(x, y * x / x[0], color="0.6", ls="--", lw=1.0, label="slope 1")
            axes.set_xticks(ticks, [f"{x:g}" for x in ticks])
            axes.minorticks_off()
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.set_xlabel(unit if unit != "m" else "length of the road [m]")
            axes.set_ylabel("processor time [s]")
            axes.grid(True, which="major", color="0.92")
            axes.legend(frameon=False, fontsize=7)

    write_figure(paint, (10.0, 8.0), path)


def scaling(
    out: Annotated[Path | None, typer.Option(help="Plot to write (.png, .svg or .pdf).")] = None,
    json: Json = False,
) -> None:
    """Measure time against vehicles, length, entries and rows, with the slopes."""
    check_output_path(out, ".png", ".svg", ".pdf")
    curves, measured = [], measurements()
    with progress_bar() as progress:
        for measure in measured:
            curves.append(measure())
            progress(curves[-1].what, len(curves) / len(measured))
    if out:
        draw(curves, out)
    if json:
        print_json([curve.row() for curve in curves])
        return
    heads = ("CPU time of", "from", "to", "slope", "last two")
    table = Table(*heads, title="cost against work", box=None)
    for curve in curves:
        first, last = (
            f"{1e3 * curve.seconds[k]:.3g} ms, {curve.work[k]:g} {curve.unit}" for k in (0, -1)
        )
        table.add_row(curve.what, first, last, f"{curve.slope:.2f}", f"{curve.last_slope:.2f}")
    console.print(table)
    if out:
        notices.print(f"plot: {out}")


if __name__ == "__main__":
    typer.run(scaling)
