"""A policy in a process of its own, with limits of time and memory.

The process sees observations and a PolicyContext, never the road, the seeds or the scores, which
stay here, and runs a copy of the code of a policy from outside: its package or its module. Inside
bubblewrap it also has no network, no files but the libraries and that copy, and no rights;
otherwise it has those of the user, which protects from mistakes only.
"""

import pickle
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from leaderboard.entries import entry_files
from leaderboard.entries.entry import NAME, EntryError
from leaderboard.policies import policy_handler
from leaderboard.sandbox import bubblewrap, messages
from leaderboard.sandbox.guest import Guest
from leaderboard.sandbox.launch import start_guest
from leaderboard.sandbox.limits import Limits
from road_envs.core.atomic_io import TempFolder
from road_envs.core.config import ConfigError
from road_envs.policies import FILE_SUFFIXES, entry_point, runs_foreign_code
from road_envs.policies.api import PolicyContext, PolicyError

POLICY_LIMITS = Limits(seconds=120.0, memory=2.0, isolation="process")
"""The time is that for all vehicles of a case. Only code from outside is run in "bubblewrap"."""


class PolicyProcess:
    """The policy `reference`, as `make_policy` takes it; a context manager, used like any policy.
    A process that has ended or exceeded a limit is replaced by a new one at the next `reset`; a
    policy that has raised an error is made anew in its process. Raises PolicyError, and ConfigError
    for an installed name that is none of a row.
    """

    last_guest: ClassVar[tuple[str, int] | None] = None
    """Reference of the last policy from outside, and the number of pipes before its guest."""

    def __init__(
        self,
        reference: str,
        settings: Mapping[str, Any] | None = None,
        limits: Limits = POLICY_LIMITS,
    ):
        is_file = reference.endswith(FILE_SUFFIXES)
        if not (is_file or ":" in reference or NAME.fullmatch(reference)):
            raise ConfigError(
                "the name of a policy must be a letter and at most 39 letters, digits, - or _; "
                f"its package calls it {reference!a}"
            )
        # its process has another working folder
        self.reference = str(Path(reference).absolute()) if is_file else reference
        self.settings, self.limits = dict(settings or {}), limits
        self.act_seconds: list[float] = []  # of each call
        self.peak_memory, self._n_vehicles, self._count = 0.0, 0, 0
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

    def close(self) -> None:
        """Kill the process and its children."""
        for each in (self._guest, self._temp):
            if each is not None:
                each.close()
        self._guest = self._temp = None

    def _start(self) -> Guest:
        self._temp = self._temp or TempFolder()
        self._temp.path.chmod(0o755)  # the process has another user
        code = self._code(self._temp.path / "code")
        isolated = code is not None and self.limits.isolation == "bubblewrap"
        if isolated:
            self._forget_others()
        self._count += 1
        home, module = self._temp.path / str(self._count), policy_handler.__name__
        limits = replace(self.limits, seconds=1e5)  # of all cases: the kernel ends the process
        return start_guest(module, home, limits, isolated=isolated, code=code)

    def _code(self, folder: Path) -> Path | None:
        """Return `folder` with a copy of the code, which is not imported here, None for a policy of
        this package. Raises EntryError, and ConfigError for an unknown name.
        """
        if not runs_foreign_code(self.reference):
            return None
        if ":" not in self.reference:
            self.reference = entry_point(self.reference)
        if not folder.exists():
            folder.mkdir()
            entry_files.snapshot(self.reference, folder)
        return folder

    def _forget_others(self) -> None:
        """Let the policy before, if it is another one, tell this one nothing of the drives.

        Before the first guest of a command came those of commands before, with the same seal.
        """
        reference, pipes = PolicyProcess.last_guest or ("", bubblewrap.count_pipes())
        if reference != self.reference:
            pipes = bubblewrap.forget_guests(pipes)
        PolicyProcess.last_guest = self.reference, pipes

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
                self._guest.start_run(replace(self.limits, seconds=60.0))  # to load the policy
            named = {"reference": self.reference, "settings": self.settings}
            request = messages.encode({"do": task, **(named if task == "reset" else {})}, [data])
            head, actions = self._guest.call(request, size_of_actions)
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
