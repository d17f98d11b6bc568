"""Commands `new-estimator` and `new-policy`: a template package."""

from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import console
from leaderboard.conformance.scaffold import Example, write_package

Name = Annotated[
    str, typer.Argument(help="Name to register it under: lower-case letters, digits and _.")
]
Folder = Annotated[
    Path | None, typer.Option(help="New or empty folder; by default road-recon-NAME here.")
]


def new_estimator(
    name: Name,
    out: Folder = None,
    learns: Annotated[
        bool, typer.Option("--learns", help="An estimator that is fitted to training drives.")
    ] = False,
) -> None:
    """Write a small working package with a new estimator."""
    _write(name, out, "learner" if learns else "estimator", f"check-estimator {name}")


def new_policy(name: Name, out: Folder = None) -> None:
    """Write a small working package with a new switching policy."""
    _write(name, out, "policy", f"check-policy {name}")


def _write(name: str, out: Path | None, example: Example, check: str) -> None:
    folder = out or Path(f"road-recon-{name.replace('_', '-')}")
    for path in write_package(name, folder, example):
        console.print(str(path), highlight=False)
    target = folder if folder.is_absolute() else f"./{folder}"
    for line in (
        f'next: pip install --editable "{target}[test]"',
        f"      python -m pytest {target}",
        f"      road-recon {check}",
    ):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
