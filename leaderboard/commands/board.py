"""`leaderboard`: judge estimators on tasks, print the tables, write the page."""

from pathlib import Path
from typing import Annotated

import typer

import estimators
from leaderboard.board import run_board
from leaderboard.commands import console, notices, print_json, progress_bar
from leaderboard.commands.drives import Json
from leaderboard.evaluate import SEEDS
from leaderboard.measured import surface_tasks
from leaderboard.page import write_page
from leaderboard.sentinels import SENTINELS
from leaderboard.table import as_json, print_tables
from leaderboard.tasks import Task, load_task
from road_envs import config
from road_envs.config import ConfigError


def leaderboard(
    task: Annotated[
        list[str] | None,
        typer.Option(help="Task: shipped name or YAML path; may be given again. Default: all."),
    ] = None,
    road: Annotated[
        Path | None, typer.Option(help="Train and score on this surface file instead of tasks.")
    ] = None,
    estimator: Annotated[
        list[str] | None, typer.Option(help="Estimator; may be given again. Default: all.")
    ] = None,
    roads: Annotated[
        int | None, typer.Option(help="Test drives per condition where roads are drawn.", min=2)
    ] = None,
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
    chosen = _tasks(task, road)
    names = estimator or [name for name in estimators.available() if name not in SENTINELS]
    entries = {name: estimators.create(name) for name in names}
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file; a folder for results and page is wanted")
    with progress_bar() as progress:
        board = run_board(
            chosen,
            entries,
            out,
            roads=roads,
            seeds=range(1, seeds + 1),
            resume=resume,
            progress=lambda done, total, text: progress(text, done / max(total, 1)),
        )
        progress("writing the page", 1.0)
        page = write_page(board, out)
    if json:
        print_json(as_json(board))
    else:
        print_tables(board, console)
        notices.print(f"page: {page}")


def _tasks(names: list[str] | None, road: Path | None) -> list[Task]:
    if road is not None:
        if names:
            raise ConfigError("give either --task or --road, not both")
        return surface_tasks(road)
    return [load_task(name) for name in names or config.names("tasks")]
