"""`leaderboard`: judge estimators on tasks, print the tables, write the page."""

from pathlib import Path
from typing import Annotated

import typer

import estimators
from leaderboard.board import run_board
from leaderboard.boards import BOARDS
from leaderboard.commands import console, notices, print_json, progress_bar
from leaderboard.commands.drives import Json
from leaderboard.evaluate import SEEDS
from leaderboard.measured import surface_tasks
from leaderboard.page import write_page
from leaderboard.sentinels import SENTINELS
from leaderboard.table import as_json, print_tables
from leaderboard.tasks import Task, load_task, shipped_tasks
from road_envs.config import ConfigError, one_of


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
        list[str] | None, typer.Option(help="Estimator; may be given again. Default: all.")
    ] = None,
    roads: Annotated[
        int | None, typer.Option(help="Test drives per condition where roads are drawn.", min=2)
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="All test drives of every task: 50 and more roads.")
    ] = False,
    seeds: Annotated[int, typer.Option(help="Trainings of each learner.", min=1)] = len(SEEDS),
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep stored results that are still valid.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for results and page.")] = Path(
        "out/leaderboard"
    ),
    json: Json = False,
) -> None:
    """Judge estimators: one result file per task and estimator, tables, and a page."""
    if full and roads:
        raise ConfigError("give either --roads or --full, not both")
    chosen = _tasks(task, board, road)
    if full:
        chosen = [one.with_roads(None) if one.draws_roads else one for one in chosen]
    names = estimator or [name for name in estimators.available() if name not in SENTINELS]
    entries = {name: estimators.create(name) for name in names}
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file; a folder for results and page is wanted")
    with progress_bar() as progress:
        judged = run_board(
            chosen,
            entries,
            out,
            roads=roads,
            seeds=range(1, seeds + 1),
            resume=resume,
            progress=lambda done, total, text: progress(text, done / max(total, 1)),
        )
        progress("writing the page", 1.0)
        page = write_page(judged, out)
    if json:
        print_json(as_json(judged))
    else:
        print_tables(judged, console)
        notices.print(f"page: {page}")


def _tasks(
    names: list[str] | None, boards: list[str] | None, roads: list[Path] | None
) -> list[Task]:
    if sum(map(bool, (names, boards, roads))) > 1:
        raise ConfigError("give one of --task, --board and --road")
    if roads:
        return [task for road in roads for task in surface_tasks(road)]
    for name in boards or []:
        one_of("board", name, list(BOARDS))
    if boards and "measured" in boards:
        raise ConfigError("the board of measured surfaces needs files: use --road")
    if names:
        return [load_task(name) for name in names]
    return [task for task in shipped_tasks() if not boards or task.board in boards]
