"""Requests to a switching policy in a guest: it is made, reset and asked for actions.

reset    reference, settings, a pickled PolicyContext -> nothing
act      observations (N, d)                          -> actions (N,)

Request, and after the arrow the reply, which the host checks.
"""

import pickle
import sys
from typing import Any

import numpy as np

from leaderboard.sandbox import messages
from road_envs.policies import make_policy


def make_handler(code: str | None) -> messages.Handler:
    """Return the handler of one policy, whose code lies in the folder `code`. A policy that has
    raised an error is made anew at the next reset.
    """
    if code is not None:
        sys.path.insert(0, code)
    policy: Any = None

    def handle(request: dict[str, Any], arrays: list[np.ndarray]) -> messages.Reply:
        nonlocal policy
        (data,) = arrays
        used, policy = policy, None
        if request["do"] == "reset":
            used = used or make_policy(request["reference"], **request["settings"])
            used.reset(pickle.loads(data.tobytes()))  # of the host
            answer: messages.Reply = {}, ()
        else:
            actions = np.asarray(used.act(data))
            if actions.dtype.kind not in "iu":
                raise TypeError(f"act must return whole numbers, got {actions.dtype}")
            answer = {"actions": actions.size}, [actions.astype(np.int64)]
        policy = used
        return answer

    return handle
