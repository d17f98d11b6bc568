"""Reproduction of the paper's eight scenarios, figures and claims: `python -m studies.paper`."""

from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import check_output_folder, console, print_json, progress_bar
from leaderboard.commands.options import Json
from studies.paper import claims, report, study


def paper(
    trainings: Annotated[int, typer.Option(help="Training runs of each scenario.", min=2)] = 20,
    out: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("out/paper"),
    json: Json = False,
) -> None:
    """Reproduce the paper: a page with its figures, and all numbers as JSON."""
    command = f"python -m studies.paper --trainings {trainings}"
    check_output_folder(out)
    with progress_bar("nothing is kept") as progress:
        result = study.run_study(trainings, progress=progress)
        progress("writing the report", 1.0)
        written = report.write_report(
            result, out, f"python -m studies.paper --trainings {trainings}"
        )
    if json:
        print_json(report.numbers(result, command))
        return
    for sentence in claims.key_findings(result):
        console.print(f"- {sentence}")
    console.print(f"written: {', '.join(map(str, written))}")


if __name__ == "__main__":
    typer.run(paper)
