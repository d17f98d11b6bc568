"""Command `clean`: delete what other code has made and nobody will read again."""

from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import console
from road_envs.core import artifacts
from road_envs.core.code_digest import cache_home


def clean(
    folder: Annotated[Path | None, typer.Argument(help="Default: the caches of this user.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="List them, delete nothing.")] = False,
) -> None:
    """Delete stale artifacts: results, cards and caches that other code has made."""
    where = folder or cache_home()
    if folder is not None and not folder.is_dir():
        raise typer.BadParameter(f"{folder} is no folder")
    found = artifacts.clean(where, delete=not dry_run)
    for path in found if dry_run else ():
        console.print(str(path))
    what = "would be deleted" if dry_run else "deleted"
    console.print(f"{len(found)} stale artifacts below {where} {what}")
