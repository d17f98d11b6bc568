"""A policy in a process of its own, with limits of time and memory.

The process sees observations and a PolicyContext, never the road, the seeds or the scores, which
stay here. Inside bubblewrap it also has no network, no files but the libraries and a copy of its
code, and no rights; otherwise it has those of the user, which protects from mistakes only.
"""

import json
import os
import pickle
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from leaderboard.evaluation.entry import EntryError
from leaderboard.policies.policy_worker import LONGEST_TEXT, REPLY, PolicySetup
from leaderboard.sandbox import bubblewrap, entry_files, processes
from leaderboard.sandbox.limits import Limits, guest_environment
from road_envs._atomic_io import TempFolder
from road_envs.config import Positive, Settings
from road_envs.policies import entry_point, runs_foreign_code
from road_envs.policies.api import PolicyContext, PolicyError

GIB = 2**30

STARTUP_SECONDS = 60.0
"""Time [s] in which the process must have loaded its libraries and the policy."""


@dataclass(frozen=True, kw_only=True)
class PolicyLimits(Settings):
    """Limits of a policy: `seconds` for all vehicles of a case, `memory` [GiB].

    `isolation` is "process", or "bubblewrap", which is for code from outside this package.
    """

    seconds: Positive = 120.0
    memory: Positive = 2.0
    isolation: Literal["process", "bubblewrap"] = "process"


class PolicyProcess:
    """The policy `reference`, as `make_policy` takes it; a context manager, used like any policy.

    A process that has failed is replaced by a new one at the next `reset`. Raises PolicyError.
    """

    def __init__(
        self,
        reference: str,
        settings: Mapping[str, Any] | None = None,
        limits: PolicyLimits | None = None,
    ):
        self.reference, self.settings = reference, dict(settings or {})
        self.limits = limits or PolicyLimits()
        self.act_seconds: list[float] = []  # of each call
        self.peak_memory, self._next_measurement = 0.0, 0.0
        self._process: subprocess.Popen[bytes] | None = None
        self._temp: TempFolder | None = None
        self._n_vehicles, self._seconds_left = 0, 0.0

    def __enter__(self) -> "PolicyProcess":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def reset(self, context: PolicyContext) -> None:
        """Start an episode of all vehicles of the `context`; the time limit begins anew."""
        self._n_vehicles, self._seconds_left = context.n_vehicles, STARTUP_SECONDS
        self._call("reset", context)
        self._seconds_left = self.limits.seconds

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,) for the next control interval, from observations (N, d)."""
        begin = time.perf_counter()
        numbers = np.frombuffer(self._call("act", observations), dtype=np.int64)
        self.act_seconds.append(time.perf_counter() - begin)
        return numbers.copy()

    def changes(self, observations: np.ndarray) -> bool:
        """Return whether the policy writes into the observations that it is given."""
        return self._call("changes", observations) != b""

    def close(self) -> None:
        """Kill the process and its children."""
        if self._temp is not None:
            self._temp.close()
            self._temp = None
        if self._process is None:
            return
        try:
            os.killpg(self._process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        self._process.wait()
        self._process = None

    def _start(self) -> subprocess.Popen[bytes]:
        memory = int(self.limits.memory * GIB)
        setup = PolicySetup(reference=self.reference, settings=self.settings, memory=memory)
        paths = os.pathsep.join(os.path.abspath(path) for path in sys.path)
        environment = {**os.environ, "PYTHONPATH": paths}
        code = self._code() if self.limits.isolation == "bubblewrap" else None
        if code is not None:
            user = bubblewrap.NOBODY if bubblewrap.must_become_nobody() else None
            setup = replace(setup, code=str(bubblewrap.ENTRY), user=user)
            environment = guest_environment(bubblewrap.HOME, whole_path=False)
            environment["XDG_CACHE_HOME"] = str(bubblewrap.HOME)
        words = [sys.executable, "-P", "-m", "leaderboard.policies.policy_worker"]
        words.append(json.dumps(asdict(setup)))
        if code is not None:
            limits = Limits(seconds=self.limits.seconds, memory=self.limits.memory)
            mounts = {code: bubblewrap.ENTRY}
            nobody = setup.user is not None
            words = bubblewrap.command(
                words, environment, limits, mounts, {}, becomes_nobody=nobody
            )
        process = subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )
        for stream in (process.stdin, process.stdout):
            os.set_blocking(stream.fileno(), False)  # type: ignore[union-attr]
        return process

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
            try:
                entry_files.snapshot(self.reference, self._temp.path / "code")
            except EntryError as error:
                raise PolicyError(str(error)) from None
        return self._temp.path / "code"

    def _call(self, task: str, data: Any) -> bytes:
        """Send a request and return the answer. Raises PolicyError; the process has then ended."""
        if self._process is None:
            self._process = self._start()
        end = time.monotonic() + self._seconds_left
        try:
            self._send(pickle.dumps((task, data)), end)
            ok, size = REPLY.unpack(self._receive(REPLY.size, end))
            largest = 8 * self._n_vehicles if ok else 4 * LONGEST_TEXT
            if size > largest:
                raise PolicyError(f"its reply has {size} bytes, at most {largest} are expected")
            answer = self._receive(size, end)
            if not ok:
                raise PolicyError(answer.decode(errors="replace"))
        except BaseException:
            self._measure()
            self.close()
            raise
        self._seconds_left = end - time.monotonic()
        self._measure()
        return answer

    def _send(self, message: bytes, end: float) -> None:
        unsent, handle = memoryview(message), self._process.stdin.fileno()  # type: ignore[union-attr]
        while unsent:
            self._wait([], [handle], end)
            try:
                unsent = unsent[os.write(handle, unsent) :]
            except BrokenPipeError:
                raise PolicyError(self._describe_end()) from None

    def _receive(self, size: int, end: float) -> bytes:
        received, handle = bytearray(), self._process.stdout.fileno()  # type: ignore[union-attr]
        while len(received) < size:
            self._wait([handle], [], end)
            part = os.read(handle, size - len(received))
            if not part:
                raise PolicyError(self._describe_end())
            received += part
        return bytes(received)

    def _wait(self, readable: list[int], writable: list[int], end: float) -> None:
        left = end - time.monotonic()
        if left <= 0.0 or not any(select.select(readable, writable, [], left)):
            raise PolicyError(f"stopped after {self.limits.seconds:g} s, the time limit")

    def _describe_end(self) -> str:
        status = self._process.wait()  # type: ignore[union-attr]
        if status < 0:
            return f"its process was ended by {signal.Signals(-status).name}"
        return f"its process ended with exit status {status}"

    def _measure(self) -> None:
        """Read the memory [GiB] that the process and its children have now, every 0.1 s."""
        now = time.monotonic()
        if self._process is not None and now >= self._next_measurement:
            self._next_measurement = now + 0.1
            used = sum(process.resident for process in processes.tree(self._process.pid))
            self.peak_memory = max(self.peak_memory, used / GIB)
