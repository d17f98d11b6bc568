"""Command `check-policy`: conformance checks of a switching policy."""

from dataclasses import replace
from typing import Annotated

import typer

from leaderboard.commands import parse_settings
from leaderboard.commands.check import checks_output
from leaderboard.commands.options import (
    Isolation,
    MemoryLimit,
    Settings,
    TimeLimit,
    parse_limits,
)
from leaderboard.commands.output import Output
from leaderboard.commands.policies import chosen_isolation, policy_reference
from leaderboard.policies.policy_checks import check_policy as run_checks
from leaderboard.policies.policy_process import POLICY_LIMITS


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
    limits = replace(limits, isolation=chosen_isolation(isolation) or "process")
    results = run_checks(reference, parse_settings(settings), limits)
    failed = ", ".join(result.name for result in results if result.passed is False)
    verdict = f"not ready for a comparison: {failed}" if failed else "ready"
    return checks_output("policy", policy, results, verdict)
