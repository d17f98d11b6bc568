"""Command `new-estimator`: a template package with an estimator."""

from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import console
from leaderboard.conformance.scaffold import write_package


def new_estimator(
    name: Annotated[str, typer.Argument(help="Name to register the estimator under.")],
    out: Annotated[
        Path | None, typer.Option(help="New or empty folder; by default road-recon-NAME here.")
    ] = None,
) -> None:
    """Write a small working package with a new estimator."""
    folder = out or Path(f"road-recon-{name.replace('_', '-')}")
    for path in write_package(name, folder):
        console.print(str(path), highlight=False)
    target = folder if folder.is_absolute() else f"./{folder}"
    for line in (
        f'next: pip install --editable "{target}[test]"',
        f"      python -m pytest {target}",
        f"      road-recon check-estimator {name}",
    ):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
