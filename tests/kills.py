"""Kills at every stage of a run: `make kills`; arguments: kills of each stage (5), names of some.

Whenever a part is stored, a process of the stage is ended by SIGKILL after a random time: the judge
itself, a job, a guest, or a worker of a Dask cluster; or a job or a guest is stopped by SIGSTOP and
goes on after some seconds. A judge that was killed is started again. Then the run is resumed until
nothing is missing: its rows must be those of an undisturbed run, to the bit, and no process may be
left.

The judge also runs as another user, without /dev/shm, and with a clock that jumps by hours (with
the package libfaketime); then nothing may be missing. The counts are kept in `docs/runs/kills.txt`.
"""

import contextlib
import importlib.util
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

os.environ["DASK_LOGGING__DISTRIBUTED"] = "critical"  # of workers that end is to be expected
ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tests" / "integration")]

from in_process import InProcessExecutor  # noqa: E402
from test_executors import VALID, driver, make_request, rows, running_jobs  # noqa: E402

from leaderboard.running import jobs  # noqa: E402
from leaderboard.running.board import run_board  # noqa: E402
from leaderboard.running.dask_executor import LOCAL, DaskExecutor  # noqa: E402
from leaderboard.running.executors import ProcessExecutor  # noqa: E402
from leaderboard.sandbox import estimator_handler, processes  # noqa: E402

CONDITIONS, LONGEST_DELAY, STOPPED, ATTEMPTS = 2, 1.5, 3.0, 20


def descendants(word: str) -> list[int]:
    """Return the descendants of this process whose command line has a word."""
    found = []
    for process in processes.tree(os.getpid())[1:]:
        with contextlib.suppress(OSError):
            if word in Path(f"/proc/{process.pid}/cmdline").read_text():
                found.append(process.pid)
    return found


def stored_parts(out: Path) -> int:
    """Return the number of parts of a run."""
    return sum(1 for _ in out.glob("jobs/*.json"))


def kill_judges(out: Path, kills: int, rng: random.Random) -> Iterator[bool]:
    """Kill a driver after each part that it stores; yield whether it was killed, at each start."""
    for _ in range(kills):
        before, process = stored_parts(out), driver(out, CONDITIONS, VALID)
        while process.poll() is None and stored_parts(out) == before:
            time.sleep(0.02)
        time.sleep(rng.uniform(0.0, LONGEST_DELAY))
        process.kill()
        yield process.wait() == -signal.SIGKILL


def kill_others(
    victims: Callable[[], list[int]], out: Path, kills: int, rng: random.Random, executor,
    hurt: Callable[[int], object] = processes.kill,
) -> Iterator[bool]:  # fmt: skip
    """Run a board; kill one of the `victims` after each part; yield whether there was one."""
    killed: list[bool] = []

    def kill_one() -> None:
        pids = victims()
        if pids and len(killed) < kills:
            killed.append(True)
            hurt(rng.choice(pids))

    def progress(text: str, share: float) -> None:
        if share:
            timers.append(threading.Timer(rng.uniform(0.0, LONGEST_DELAY), kill_one))
            timers[-1].start()

    timers: list[threading.Timer] = []
    run_board(make_request(VALID, CONDITIONS), out, executor, progress)
    for timer in timers:
        timer.cancel()
        timer.join()
    yield from killed


def kill_jobs(out: Path, kills: int, rng: random.Random) -> Iterator[bool]:
    """Kill jobs of this process."""
    yield from kill_others(lambda: descendants(jobs.__name__), out, kills, rng, ProcessExecutor(2))


def kill_guests(out: Path, kills: int, rng: random.Random) -> Iterator[bool]:
    """Kill guests of jobs of this process."""
    yield from kill_others(
        lambda: descendants(estimator_handler.__name__), out, kills, rng, ProcessExecutor(2)
    )


def kill_workers(out: Path, kills: int, rng: random.Random) -> Iterator[bool]:
    """Kill workers of a cluster of this machine, which starts others in their place."""
    with DaskExecutor(LOCAL, 2) as executor:
        executor.workers = 4  # so that entries are spread over several jobs
        nannies = executor._cluster.workers.values
        yield from kill_others(
            lambda: [nanny.pid for nanny in nannies() if nanny.pid], out, kills, rng, executor
        )


