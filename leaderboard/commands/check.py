"""Commands `check-estimator` and `check-policy`: conformance checks before a comparison."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from leaderboard.commands import import_from_here, parse_settings
from leaderboard.commands.options import (
    Isolation,
    MemoryLimit,
    Settings,
    TimeLimit,
    parse_limits,
)
from leaderboard.commands.output import Output
from leaderboard.commands.policies import chosen_isolation, policy_reference
from leaderboard.conformance.checks import RUN_TIME_LIMIT, check_entry
from leaderboard.conformance.probes import PROBES, CheckResult
from leaderboard.entries.entries import resolve_entries
from leaderboard.policies.policy_checks import check_policy as run_policy_checks
from leaderboard.policies.policy_process import POLICY_LIMITS
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
        (entry,) = resolve_entries([estimator], sandbox.describe)
        results = check_entry(entry, sandbox, limits)
    return _checks_output("estimator", entry.name, results, summarize(results))


def check_policy(
    policy: Annotated[
        str, typer.Argument(help="Installed name, module:Class, or a file from `train-policy`.")
    ],
    settings: Settings = None,
    time_limit: TimeLimit = POLICY_LIMITS.seconds,
    memory_limit: MemoryLimit = POLICY_LIMITS.memory,
    isolation: Isolation = "auto",
) -> Output:
    """Check whether a policy is ready for a comparison; exit status 1 if a check fails.

    It drives a few lane changes in a process of its own: actions, repetition, reset, damaged
    sensors, cost.
    """
    limits = parse_limits(time_limit, memory_limit, isolation)
    reference = policy_reference(policy, isolation)
    # a policy of this package needs no bubblewrap
    limits = dataclasses.replace(limits, isolation=chosen_isolation(isolation) or "process")
    results = run_policy_checks(reference, parse_settings(settings), limits)
    failed = ", ".join(result.name for result in results if result.passed is False)
    verdict = f"not ready for a comparison: {failed}" if failed else "ready"
    return _checks_output("policy", policy, results, verdict)


def _checks_output(kind: str, name: str, results: Sequence[CheckResult], summary: str) -> Output:
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
        return f"ready for a board, which will show the failed probes {', '.join(failed)}"
    return f"not ready for a board: {', '.join(failed)}"
