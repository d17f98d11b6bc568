"""Command `run-job`: one job from its file, for clusters with their own scheduler."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import check_output_folder, console, print_json
from leaderboard.commands.options import Json
from leaderboard.running import jobs


def run_job(
    spec: Annotated[Path, typer.Argument(help="Job file from `leaderboard --plan`.")],
    out: Annotated[Path, typer.Option(help="Folder of results, as for `leaderboard`.")] = Path(
        "out/leaderboard"
    ),
    json: Json = False,
) -> None:
    """Run one job and store its results for the next `leaderboard --out`.

    Jobs can be run any number of times and in parallel.
    """
    check_output_folder(out)
    for done in jobs.run_job_file(spec, out):
        if json:
            print_json(dataclasses.asdict(done))
        else:
            console.print(f"{done.task}: {done.entry}, {done.condition}: {done.failure or 'done'}")
