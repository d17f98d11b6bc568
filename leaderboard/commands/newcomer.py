"""`new-estimator`: a package to begin with."""

from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import console
from leaderboard.template import write_package


def new_estimator(
    name: Annotated[str, typer.Argument(help="Name under which it will be registered.")],
    out: Annotated[
        Path | None, typer.Option(help="New or empty folder; by default roadrecon-NAME here.")
    ] = None,
) -> None:
    """Write a small working package with an estimator of your own."""
    folder = out or Path(f"roadrecon-{name.replace('_', '-')}")
    for path in write_package(name, folder):
        console.print(str(path), highlight=False)
    console.print(f'next: pip install --editable "{folder}[test]" and pytest {folder}')
