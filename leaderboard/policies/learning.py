"""The worth of a learned policy: the public drives, driven once, beside laws.

Training drives decide which round of a training is kept. `studies.agents` compares several seeds
with every law.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from leaderboard.policies import comparison
from road_envs.policies import create
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork

RIVALS = ("rrms", "rrms_lateral", "lateral", "mpc")  # laws beside which a learned policy is shown


def evaluate(network: PolicyNetwork, curve: Sequence[tuple[int, float]]) -> dict[str, Any]:
    """Return the comparison of a network with RIVALS on public drives as plain data.

    `curve` are the rounds of its training and their scores on training drives.
    """
    name = f"seed {network.metadata['seed']}"
    policies = {name: NetworkPolicy.from_network(network)} | {law: create(law) for law in RIVALS}
    found = comparison.compare(policies, comparison.public_drives(), sweeps=0)
    return found.data | {"curves": {name: [list(point) for point in curve]}}


def lines(evaluation: Mapping[str, Any]) -> list[str]:
    """Return the lines of a terminal report on the result of `evaluate`."""
    curves = [
        f"{name}, score by round: " + " ".join(f"{score:.3f}" for _, score in curve)
        for name, curve in evaluation["curves"].items()
    ]
    return [*curves, "", *comparison.table_lines(evaluation)]
