"""Command `leaderboard`: evaluate estimators on tasks, print the tables, write the site."""

import contextlib
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

import estimators
from leaderboard import commands
from leaderboard.commands.options import CORES, Json, LimitOptions, Workers, option
from leaderboard.entries.entries import find_reference, resolve_entries
from leaderboard.entries.entry import Entry
from leaderboard.evaluation.evaluate import SEEDS
from leaderboard.evaluation.tasks import Task, load_task, shipped_tasks
from leaderboard.metrics.baselines import ALL_BASELINES
from leaderboard.report.attainable import with_attainable
from leaderboard.report.board_definitions import board_columns
from leaderboard.report.export import as_json
from leaderboard.report.notes import isolation_notice
from leaderboard.report.rendering import BOARD_PAGE, write_pending
from leaderboard.report.sentences import build_report
from leaderboard.report.site import write_site
from leaderboard.report.terminal import print_tables
from leaderboard.running.board import RunRequest, run_board, write_jobs
from leaderboard.running.dask_executor import DaskExecutor
from leaderboard.running.executors import ProcessExecutor
from leaderboard.running.plan import ReplacedRowError, check_owners
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from leaderboard.surface_tasks import surface_tasks
from road_envs.core.config import ConfigError, names, validate_choice


def leaderboard(
    *,
    task: Annotated[
        list[str] | None,
        option("Task: a name of `road-recon list tasks`, or a YAML path; may be given again."),
    ] = None,
    board: Annotated[
        list[str] | None,
        option(f"Board: {', '.join(names('boards'))}; may be given again. Default: all."),
    ] = None,
    road: Annotated[
        list[Path] | None,
        option("Train and score on this surface file instead; may be given again."),
    ] = None,
    estimator: Annotated[
        list[str] | None,
        option(
            "Estimator: a name of `road-recon list estimators`, module:Class, or path of a "
            "wheel, an installed package or a file from `train`; may be given again. Default: all."
        ),
    ] = None,
    without: Annotated[
        list[str] | None, option("Estimator to exclude; may be given again.")
    ] = None,
    roads: Annotated[
        int | None, option("Test drives per condition on random roads.", min=2)
    ] = None,
    length: Annotated[
        float | None, option("Length of random test roads in metres.", min=50.0)
    ] = None,
    full: Annotated[
        bool, option("All test drives of every task: 50 and more roads.", "--full")
    ] = False,
    seeds: Annotated[int, option("Training seeds of each estimator.", min=1)] = len(SEEDS),
    again: Annotated[
        bool, option("Run everything again, including valid stored results.", "--again")
    ] = False,
    replace: Annotated[
        list[str] | None,
        option(
            "Entry whose stored row may be replaced although other code made it; may be given "
            "again. A terminal is asked."
        ),
    ] = None,
    attainable: Annotated[
        bool,
        option(
            "Also compute the attainable error of each test drive with the nonlinear vehicle: "
            "some seconds per drive, once.",
            "--attainable",
        ),
    ] = False,
    probes: Annotated[
        bool, option("Also run the conformance probes of new entries, on this machine.", "--probes")
    ] = False,
    workers: Workers = CORES,
    dask: Annotated[
        str | None,
        option("Run on the cluster of the Dask scheduler at this address; local: start one here."),
    ] = None,
    plan: Annotated[
        Path | None, option("Write job files for `run-job` into this folder, run nothing.")
    ] = None,
    limits: LimitOptions,
    out: Annotated[Path, option("Folder for results and site.")] = Path("out/leaderboard"),
    json: Json = False,
) -> None:
    """Evaluate estimators: a result file per task and estimator, tables, and a site.

    Every entry runs in a separate process. Valid stored results are not computed again.
    """
    if full and roads:
        raise ConfigError("give either --roads or --full, not both")
    if again and plan:
        raise ConfigError(
            "--plan writes jobs of missing results only: give --again without it, or choose "
            "another --out"
        )
    chosen = _tasks(task, board, road)
    for each in chosen:
        board_columns(each.board_name, each.board_definition)  # refuses unknown ones
    for k, each in enumerate(chosen):
        if each.has_several_test_drives:
            each = each.with_test_drives(None) if full else each
            chosen[k] = each.with_test_length(length) if length else each
    own = limits.parse()
    commands.check_output_folder(out)
    entries = _entries(estimator, without or [], own)
    request = RunRequest(
        chosen, entries, range(1, seeds + 1), roads, not again, own, probes, tuple(replace or ())
    )
    if plan:
        commands.notices.print(f"job files written to {plan}: {write_jobs(request, out, plan)}")
        return
    request = _asked(request, out)
    made = DaskExecutor(dask, workers) if dask else contextlib.nullcontext(ProcessExecutor(workers))
    write_pending(out / BOARD_PAGE, "Estimators", f"leaderboard --out {out}")
    kept = f"results of finished jobs are kept in {out}; the same command continues"
    with made as executor, commands.progress_bar(kept) as progress:
        evaluated = run_board(request, out, executor, progress)
        if attainable:
            evaluated = with_attainable(evaluated, lambda text: progress(text, 1.0))
        progress("writing the site", 1.0)
        report = build_report(evaluated)
        page = write_site(evaluated, report, out)
    if json:
        commands.print_json(as_json(report.views))
    else:
        print_tables(report, commands.console)
        scored = [row for task in evaluated.tasks for row in evaluated.scored(task)]
        if (notice := isolation_notice(scored)) is not None:
            commands.notices.print(notice)
        commands.notices.print(f"page: {page}")


def _asked(request: RunRequest, out: Path) -> RunRequest:
    """Return the request with the consent of whoever sits at a terminal to replace rows."""
    try:
        check_owners(request.rows(), out, request.replace)
    except ReplacedRowError as error:
        if not (sys.stdin.isatty() and typer.confirm(f"{error}. Replace them?")):
            raise
        return dataclasses.replace(request, replace=(*request.replace, *error.names))
    return request


def _tasks(
    tasks: list[str] | None, boards: list[str] | None, roads: list[Path] | None
) -> list[Task]:
    if sum(map(bool, (tasks, boards, roads))) > 1:
        raise ConfigError("give only one of --task, --board and --road")
    if roads:
        return [task for road in roads for task in surface_tasks(road)]
    boards = [validate_choice("board", x.replace("-", "_"), names("boards")) for x in boards or ()]
    if "measured" in boards:
        raise ConfigError("the board of measured surfaces needs files: give them with --road")
    if tasks:
        return [load_task(name) for name in tasks]
    return [task for task in shipped_tasks() if not boards or task.board_name in boards]


def _entries(names: Sequence[str] | None, without: Sequence[str], limits: Limits) -> list[Entry]:
    if names and without:
        raise ConfigError("give either --estimator or --without, not both")
    commands.find_from_here(names or ())
    for name in without:
        validate_choice("estimator", name, estimators.names())
    unavailable = estimators.without_weights()
    excluded = {*ALL_BASELINES, *unavailable, *without}
    chosen = names or [name for name in estimators.names() if name not in excluded]
    references = [find_reference(name) for name in chosen]
    if twice := [n for n, x in zip(chosen, references, strict=True) if references.count(x) > 1]:
        raise ConfigError(f"the estimator {twice[0]} is given twice: give it once")
    if unavailable and not names:
        commands.notices.print(f"excluded, no weights in this package: {', '.join(unavailable)}")
    if all(name in estimators.REGISTRY for name in chosen):
        return resolve_entries(chosen, None)
    with SandboxClient(limits) as sandbox:
        return resolve_entries(chosen, sandbox.describe)
