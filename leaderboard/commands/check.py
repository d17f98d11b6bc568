"""`check_entry-estimator`: what the judge will say of an estimator, before it stands on a board."""

import dataclasses
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from leaderboard.commands import console, print_json
from leaderboard.commands.board import parse_limits
from leaderboard.commands.simulate import Json
from leaderboard.conformance.checks import RUN_TIME_LIMIT, check_entry
from leaderboard.conformance.probes import PROBES, CheckResult
from leaderboard.evaluation.entries import resolve_entries
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits

MARKS = {True: "[green]passed[/green]", False: "[red]FAILED[/red]", None: "[dim]noted[/dim]"}


def check_estimator(
    estimator: Annotated[
        str, typer.Argument(help="Installed name, module:Class, or a file from `train`.")
    ],
    time_limit: Annotated[
        float, typer.Option(help="Seconds an entry may take under one condition.")
    ] = Limits.seconds,
    memory_limit: Annotated[float, typer.Option(help="GiB an entry may hold.")] = Limits.memory,
    json: Json = False,
) -> None:
    """Say beforehand whether an estimator can stand on a board; exit status 1 if it cannot.

    It runs in processes of its own on a few short drives: contract, damaged records, probes, cost.
    """
    if ":" in estimator and os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # as `python -m` has it, so that a file here is found
    limits = parse_limits(time_limit, memory_limit)
    with SandboxClient(
        dataclasses.replace(limits, seconds=min(RUN_TIME_LIMIT, limits.seconds))
    ) as sandbox:
        (entry,) = resolve_entries([estimator], sandbox)
        found = check_entry(entry, sandbox, limits)
    failed = [one.name for one in found if one.passed is False]
    if json:
        print_json(
            {
                "estimator": entry.name,
                "passed": not failed,
                "checks": [dataclasses.asdict(one) for one in found],
            }
        )
    else:
        table = Table.grid(padding=(0, 1))
        for one in found:
            table.add_row(MARKS[one.passed], one.name, escape(one.message))
        console.print(table)
        console.print(f"{escape(entry.name)}: {summarize(found)}", highlight=False)
    if failed:
        raise typer.Exit(1)


def summarize(found: Sequence[CheckResult]) -> str:
    """The verdict in words."""
    failed = [one.name for one in found if one.passed is False]
    if not failed:
        return "ready for a board"
    if set(failed) <= set(PROBES):
        return (
            f"it can stand on a board, where its mark will say that it failed {_join_words(failed)}"
        )
    return f"not ready for a board: {_join_words(failed)}"


def _join_words(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))
