"""Command `cite`: BibTeX of this project, and of an entry with what ran."""

from pathlib import Path
from typing import Annotated

import typer

from leaderboard.report.citation import as_bibtex, cite_entry


def cite(
    entry: Annotated[str | None, typer.Argument(help="Entry with a row in the folder.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of results, as for `leaderboard`.")] = Path(
        "out/leaderboard"
    ),
) -> None:
    """Print how to cite this project, and an entry with the versions of what ran."""
    cited = "" if entry is None else cite_entry(out, entry)
    typer.echo(as_bibtex() + cited, nl=False)
