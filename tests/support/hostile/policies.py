"""Hostile policies, one attack each. They are loaded in a guest, never in the process of a test."""

import gc
import json
import os
import signal
import struct
import sys
import threading
import time
from dataclasses import dataclass

import numpy as np


@dataclass(kw_only=True)
class Ride:
    """Commands the first action always; the attacks are its children."""

    def reset(self, context):
        self.context = context

    def act(self, observations):
        return np.zeros(len(observations), dtype=int)


class LooksForTheDrive(Ride):
    """Raise an error with the objects of a drive that this process holds, and its frames."""

    def act(self, observations):
        words = ("fleet", "drivesim", "surface", "setup", "episodestart", "rollout", "safedrive")
        kinds = {type(x).__name__ for x in gc.get_objects()}
        frame, names = sys._getframe(), []
        while frame is not None:
            names.append(frame.f_code.co_name)
            frame = frame.f_back
        found = sorted(kind for kind in kinds if any(word in kind.lower() for word in words))
        found += {"drive_all", "compare", "advance"} & set(names)
        raise RuntimeError(f"found {found}")


class ChangesTheScore(Ride):
    """Change what it was given, and the code by which scores are computed."""

    def act(self, observations):
        import road_envs.policies.rollout as rollout

        rollout.VIOLATION_PRICE = 0.0
        rollout.Rollout.score = property(lambda self: np.full(len(self.returns), 100.0))
        observations[:] = np.nan
        return super().act(observations)


def reply(head, content=b""):
    """Write a reply of its own to every pipe, as bytes or JSON, and never return."""
    text = head if isinstance(head, bytes) else json.dumps(head).encode()
    for handle in map(int, os.listdir("/proc/self/fd")):
        try:
            if handle > 2 and os.readlink(f"/proc/self/fd/{handle}").startswith("pipe"):
                os.write(handle, struct.pack(">I", len(text)) + text + content)
        except OSError:
            continue
    time.sleep(1000.0)


class RepliesNested(Ride):
    def act(self, observations):
        reply(b"[" * 60_000)


class RepliesHuge(Ride):
    def act(self, observations):
        reply(b'{"actions": ' + b"9" * 60_000 + b"}")


class RepliesTwice(Ride):
    """Reply once for all intervals to come, and once for a failure that is no text."""

    def act(self, observations):
        reply({"actions": len(observations), "failure": {"a": [1]}}, bytes(8 * len(observations)))


class Unsigned(Ride):
    def act(self, observations):
        return np.full(len(observations), 2**64 - 1, dtype=np.uint64)


class Interrupts(Ride):
    def act(self, observations):
        raise KeyboardInterrupt


class Stops(Ride):
    def act(self, observations):
        os.kill(os.getpid(), signal.SIGSTOP)
        return super().act(observations)


class SignalsAbove(Ride):
    """Stop the processes above it, of its own guest, if it may: in a user namespace both."""

    def act(self, observations):
        found = []
        for pid in (1, os.getppid()):
            try:
                os.kill(pid, signal.SIGSTOP)
                found.append(pid)
            except OSError:
                continue
        raise RuntimeError(f"stopped {found}")


class Floods(Ride):
    def act(self, observations):
        while True:
            os.write(2, bytes(2**16))


class PaintsItsError(Ride):
    def act(self, observations):
        raise RuntimeError("[/red]\x1b[2J<script>alert(1)</script>\u202e\nrrms 1.0")


class LivesOn(Ride):
    """Leave processes and threads that use the machine after its last drive."""

    def reset(self, context):
        super().reset(context)
        threading.Thread(target=time.sleep, args=(1000.0,), daemon=True).start()
        if os.fork() == 0:
            os.setsid()
            while True:
                time.sleep(0.01)
