"""Command `verify`: a random share of the stored drives of a folder, run again and compared."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from leaderboard.commands import (
    console,
    import_from_here,
    make_table,
    notices,
    print_json,
    progress_bar,
)
from leaderboard.commands.options import Isolation, Json, MemoryLimit, TimeLimit, parse_limits
from leaderboard.entries.entries import resolve_entries
from leaderboard.running.jobs import in_sandbox
from leaderboard.running.verification import SHARE, Verified, save_verified, verify_folder
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs.core.config import ConfigError


def verify(
    folder: Annotated[Path, typer.Argument(help="Folder of results, the --out of `leaderboard`.")],
    *,
    share: Annotated[
        float, typer.Option(help="Share of the drives of each task.", min=0.0, max=1.0)
    ] = SHARE,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the choice of drives; drawn if missing.", min=0)
    ] = None,
    estimator: Annotated[
        list[str] | None,
        typer.Option(help="Entry of another package: wheel, folder or class; may be given again."),
    ] = None,
    time_limit: TimeLimit = Limits.seconds,
    memory_limit: MemoryLimit = Limits.memory,
    isolation: Isolation = "auto",
    json: Json = False,
) -> None:
    """Run a random tenth of stored drives again and compare; exit status 1 if one differs.

    Rows of this processor and its kernels are compared in all scores, those of others in the
    ranking score at a wider tolerance.
    What was found is kept in the folder: boards note rows of other processors without it.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder")
    import_from_here(estimator or ())
    limits = parse_limits(time_limit, memory_limit, isolation)
    with SandboxClient(limits) as sandbox, progress_bar() as progress:
        entries = resolve_entries(estimator or (), sandbox)
        found = verify_folder(
            folder,
            in_sandbox(sandbox),
            entries,
            share=share,
            seed=seed,
            report=progress,
        )
    save_verified(found, folder)
    print_verified(found, json)


def print_verified(found: list[Verified], json: bool) -> None:
    """Print what was found of each row. Raises typer.Exit with status 1 if one differs."""
    if json:
        print_json([{**dataclasses.asdict(row), "agrees": row.agrees} for row in found])
    else:
        heads = ("estimator", "task", "runs", "apart", "tolerance", "score", "result")
        texts = ("task", "score", "result")
        console.print(make_table(heads, map(_cells, found), texts=texts, box=None))
        notices.print(_summary(found))
    if any(not row.agrees for row in found if row.runs):
        raise typer.Exit(1)


def _cells(row: Verified) -> list[str]:
    numbers = (
        [f"{row.runs}", f"{row.distance:.1e}", f"{row.tolerance:.0e}"] if row.runs else [""] * 3
    )
    verdict = row.reason or ("agrees" if row.agrees else "DIFFERS")
    return [row.estimator, row.task, *numbers, row.score, verdict]


def _summary(found: list[Verified]) -> str:
    run = [row for row in found if row.runs]
    return (
        f"{sum(row.agrees for row in run)} of {len(run)} rows agree on {found[0].kernels}; "
        f"{len(found) - len(run)} could not be run again"
    )
