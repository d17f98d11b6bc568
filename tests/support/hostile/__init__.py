"""Hostile entries. They are loaded by name in a worker process, never in that of a test.

Attacks on the host are here, those on what seals a guest from others in `seals`.
"""

import contextlib
import fcntl
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import ClassVar

import numpy as np

from road_envs.records.record import Estimate, profile_stations

POISON = b"the code of a hostile entry"


@dataclass(frozen=True, kw_only=True)
class Hostile:
    """Performs the attack `how` on `where`, a folder or a port, then estimates a flat road."""

    causal: ClassVar[bool] = True

    how: str
    where: str = ""

    def estimate(self, record, car) -> Estimate:
        stations = profile_stations(record.length)
        name = f"does_{self.how}"
        attack = globals().get(name) or getattr(import_module(f"{__name__}.seals"), name)
        answer = attack(self.where, record)
        return answer or Estimate(stations, np.zeros((2, stations.size)))


def does_nothing(where, record): ...


def does_hang(where, record):
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    time.sleep(1000.0)


def does_spin(where, record):
    while True:
        pass


def does_exit_softly(where, record):
    os._exit(0)


def does_exit_hard(where, record):
    os.kill(os.getpid(), signal.SIGKILL)  # the first process of a namespace survives it
    os.abort()


def does_crash(where, record):
    print("about to read address 0", flush=True)
    import ctypes

    ctypes.string_at(0)


def does_hoard(where, record):
    held = []
    while True:
        held.append(np.ones(2**21))
        time.sleep(0.002)


def does_grasp(where, record):
    np.ones(2**33)


def does_hoard_in_children(where, record):
    for _ in range(4):
        if os.fork() == 0:
            held = np.ones(2**24)
            time.sleep(1000.0)
            os._exit(int(held[0]))
    time.sleep(1000.0)


def does_leave_children(where, record):
    """Leave two generations of processes in own sessions that ignore SIGTERM and SIGHUP."""
    for _ in range(3):
        if os.fork() == 0:
            os.setsid()
            for number in (signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_IGN)
            if os.fork() == 0:
                os.setsid()
                subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
                time.sleep(1000.0)
            os._exit(0)
    time.sleep(0.2)


def does_multiply(where, record):
    for _ in range(200):
        if os.fork() == 0:
            time.sleep(1000.0)
            os._exit(0)
    time.sleep(1000.0)


def does_print(where, record):
    for stream in (1, 2):
        line = b"x" * 999 + b"\n"
        for _ in range(50):
            os.write(stream, 1000 * line)
    os.write(1, b"that was 100 MB\n")
    os.kill(os.getpid(), signal.SIGKILL)


def does_work_in_secret(where, record):
    """Work in a thread while the clock that the worker reads stands still."""
    still = time.perf_counter()
    time.perf_counter = lambda: still

    def work():
        end = time.process_time() + 0.5
        while time.process_time() < end:
            pass

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()


def does_kill_parent(where, record):
    os.kill(_ancestor(1), signal.SIGKILL)
    time.sleep(1000.0)


def does_kill_evaluation(where, record):
    """Kill the second ancestor: after the guest's first process, the evaluation process."""
    os.kill(_ancestor(2), signal.SIGKILL)
    time.sleep(1000.0)


def does_stop_parent(where, record):
    os.kill(_ancestor(1), signal.SIGSTOP)
    time.sleep(1000.0)


def does_patch_evaluation(where, record):
    import leaderboard.entries.entry
    from leaderboard.metrics import heights

    heights.nrmse = lambda *a, **k: 0.0
    leaderboard.entries.entry.check_estimate = lambda *a, **k: None
    stations = profile_stations(record.length)
    return Estimate(stations, np.full((2, stations.size), np.nan))


def does_look_for_truth(where, record):
    """Raise an error that lists what can be seen: of `where`, of the root, and all own data."""
    found = sorted(str(path) for path in Path(where).rglob("*")) if where else []
    root = sorted(path.name for path in Path("/").iterdir())
    held = sorted(vars(record))
    raise RuntimeError(f"found {found}, root {root}, record {held}, words {sys.argv[1:]}")


def does_tamper(where, record):
    """Alter every stored result, with a valid checksum."""
    import hashlib

    for path in Path(where).rglob("*.json"):
        try:
            text = path.read_text()
            rest = text[text.index("\n", 3) + 1 :].replace('"flat"', '"tlaf"')
            checksum = hashlib.sha256(rest.encode()).hexdigest()
            path.write_text(f'{{\n "sha256": "{checksum}",\n{rest}')
        except OSError:
            continue
    for path in Path(where).glob("*/*"):
        if path.is_dir():
            (path / "hostile.json").write_text("{}")


def does_write_elsewhere(where, record):
    """Write into each of several folders; raise what came of it."""
    found = []
    for folder in where.split(os.pathsep):
        try:
            (Path(folder) / "was here.txt").write_text("hostile")
            found.append("written")
        except OSError as error:
            found.append(str(error.strerror))
    raise OSError("; ".join(found))


def does_poison_kernels(where, record):
    from road_envs.kernels import _numba

    (_numba.CACHE / "hostile.nbc").write_bytes(POISON)
    paths = [path.resolve() for path in _numba.CACHE.rglob("*.nbi")]
    for path in [*paths, *Path("/shared-cache").rglob("*")]:
        with contextlib.suppress(OSError):
            path.write_bytes(POISON)


def poisoned_kernels():
    """Return the files of the shared cache of kernels that `does_poison_kernels` has written."""
    from road_envs.kernels import _numba

    files = [path for path in _numba.CACHE.rglob("*") if path.is_file()]
    return [path for path in files if path.read_bytes() == POISON]


def does_connect_to_a_name(where, record):
    """By a socket that has a name in the network alone, no file, and that no filter refuses."""
    with socket.socket(socket.AF_UNIX) as line:
        line.connect(f"\0{where}")


def does_connect(where, record):
    with socket.create_connection(("127.0.0.1", int(where)), timeout=2.0) as line:
        line.sendall(b"the record is mine")


def does_ask_for_secrets(where, record):
    raise RuntimeError(f"it has {os.environ.get('ROADRECON_SECRET')} at {Path.home()}")


def does_fill(where, record):
    with open("large", "wb") as file:
        for _ in range(200):
            file.write(bytes(2**20))


def does_reply(where, record):
    """Write a forged reply, the expression `where`, in place of the worker's, and go on."""
    names = {"stations": profile_stations(record.length), "np": np, "head": head, "json": json}
    data = eval(where, names)
    os.set_blocking(reply_pipe(), True)
    while data:
        data = data[os.write(reply_pipe(), data) :]
    time.sleep(1000.0)


def head(text):
    """Return the head of a reply, from a dictionary, a text or bytes."""
    text = json.dumps(text) if isinstance(text, dict) else text
    data = text.encode() if isinstance(text, str) else text
    return len(data).to_bytes(4, "big") + data


def reply_pipe():
    """Return the handle on which the worker replies to the host."""
    for handle in range(3, 64):
        try:
            status = os.fstat(handle)
        except OSError:
            continue
        if stat.S_ISFIFO(status.st_mode) and fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_WRONLY:
            return handle
    raise LookupError("no pipe to the host")


def _ancestor(generations):
    """Return the process number of an ancestor. Raises ProcessLookupError if it is not visible."""
    pid = os.getpid()
    for _ in range(generations):
        text = Path(f"/proc/{pid}/stat").read_text()
        pid = int(text.rpartition(")")[2].split()[1])
        if pid == 0:
            raise ProcessLookupError("no process above")
    return pid
