"""Entries that are run in guests of the sandbox, and the processes that guests leave."""

import os
import time
import uuid
from pathlib import Path

from fakes import fake_drives, task

from leaderboard.entries.entry import Entry
from leaderboard.sandbox.limits import Limits

LIMITS = Limits(seconds=60.0, memory=0.5, processes=40, file=0.05)
MARK = f"ROADRECON_TEST_{uuid.uuid4().hex}"
"""Name of a variable of all processes that a test of the sandbox starts."""


def drives(number=1):
    t = task(test={"roads": ["iso_d"], "seeds": [11, 12], "length": 40.0, "number": number})
    training = [(d.record, d.truth) for d in fake_drives(t, t.training, t.conditions[0])]
    return training, [d.record for d in fake_drives(t, t.test, t.conditions[0])], t.vehicle


def run(sandbox, reference="hostile:Hostile", seeds=(1,), number=1, **settings):
    training, records, car = drives(number)
    training = [] if "how" in settings else training
    entry = Entry(name="x", reference=reference, settings=settings)
    return sandbox.reconstruct(entry, training, records, car, seeds)


def nothing_left(patience=5.0):
    """Return whether no process of a guest is left, after waiting for the kernel."""
    end = time.monotonic() + patience
    while (found := marked_processes()) and time.monotonic() < end:
        time.sleep(0.02)
    return not found


def marked_processes():
    found = []
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            if int(pid) != os.getpid() and MARK in Path(f"/proc/{pid}/environ").read_text():
                found.append(int(pid))
        except (OSError, UnicodeDecodeError):
            continue
    return found
