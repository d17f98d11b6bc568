"""Command `check-policy`: conformance checks of a switching policy."""

from typing import Annotated

import typer

from leaderboard.commands import parse_settings
from leaderboard.commands.check import print_checks
from leaderboard.commands.policies import (
    Isolation,
    MemoryLimit,
    TimeLimit,
    chosen_isolation,
    policy_reference,
)
from leaderboard.commands.simulate import Json
from leaderboard.conformance.policy_checks import check_policy as run_checks
from leaderboard.policies.policy_process import PolicyLimits


def check_policy(
    policy: Annotated[
        str, typer.Argument(help="Installed name, module:Class, or a file from `train-policy`.")
    ],
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Setting of the policy, key=value.")
    ] = None,
    time_limit: TimeLimit = PolicyLimits.seconds,
    memory_limit: MemoryLimit = PolicyLimits.memory,
    isolation: Isolation = "auto",
    json: Json = False,
) -> None:
    """Check whether a policy is ready for a comparison; exit status 1 if a check fails.

    It drives a few lane changes in a process of its own: actions, repetition, reset, damaged
    sensors, cost.
    """
    reference = policy_reference(policy, isolation)
    limits = PolicyLimits(
        seconds=time_limit,
        memory=memory_limit,
        isolation=chosen_isolation(isolation) or "process",  # of a policy of this package
    )
    results = run_checks(reference, parse_settings(settings or []), limits)
    failed = ", ".join(result.name for result in results if result.passed is False)
    verdict = f"not ready for a comparison: {failed}" if failed else "ready"
    print_checks("policy", policy, results, verdict, json)
