"""A policy in a process of its own, with limits of time and memory.

The process sees observations and a PolicyContext, never the road, the seeds or the scores, which
stay here. It has the rights of the user, so this protects from mistakes, not from malice.
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from leaderboard.policies.policy_worker import LONGEST_TEXT, REPLY
from road_envs.config import Positive, Settings
from road_envs.policies.api import PolicyContext, PolicyError

GIB = 2**30

STARTUP_SECONDS = 60.0
"""Time [s] in which the process must have loaded its libraries and the policy."""


@dataclass(frozen=True, kw_only=True)
class PolicyLimits(Settings):
    """Limits of a policy: `seconds` for all vehicles of a case, `memory` [GiB]."""

    seconds: Positive = 120.0
    memory: Positive = 2.0


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
        self.peak_memory = 0.0
        self._process: subprocess.Popen[bytes] | None = None
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
        memory = str(int(self.limits.memory * GIB))
        words = (self.reference, json.dumps(self.settings), memory)
        paths = os.pathsep.join(os.path.abspath(path) for path in sys.path)
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "leaderboard.policies.policy_worker", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": paths},
            start_new_session=True,
        )
        for stream in (process.stdin, process.stdout):
            os.set_blocking(stream.fileno(), False)  # type: ignore[union-attr]
        return process

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
        """Read the largest memory [GiB] of the process so far, where the platform tells it."""
        try:
            status = Path(f"/proc/{self._process.pid}/status").read_text()  # type: ignore[union-attr]
        except OSError:
            return
        for line in status.splitlines():
            if line.startswith("VmHWM:"):
                self.peak_memory = max(self.peak_memory, int(line.split()[1]) / 2**20)
