"""Commands `check-estimator` and `check-policy`: conformance checks before a comparison."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from rich.table import Table
from rich.text import Text

from leaderboard.commands import find_from_here, parse_settings
from leaderboard.commands.options import LimitOptions, Settings, argument
from leaderboard.commands.output import Output
from leaderboard.commands.policies import POLICY_OPTIONS, policy_isolation
from leaderboard.conformance.checks import RUN_TIME_LIMIT, check_entry
from leaderboard.conformance.probes import PROBES, CheckResult
from leaderboard.entries.entries import resolve_entries
from leaderboard.policies.policy_checks import check_policy as run_policy_checks
from leaderboard.sandbox.client import SandboxClient
from leaderboard.submission.dependencies import missing_packages

_MARKS = {
    True: Text("passed", style="green"),
    False: Text("FAILED", style="red"),
    None: Text("noted", style="dim"),
}


def check_estimator(
    estimator: Annotated[
        str, argument("Installed name, module:Class, or path of a wheel or trained file.")
    ],
    limits: LimitOptions,
) -> Output:
    """Check whether an estimator is ready for a board; exit status 1 if a check fails.

    It runs in separate processes on a few short drives: contract, damaged records, probes, cost.
    """
    find_from_here([estimator])
    of_board = limits.parse()
    own = dataclasses.replace(of_board, seconds=min(RUN_TIME_LIMIT, of_board.seconds))
    with SandboxClient(own) as sandbox:
        (entry,) = resolve_entries([estimator], sandbox.describe)
        results = list(check_entry(entry, sandbox, of_board))
    missing = missing_packages(Path(estimator)) if entry.failure is None else []
    results = [*(CheckResult("packages", False, sentence) for sentence in missing), *results]
    return _checks_output("estimator", entry.name, results, "ready for a board")


def check_policy(
    policy: Annotated[
        str, argument("Installed name, module:Class, or a file from `train-policy`.")
    ],
    settings: Settings = None,
    limits: LimitOptions = POLICY_OPTIONS,
) -> Output:
    """Check whether a policy is ready for a comparison; exit status 1 if a check fails.

    It drives a few lane changes in a process of its own: actions, repetition, reset, damaged
    sensors, cost.
    """
    isolation = policy_isolation(policy, limits.isolation)
    own = dataclasses.replace(limits.parse(), isolation=isolation)
    results = run_policy_checks(policy, parse_settings(settings), own)
    return _checks_output("policy", policy, results, "ready for a comparison")


def _checks_output(kind: str, name: str, results: Sequence[CheckResult], ready: str) -> Output:
    """Return a line for each check of what is named, and one for all: whether it is `ready`."""
    failed = [result.name for result in results if result.passed is False]
    summary = f"not {ready}: {', '.join(failed)}"
    if not failed:
        summary = "ready" if kind == "policy" else ready
    elif kind == "estimator" and set(failed) <= set(PROBES):  # a board has it nevertheless
        summary = f"{ready}, which will show the failed probes {', '.join(failed)}"
    checks = [dataclasses.asdict(result) for result in results]
    table = Table.grid(padding=(0, 1))
    for result in results:
        table.add_row(_MARKS[result.passed], result.name, result.message)
    facts = {kind: name, "passed": not failed, "checks": checks}
    return Output(facts=facts, shows=[table, f"{name}: {summary}"], status=1 if failed else 0)
