"""`leaderboard`: judge estimators on tasks, print the tables, write the page."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

import estimators
from leaderboard.commands import console, notices, print_json, progress_bar
from leaderboard.commands.simulate import Json
from leaderboard.evaluation.entries import resolve_entries
from leaderboard.evaluation.entry import Entry
from leaderboard.evaluation.evaluate import SEEDS
from leaderboard.evaluation.surface_tasks import surface_tasks
from leaderboard.evaluation.tasks import Task, load_task, shipped_tasks
from leaderboard.metrics.baselines import BASELINES
from leaderboard.report.board_definitions import BOARDS
from leaderboard.report.cache import Report, build_report
from leaderboard.report.site import write_site
from leaderboard.report.terminal import as_json, print_tables
from leaderboard.running.board import Board, RunRequest, render_with_retry, run_board, write_jobs
from leaderboard.running.dask_executor import DaskExecutor
from leaderboard.running.executors import Executor, ProcessExecutor
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs.config import ConfigError, validate_choice

CORES = os.cpu_count() or 1


def leaderboard(
    task: Annotated[
        list[str] | None,
        typer.Option(help="Task: shipped name or YAML path; may be given again."),
    ] = None,
    board: Annotated[
        list[str] | None,
        typer.Option(help=f"Board: {', '.join(BOARDS)}; may be given again. Default: all."),
    ] = None,
    road: Annotated[
        list[Path] | None,
        typer.Option(help="Train and score on this surface file instead; may be given again."),
    ] = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option(help="Estimator, or a file from `train`; may be given again. Default: all."),
    ] = None,
    without: Annotated[
        list[str] | None, typer.Option(help="Estimator that is left out; may be given again.")
    ] = None,
    roads: Annotated[
        int | None, typer.Option(help="Test drives per condition where roads are drawn.", min=2)
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="All test drives of every task: 50 and more roads.")
    ] = False,
    seeds: Annotated[int, typer.Option(help="Trainings of each learner.", min=1)] = len(SEEDS),
    again: Annotated[
        bool, typer.Option("--again", help="Run everything, also what is stored and still valid.")
    ] = False,
    probes: Annotated[
        bool, typer.Option("--probes", help="Probe entries that have no card yet, on this machine.")
    ] = False,
    workers: Annotated[int, typer.Option(help="Jobs at a time on this machine.", min=1)] = CORES,
    dask: Annotated[
        str | None, typer.Option(help="Run on the Dask cluster of this scheduler instead.")
    ] = None,
    plan: Annotated[
        Path | None, typer.Option(help="Write jobs for `run-job` into this folder, run nothing.")
    ] = None,
    time_limit: Annotated[
        float, typer.Option(help="Seconds an entry may take under one condition.")
    ] = Limits.seconds,
    memory_limit: Annotated[float, typer.Option(help="GiB an entry may hold.")] = Limits.memory,
    out: Annotated[Path, typer.Option(help="Folder for results and page.")] = Path(
        "out/leaderboard"
    ),
    json: Json = False,
) -> None:
    """Judge estimators: one result file per task and estimator, tables, and a page.

    Every entry runs in a process of its own. What is stored and still valid is kept.
    """
    if full and roads:
        raise ConfigError("give either --roads or --full, not both")
    chosen = _tasks(task, board, road)
    if full:
        chosen = [
            one.with_test_drives(None) if one.has_several_test_drives else one for one in chosen
        ]
    limits = parse_limits(time_limit, memory_limit)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file; a folder for results and page is wanted")
    entries = _entries(estimator, without or [], limits)
    request = RunRequest(chosen, entries, range(1, seeds + 1), roads, not again, limits, probes)
    if plan:
        notices.print(f"jobs planned in {plan}: {write_jobs(request, out, plan)}")
        return
    executor: Executor = DaskExecutor(dask) if dask else ProcessExecutor(workers)
    with progress_bar() as progress:
        judged = run_board(
            request,
            out,
            executor,
            progress=lambda done, total, text: progress(text, done / max(total, 1)),
        )
        progress("writing the page", 1.0)
        found, page = render_with_retry(judged, request, out, lambda board: _write(board, out))
    if json:
        print_json(as_json(found))
    else:
        print_tables(found, console)
        notices.print(f"page: {page}")


def _write(board: Board, out: Path) -> tuple[Report, Path]:
    """Write the page of a board; returns what it shows and where it stands."""
    found = build_report(board, out)
    return found, write_site(board, found, out)


def _tasks(
    names: list[str] | None, boards: list[str] | None, roads: list[Path] | None
) -> list[Task]:
    if sum(map(bool, (names, boards, roads))) > 1:
        raise ConfigError("give one of --task, --board and --road")
    if roads:
        return [task for road in roads for task in surface_tasks(road)]
    boards = [name.replace("-", "_") for name in boards or []]
    for name in boards:
        validate_choice("board", name, list(BOARDS))
    if "measured" in boards:
        raise ConfigError("the board of measured surfaces needs files: use --road")
    if names:
        return [load_task(name) for name in names]
    return [task for task in shipped_tasks() if not boards or task.board in boards]


def _entries(names: Sequence[str] | None, without: Sequence[str], limits: Limits) -> list[Entry]:
    if names and without:
        raise ConfigError("give either --estimator or --without, not both")
    for name in without:
        validate_choice("estimator", name, estimators.names())
    untaught = estimators.without_weights()
    left_out = {*BASELINES, *untaught, *without}
    chosen = names or [name for name in estimators.names() if name not in left_out]
    if untaught and not names:
        notices.print(f"left out, since their weights do not ship: {', '.join(untaught)}")
    if all(name in estimators.REGISTRY for name in chosen):
        return resolve_entries(chosen, None)
    with SandboxClient(limits) as sandbox:
        return resolve_entries(chosen, sandbox)


def parse_limits(seconds: float, memory: float) -> Limits:
    """Limits as given on the command line. Raises ConfigError."""
    try:
        return Limits(seconds=seconds, memory=memory)
    except ValueError as error:
        raise ConfigError(f"limits: {error}") from None