def stop(pid: int) -> None:
    """Stop a process for some seconds, if it still runs."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGSTOP)
        time.sleep(STOPPED)
        os.kill(pid, signal.SIGCONT)


def stop_jobs(out: Path, kills: int, rng: random.Random) -> Iterator[bool]:
    """Stop jobs of this process and let them go on."""
    victims = partial(descendants, jobs.__name__)
    yield from kill_others(victims, out, kills, rng, ProcessExecutor(2), stop)


def stop_guests(out: Path, kills: int, rng: random.Random) -> Iterator[bool]:
    """Stop guests of jobs of this process and let them go on."""
    victims = partial(descendants, estimator_handler.__name__)
    yield from kill_others(victims, out, kills, rng, ProcessExecutor(2), stop)


STAGES = {
    "judge": kill_judges, "job": kill_jobs, "guest": kill_guests, "Dask worker": kill_workers,
    "job, stopped": stop_jobs, "guest, stopped": stop_guests,
}  # fmt: skip
BARE_DEVICES = ("null", "zero", "full", "random", "urandom", "tty")
WHOLE = ("bwrap", "--die-with-parent", "--dev-bind", "/", "/")
CIRCUMSTANCES = {
    "another user": (*WHOLE, "--unshare-user", "--uid", "1000", "--gid", "1000"),
    "no /dev/shm": (
        *WHOLE, "--tmpfs", "/dev",
        *(x for name in BARE_DEVICES for x in ("--dev-bind", f"/dev/{name}", f"/dev/{name}")),
    ),
    "clock jumps": (),
}  # fmt: skip
"""What a judge is started by, the whole run long."""


def jumping_clock(file: Path) -> dict[str, str]:
    """Return an environment whose clock is off by what `file` says; monotonic clocks are not."""
    found = importlib.util.find_spec("libfaketime")
    assert found is not None and found.origin is not None, "pip install libfaketime"
    (library,) = Path(found.origin).parent.rglob("libfaketime.so.1")
    return os.environ | {
        "LD_PRELOAD": str(library), "FAKETIME_TIMESTAMP_FILE": str(file),
        "FAKETIME_NO_CACHE": "1", "DONT_FAKE_MONOTONIC": "1", "FAKETIME_DONT_FAKE_MONOTONIC": "1",
    }  # fmt: skip


def check_circumstance(name: str, expected: dict, folder: Path, rng: random.Random) -> str:
    """Run a board in a circumstance. Raises AssertionError if it ends or a row is not the same."""
    out, clock, jumps = folder / name, folder / "clock", 0
    clock.write_text("+0")
    environment = jumping_clock(clock) if name == "clock jumps" else None
    process = driver(out, CONDITIONS, VALID, CIRCUMSTANCES[name], environment)
    while process.poll() is None:
        time.sleep(LONGEST_DELAY)
        clock.write_text(f"{rng.randint(-40, 40):+d}h")
        jumps += 1
    assert process.returncode == 0, name
    parts = stored_parts(out)
    found = rows(run_board(make_request(VALID, CONDITIONS), out, ProcessExecutor(1)))
    assert found == expected and stored_parts(out) == parts > 0, name
    return f"{name:15} {jumps * (name == 'clock jumps') or '':6} {1:6}   the same rows"


def check(name: str, kills: int, expected: dict, folder: Path, rng: random.Random) -> str:
    """Return the counts of a stage. Raises AssertionError if a row differs or a process is left."""
    done, runs, failed = 0, 0, 0
    while done < kills and runs < ATTEMPTS:
        out, runs = folder / f"{name} {runs}", runs + 1
        done += sum(STAGES[name](out, kills - done, rng))
        for left in out.rglob("*.partial"):
            os.utime(left, (0.0, 0.0))  # a day later
        for _ in range(ATTEMPTS):  # an entry whose guest or job was killed has failed: run again
            board = run_board(make_request(VALID, CONDITIONS), out, ProcessExecutor(1))
            failed += len(board.failed(board.tasks[0]))
            if not board.failed(board.tasks[0]):
                break
        found = rows(board)
        differ = [row for row in expected if found.get(row) != expected[row]]
        assert not differ, (
            name,
            differ,
            [getattr(found.get(row), "notes", None) for row in differ],
        )
        end = time.monotonic() + 10.0
        while (left := running_jobs(out)) and time.monotonic() < end:
            time.sleep(0.1)
        assert not left and not list(out.rglob("*.partial")), name
    assert done >= kills, f"{name}: killed {done} times only"
    return f"{name:15} {done:6} {runs:6}   the same rows"


def main() -> None:
    """Kill and print the counts."""
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    names = sys.argv[2:] or [*STAGES, *CIRCUMSTANCES]
    rng = random.Random(100)
    with tempfile.TemporaryDirectory() as folder:
        undisturbed = InProcessExecutor(estimators=VALID)
        request = make_request(VALID, CONDITIONS)
        expected = rows(run_board(request, Path(folder, "undisturbed"), undisturbed))
        print(f"{'stage':15} {'times':>6} {'runs':>6}   in the end")
        for name in names:
            if name in CIRCUMSTANCES:
                print(check_circumstance(name, expected, Path(folder), rng), flush=True)
            else:
                print(check(name, kills, expected, Path(folder), rng), flush=True)


if __name__ == "__main__":
    main()
