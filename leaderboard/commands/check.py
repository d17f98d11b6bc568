"""Command `check-estimator`: conformance checks of an estimator before submission."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from leaderboard.commands import import_from_here
from leaderboard.commands.options import Isolation, MemoryLimit, TimeLimit, parse_limits
from leaderboard.commands.output import Output
from leaderboard.conformance.checks import RUN_TIME_LIMIT, check_entry
from leaderboard.conformance.probes import PROBES, CheckResult
from leaderboard.entries.entries import resolve_entries
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits

MARKS = {
    True: Text("passed", style="green"),
    False: Text("FAILED", style="red"),
    None: Text("noted", style="dim"),
}


def check_estimator(
    estimator: Annotated[
        str,
        typer.Argument(help="Installed name, module:Class, or path of a wheel or trained file."),
    ],
    time_limit: TimeLimit = Limits.seconds,
    memory_limit: MemoryLimit = Limits.memory,
    isolation: Isolation = "auto",
) -> Output:
    """Check whether an estimator is ready for a board; exit status 1 if a check fails.

    It runs in separate processes on a few short drives: contract, damaged records, probes, cost.
    """
    import_from_here([estimator])
    limits = parse_limits(time_limit, memory_limit, isolation)
    with SandboxClient(
        dataclasses.replace(limits, seconds=min(RUN_TIME_LIMIT, limits.seconds))
    ) as sandbox:
        (entry,) = resolve_entries([estimator], sandbox)
        results = check_entry(entry, sandbox, limits)
    return checks_output("estimator", entry.name, results, summarize(results))


def checks_output(kind: str, name: str, results: Sequence[CheckResult], summary: str) -> Output:
    """Return a line for each check of what is named, and one for all."""
    passed = not any(result.passed is False for result in results)
    checks = [dataclasses.asdict(result) for result in results]
    table = Table.grid(padding=(0, 1))
    for result in results:
        table.add_row(MARKS[result.passed], result.name, result.message)
    return Output(
        facts={kind: name, "passed": passed, "checks": checks},
        shows=[table, f"{name}: {summary}"],
        status=0 if passed else 1,
    )


def summarize(results: Sequence[CheckResult]) -> str:
    """Return one sentence on all check results."""
    failed = [result.name for result in results if result.passed is False]
    if not failed:
        return "ready for a board"
    if set(failed) <= set(PROBES):  # they do not exclude an entry, but are shown beside its name
        return f"ready for a board, which will show the failed probes {_join_words(failed)}"
    return f"not ready for a board: {_join_words(failed)}"


def _join_words(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))
