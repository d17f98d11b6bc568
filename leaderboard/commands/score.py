"""Command `score`: the row of a task from a file of heights."""

from pathlib import Path
from typing import Annotated

import typer

from leaderboard.arrays import load_task
from leaderboard.commands import console, print_json
from leaderboard.commands.options import Json
from leaderboard.task_tables import score_file


def score(
    heights: Annotated[
        Path,
        typer.Argument(help="CSV or Parquet file: test_profiles of `dataset --task`, filled in."),
    ],
    *,
    task: Annotated[str, typer.Option(help="Task that the heights are of.")],
    roads: Annotated[
        int | None, typer.Option(help="Test drives per condition, as for `dataset`.", min=1)
    ] = None,
    json: Json = False,
) -> None:
    """Score heights of the test drives of a task, made by any program."""
    table = score_file(load_task(task, roads=roads), heights)
    if json:
        print_json(table.values)
    else:
        console.print(str(table), highlight=False)
