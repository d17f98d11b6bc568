"""One guest process: messages over pipes, its limits, and its end with all that it has started.

A guest may do anything: write what it likes, stop reading, fork, or never answer. Every call ends
in a reply within the limits or in an EntryError.
"""

import math
import os
import select
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from signal import Signals
from typing import Any

from leaderboard.entries.entry import EntryError
from leaderboard.sandbox import messages, processes
from leaderboard.sandbox.limits import GIB, UNLIMITED, Limits

POLL_INTERVAL = 0.1  # interval [s] of the checks of memory and number of processes
LONGEST_DELAY = 10 * POLL_INTERVAL  # [s]; a host that goes on later was stopped: no time of a guest
OUTPUT_TAIL_SIZE = 4000  # number of last bytes of the output that are kept; the rest is counted
STARTUP_TIMEOUT = 300.0  # time [s] within which a guest must have loaded its libraries
CHUNK = 1 << 20

SIGNAL_STATUS = 128  # added to the number of the signal that ended a guest, as in a shell


class MachineError(EntryError):
    """An estimator that this machine could not run, which says nothing of the estimator."""


class Guest:
    """A guest that has loaded its libraries; `close` ends it. Raises EntryError.

    It inherits the open files `handles`. `peak_memory` [GiB] is the largest that was seen, of all
    its processes together, with the inodes of `counted` file systems in memory.
    """

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str],
        folder: Path,
        handles: Sequence[int] = (),
    ):
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            env=dict(environment), cwd=folder, start_new_session=True, pass_fds=handles,
        )  # fmt: skip
        self.pid = self._process.pid
        streams = (self._process.stdin, self._process.stdout, self._process.stderr)
        self._requests, self._replies, self._output = (s.fileno() for s in streams if s is not None)
        for handle in (self._requests, self._replies, self._output):
            os.set_blocking(handle, False)
        self.output_size, self.output_tail, self.peak_memory = 0, b"", 0.0
        self._end_of_output = False
        self.counted: tuple[Path, ...] = ()
        self.limits, self._seconds_left = Limits(), 0.0
        self.start_run(Limits(seconds=STARTUP_TIMEOUT))
        try:
            self.call(b"")
        except EntryError as error:
            self.close()
            raise EntryError(f"its guest ended as it started: {error}") from None

    def start_run(self, limits: Limits) -> None:
        """Apply these limits to all calls from now on together; time between calls is free."""
        self.limits, self._seconds_left, self.peak_memory = limits, limits.seconds, 0.0
        self._next_check = math.inf if limits is UNLIMITED else 0.0

    def cpu_seconds(self) -> float:
        """Return the processor time [s] of all its processes and threads, ended ones included."""
        return sum(process.cpu for process in processes.tree(self.pid))

    def call(
        self, request: bytes, size_of_arrays: Callable[[dict[str, Any]], int] = lambda head: 0
    ) -> tuple[dict[str, Any], bytes]:
        """Send a request; return the object and the arrays of the reply. Raises EntryError.

        `size_of_arrays` returns the expected number of bytes of the arrays.
        """
        self._end = time.monotonic() + self._seconds_left
        self._unsent = memoryview(request)
        (size,) = messages.HEAD_SIZE.unpack(self._receive(messages.HEAD_SIZE.size))
        if size > messages.MAX_HEAD:
            raise EntryError(f"its reply is invalid: a head of {size} bytes")
        head = messages.parse_head(self._receive(size))
        arrays = self._receive(size_of_arrays(head))
        if (now := time.monotonic()) >= self._next_check:
            self._measure()
        self._seconds_left = self._end - now
        return head, arrays

    def _receive(self, size: int) -> bytes:
        """Return the next `size` bytes of a reply; meanwhile send what is left of the request."""
        received = bytearray()
        while len(received) < size:
            if time.monotonic() >= self._next_check:
                self._measure()
            now = time.monotonic()  # not that before: an entry can make the check slow
            wait = max(0.0, min(self._next_check, self._end) - now)
            outputs = [self._replies] + ([] if self._end_of_output else [self._output])
            requests = [self._requests] if self._unsent else []
            ready, free, _ = select.select(outputs, requests, [], wait)
            if (delay := time.monotonic() - now - wait) > LONGEST_DELAY:
                self._end += delay
            if self._output in ready:
                self._read_output()
            if free:
                self._send()
            if self._replies in ready:
                part = os.read(self._replies, min(size - len(received), CHUNK))
                if not part:
                    raise EntryError(self._describe_end())
                received += part
            elif self._process.poll() is not None:
                if not select.select([self._replies], [], [], 0.0)[0]:
                    raise EntryError(self._describe_end())
            if now > self._end and len(received) < size:  # of what had arrived
                raise EntryError(f"stopped after {self.limits.seconds:g} s, the time limit")
        return bytes(received)

    def send_end(self) -> None:
        """Let the guest end its child and wait for the next estimator."""
        os.set_blocking(self._requests, True)
        os.write(self._requests, messages.encode({"do": "end"}))
        os.set_blocking(self._requests, False)

    def close(self) -> None:
        """Kill the guest and all that it has started."""
        # children first: an orphan would be looked for in vain
        for process in processes.tree(self.pid)[1:]:
            processes.kill(process.pid)
        processes.kill(-self.pid)
        processes.kill(self.pid)
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            with suppress(OSError, AttributeError):
                stream.close()  # type: ignore[union-attr]
        self._process.wait()

    def _measure(self) -> None:
        """Record the memory in use. Raises EntryError above a limit."""
        self._next_check = time.monotonic() + POLL_INTERVAL
        running = processes.tree(self.pid)
        tables = sum(processes.size_of(x.pid, "status", "VmPTE") for x in running)
        tables += sum(processes.memory_of_files(x.pid, self.counted) for x in running[1:2])
        used = tables + sum(process.resident for process in running)
        limit = self.limits.memory
        if used > limit * GIB and len(running) > 1:
            # the sum counts shared pages several times; the exact value is slow to read
            exact = (processes.size_of(x.pid, "smaps_rollup", "Pss") or x.resident for x in running)
            used = tables + sum(exact)
        self.peak_memory = max(self.peak_memory, used / GIB)
        if used > limit * GIB:
            raise EntryError(f"stopped for using more than {limit:g} GiB, the memory limit")
        if len(running) > (limit := self.limits.processes):
            raise EntryError(f"stopped for having more than {limit} processes, the limit")

    def _send(self) -> None:
        try:
            self._unsent = self._unsent[os.write(self._requests, self._unsent[:CHUNK]) :]
        except BlockingIOError:
            pass
        except BrokenPipeError:  # it does not read any more; it may still have replied
            self._unsent = self._unsent[:0]

    def _read_output(self) -> None:
        part = os.read(self._output, CHUNK)
        self._end_of_output = not part
        self.output_size += len(part)
        self.output_tail = (self.output_tail + part)[-OUTPUT_TAIL_SIZE:]

    def _describe_end(self) -> str:
        try:
            status = self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            return "it closed its connection to the host"
        while not self._end_of_output and select.select([self._output], [], [], 0.0)[0]:
            self._read_output()
        lines = self.output_tail.decode(errors="replace").strip().splitlines()
        last = f"; its last output: {messages.text(lines[-1])}" if lines else ""
        return f"its process ended without a response, by {describe_exit(status)}{last}"


def describe_exit(status: int) -> str:
    """Return the exit status, or the name of the signal, that ended a process."""
    number = -status if status < 0 else status - SIGNAL_STATUS
    if number in set(Signals):
        return Signals(number).name
    return f"exit status {status}" if status >= 0 else f"signal {-status}"
