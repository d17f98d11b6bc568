"""A policy in a process of its own, with limits of time and memory.

The process sees observations and a PolicyContext, never the road, the seeds or the scores, which
stay here. Inside bubblewrap it also has no network, no files but the libraries and a copy of its
code, and no rights; otherwise it has those of the user, which protects from mistakes only.
"""

import json
import os
import pickle
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.entries import entry_files
from leaderboard.entries.entry import EntryError
from leaderboard.policies.policy_worker import PolicySetup
from leaderboard.sandbox import bubblewrap, messages
from leaderboard.sandbox.guest import Guest
from leaderboard.sandbox.limits import GIB, Limits, guest_environment
from road_envs.core.atomic_io import TempFolder
from road_envs.policies import entry_point, runs_foreign_code
from road_envs.policies.api import PolicyContext, PolicyError

STARTUP_SECONDS = 60.0
"""Time [s] in which the process must have loaded its libraries and the policy."""


POLICY_LIMITS = Limits(seconds=120.0, memory=2.0, isolation="process")
"""Limits of a policy: the time is that for all vehicles of a case. Only code from outside this
package is run with the isolation "bubblewrap".
"""


class PolicyProcess:
    """The policy `reference`, as `make_policy` takes it; a context manager, used like any policy.

    A process that has ended or exceeded a limit is replaced by a new one at the next `reset`; a
    policy that has raised an error is made anew in its process. Raises PolicyError.
    """

    def __init__(
        self,
        reference: str,
        settings: Mapping[str, Any] | None = None,
        limits: Limits = POLICY_LIMITS,
    ):
        self.reference, self.settings = reference, dict(settings or {})
        self.limits = limits
        self.act_seconds: list[float] = []  # of each call
        self.peak_memory, self._n_vehicles = 0.0, 0
        self._guest: Guest | None = None
        self._temp: TempFolder | None = None

    def __enter__(self) -> "PolicyProcess":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def reset(self, context: PolicyContext) -> None:
        """Start an episode of all vehicles of the `context`; the time limit begins anew."""
        self._n_vehicles = context.n_vehicles
        self._call("reset", np.frombuffer(pickle.dumps(context), np.uint8))

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,) for the next control interval, from observations (N, d)."""
        begin = time.perf_counter()
        numbers = np.frombuffer(self._call("act", observations)[1], dtype=np.int64)
        self.act_seconds.append(time.perf_counter() - begin)
        return numbers.copy()

    def changes(self, observations: np.ndarray) -> bool:
        """Return whether the policy writes into the observations that it is given."""
        return self._call("changes", observations)[0].get("changed") is True

    def close(self) -> None:
        """Kill the process and its children."""
        if self._temp is not None:
            self._temp.close()
            self._temp = None
        if self._guest is not None:
            self._guest.close()
            self._guest = None

    def _start(self) -> Guest:
        memory = int(self.limits.memory * GIB)
        setup = PolicySetup(reference=self.reference, settings=self.settings, memory=memory)
        paths = os.pathsep.join(os.path.abspath(path) for path in sys.path)
        environment = {**os.environ, "PYTHONPATH": paths}
        words = [sys.executable, "-P", "-m", "leaderboard.policies.policy_worker"]
        code = self._code() if self.limits.isolation == "bubblewrap" else None
        if code is None:
            return Guest([*words, json.dumps(asdict(setup))], environment, Path.cwd())
        setup = replace(setup, code=str(bubblewrap.ENTRY), user=bubblewrap.guest_user())
        environment = guest_environment(bubblewrap.HOME, whole_path=False)
        environment["XDG_CACHE_HOME"] = str(bubblewrap.HOME)
        return bubblewrap.start(
            [*words, json.dumps(asdict(setup))], environment, self.limits, Path.cwd(),
            user=setup.user, from_outside=True, read_only={code: bubblewrap.ENTRY},
        )  # fmt: skip

    def _code(self) -> Path | None:
        """Return a folder with a copy of the code, which is not imported here; None for our own.

        Raises PolicyError.
        """
        if not runs_foreign_code(self.reference):
            return None
        if ":" not in self.reference:
            self.reference = entry_point(self.reference)
        if self._temp is None:
            self._temp = TempFolder()
            self._temp.path.chmod(0o755)  # the process has another user
            (self._temp.path / "code").mkdir()
            entry_files.snapshot(self.reference, self._temp.path / "code")
        return self._temp.path / "code"

    def _call(self, task: str, data: np.ndarray) -> tuple[dict[str, Any], bytes]:
        """Send a request and return the reply. Raises PolicyError."""

        def size_of_actions(head: dict[str, Any]) -> int:
            if task != "act" or "failure" in head:
                return 0
            if head.get("actions") != self._n_vehicles:
                raise EntryError(f"act must return {self._n_vehicles} actions, one per vehicle")
            return 8 * self._n_vehicles

        try:
            if self._guest is None:
                self._guest = self._start()
            if task == "reset":
                self._guest.start_run(replace(self.limits, seconds=STARTUP_SECONDS))
            head, actions = self._guest.call(messages.encode({"do": task}, [data]), size_of_actions)
            self.peak_memory = max(self.peak_memory, self._guest.peak_memory)
            failure = messages.text(head["failure"]) if "failure" in head else None
            if task == "reset":
                self._guest.start_run(self.limits)
        except BaseException as error:
            self.close()
            if isinstance(error, EntryError):
                raise PolicyError(str(error)) from None
            raise
        if failure is not None:
            raise PolicyError(failure)
        return head, actions
