"""Hostile entries. They are loaded by name in a worker process, never in that of a test."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from road_envs.data.record import Estimate, profile_stations


@dataclass(frozen=True, kw_only=True)
class Hostile:
    """Performs the attack `how` on `where`, a folder or a port, then estimates a flat road."""

    causal: ClassVar[bool] = True

    how: str
    where: str = ""

    def estimate(self, record, car) -> Estimate:
        stations = profile_stations(record.length)
        answer = globals()["does_" + self.how](self.where, record)
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
    sys.stdout.write("that was 100 MB\n")


def does_kill_parent(where, record):
    os.kill(_ancestor(1), signal.SIGKILL)
    time.sleep(1000.0)


def does_kill_grandparent(where, record):
    os.kill(_ancestor(2), signal.SIGKILL)
    time.sleep(1000.0)


def does_kill_evaluation(where, record):
    """Kill the third ancestor: after supervisor and server, the evaluation process."""
    os.kill(_ancestor(3), signal.SIGKILL)
    time.sleep(1000.0)


def does_stop_parent(where, record):
    os.kill(_ancestor(1), signal.SIGSTOP)
    time.sleep(1000.0)


def does_patch_evaluation(where, record):
    import leaderboard.evaluation.entry
    from leaderboard.metrics import heights

    heights.nrmse = lambda *a, **k: 0.0
    leaderboard.evaluation.entry.check_estimate = lambda *a, **k: None
    stations = profile_stations(record.length)
    return Estimate(stations, np.full((2, stations.size), np.nan))


def does_look_for_truth(where, record):
    """Raise an error that lists all true profiles that can be found."""
    found = []
    for folder in (Path.cwd().parent, Path(where)):
        for path in folder.rglob("*"):
            if path.suffix == ".npz" and "training" not in path.name:
                found.append(path.name)
            if path.suffix == ".json" and path.name != "request.json":
                found.append(path.name)
    names = sorted(f.name for f in Path.cwd().parent.joinpath("in").iterdir())
    request = json.loads(Path.cwd().parent.joinpath("in", "request.json").read_text())
    raise RuntimeError(f"found {found}, input files {names} and {sorted(request)}")


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
    (Path(where) / "was here.txt").write_text("hostile")


def does_poison_kernels(where, record):
    from road_envs import _numba

    (_numba.CACHE / "hostile.nbc").write_bytes(b"code")


def does_connect(where, record):
    with socket.create_connection(("127.0.0.1", int(where)), timeout=2.0) as line:
        line.sendall(b"the record is mine")


def does_ask_for_secrets(where, record):
    raise RuntimeError(f"it has {os.environ.get('ROADRECON_SECRET')} at {Path.home()}")


def does_fill(where, record):
    with open("large", "wb") as file:
        for _ in range(200):
            file.write(bytes(2**20))


def does_forge_answer(where, record):
    _out("response.json").write_text('{"trainings": [{"seed": 7, "score": 0.0}]}')
    os._exit(0)


def does_link_answer(where, record):
    _out("response.json").symlink_to("/etc/hostname")
    os._exit(0)


def does_answer_with_a_pipe(where, record):
    os.mkfifo(_out("response.json"))
    os._exit(0)


def does_answer_at_length(where, record):
    _out("response.json").write_text('{"failure": "' + "x" * 2_000_000 + '"}')
    os._exit(0)


def does_answer_without_estimates(where, record):
    report = {"seed": 1, "train_seconds": 0.0, "estimate_seconds": 0.0, "parameters": 0}
    _out("response.json").write_text(json.dumps({"trainings": [report]}))
    os._exit(0)


def does_send_a_pickle(where, record):
    does_send_arrays(z0=np.array([{"a": 1}], dtype=object))


def does_send_a_bomb(where, record):
    does_send_arrays(z0=np.zeros((2, 2**22)), compressed=True)


def does_send_another_name(where, record):
    does_send_arrays(z0=np.zeros((2, profile_stations(record.length).size)), truth=np.zeros(3))


def does_send_half(where, record):
    np.savez(_out("seed-1.npz"), z0=np.zeros((2, profile_stations(record.length).size)))
    data = _out("seed-1.npz").read_bytes()
    _out("seed-1.npz").write_bytes(data[: len(data) // 2])
    does_answer_without_estimates(where, record)


def does_send_arrays(compressed=False, **arrays):
    save = np.savez_compressed if compressed else np.savez
    save(_out("seed-1.npz"), **arrays)
    does_answer_without_estimates("", None)


def _out(name):
    return Path.cwd().parent / "out" / name


def _ancestor(generations):
    """Return the process number of an ancestor. Raises ProcessLookupError if it is not visible."""
    pid = os.getpid()
    for _ in range(generations):
        text = Path(f"/proc/{pid}/stat").read_text()
        pid = int(text.rpartition(")")[2].split()[1])
        if pid == 0:
            raise ProcessLookupError("no process above")
    return pid
