"""The process of an isolated policy: requests on standard input, actions on standard output.

    python -P -m leaderboard.policies.policy_worker SETUP

SETUP is a PolicySetup as JSON. The libraries are loaded first, then the process becomes another
user, then the policy is loaded. Requests come from the judge and are pickles; replies go to it and
are a flag, a size and plain numbers or text, since nothing that a policy writes is to be unpickled.
What the policy prints goes to standard error.
"""

import json
import os
import pickle
import resource
import struct
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from road_envs.policies import make_policy

REPLY = struct.Struct("<?I")
"""Head of a reply: whether it succeeded, and the number of bytes that follow."""

LONGEST_TEXT = 2000
"""Longest description of a failure, in characters."""


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
    requests, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_DATA, (setup.memory, setup.memory))
    if setup.user is not None:
        os.setgroups([])
        os.setgid(setup.user)
        os.setuid(setup.user)
    if setup.code is not None:
        sys.path.insert(0, setup.code)
    policy: Any = None
    while True:
        try:
            task, data = pickle.load(requests)
        except EOFError:
            return
        try:
            if task == "reset":
                policy = policy or make_policy(setup.reference, **setup.settings)
                policy.reset(data)
                answer = b""
            elif task == "changes":
                before = data.copy()
                policy.act(data)
                answer = b"" if np.array_equal(before, data) else b"changed"
            else:
                answer = _whole_numbers(policy.act(data)).astype(np.int64).tobytes()
            ok = True
        except BaseException as error:
            ok, text = False, " ".join(str(error).split()) or "no message"
            answer = f"{type(error).__name__}: {text}"[:LONGEST_TEXT].encode(errors="replace")
        replies.write(REPLY.pack(ok, len(answer)) + answer)
        replies.flush()


def _whole_numbers(actions: object) -> np.ndarray:
    given = np.asarray(actions)
    if given.dtype.kind not in "iu":
        raise TypeError(f"act must return whole numbers, got {given.dtype}")
    return given


if __name__ == "__main__":
    main()
