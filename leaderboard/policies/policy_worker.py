"""The guest of a policy: requests on standard input, actions on standard output.

    python -P -m leaderboard.policies.policy_worker SETUP

SETUP is a PolicySetup as JSON, messages are those of `leaderboard.sandbox.messages`. The libraries
are loaded first, then the process becomes another user, then the policy is loaded. What the policy
prints goes to standard error.
"""

import json
import os
import pickle
import resource
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from leaderboard.entries.entry import describe_error
from leaderboard.sandbox import messages, processes, worker
from road_envs.policies import make_policy


@dataclass(frozen=True, kw_only=True)
class PolicySetup:
    """Start message: the policy, `memory` [bytes], where its code is, whom to become."""

    reference: str
    settings: dict[str, Any]
    memory: int
    code: str | None = None
    user: int | None = None


def main() -> None:
    """Serve requests until the end of input."""
    setup = PolicySetup(**json.loads(sys.argv[1]))
    processes.die_with_parent()
    replies = os.dup(1)
    os.dup2(2, 1)
    worker.reply(replies, {})
    resource.setrlimit(resource.RLIMIT_DATA, (setup.memory, setup.memory))
    worker.become(setup.user)
    if setup.code is not None:
        sys.path.insert(0, setup.code)
    policy: Any = None
    while True:
        try:
            request = worker.read_request()
        except EOFError:
            return
        (data,) = messages.decode_arrays(request, worker.read)
        try:
            if request["do"] == "reset":
                policy = policy or make_policy(setup.reference, **setup.settings)
                policy.reset(pickle.loads(data.tobytes()))  # of the host
                worker.reply(replies, {})
            elif request["do"] == "changes":
                before = data.copy()
                policy.act(data)
                worker.reply(replies, {"changed": not np.array_equal(before, data)})
            else:
                actions = _whole_numbers(policy.act(data)).astype(np.int64)
                worker.reply(replies, {"actions": actions.size}, [actions])
        except BaseException as error:
            policy = None  # the next episode begins with a new one
            worker.reply(replies, {"failure": describe_error(error)[:10_000]})


def _whole_numbers(actions: object) -> np.ndarray:
    given = np.asarray(actions)
    if given.dtype.kind not in "iu":
        raise TypeError(f"act must return whole numbers, got {given.dtype}")
    return given


if __name__ == "__main__":
    main()
