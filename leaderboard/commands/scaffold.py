"""`new-estimator`: a package to begin with."""

from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import console
from leaderboard.conformance.scaffold import write_package


def new_estimator(
    name: Annotated[str, typer.Argument(help="Name under which it will be registered.")],
    out: Annotated[
        Path | None, typer.Option(help="New or empty folder; by default road-recon-NAME here.")
    ] = None,
) -> None:
    """Write a small working package with an estimator of your own."""
    folder = out or Path(f"road-recon-{name.replace('_', '-')}")
    for path in write_package(name, folder):
        console.print(str(path), highlight=False)
    place = folder if folder.is_absolute() else f"./{folder}"
    for line in (
        f'next: pip install --editable "{place}[test]"',
        f"      python -m pytest {place}",
        f"      road-recon check-estimator {name}",
    ):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
