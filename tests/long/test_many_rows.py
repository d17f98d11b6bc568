"""Memory of reading, printing and drawing a board of ten thousand rows.

pytest -m slow -s tests/long/test_many_rows.py
"""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fake_estimators import Learner, Reader
from fakes import fake_drives, task

from leaderboard.evaluation import store
from leaderboard.evaluation.evaluate import run_task
from road_envs.core.atomic_io import write_text

TASKS = 10
MEMORY_LIMIT = 1.0
"""Largest allowed peak memory [GiB]."""

SHORT = {
    "training": {"roads": ["iso_d"], "seeds": [1], "length": 20.0},
    "test": {"roads": ["iso_d"], "seeds": [11, 12, 13, 14], "length": 20.0},
}

DRIVER = """
import resource, sys, time
from pathlib import Path
from rich.console import Console
from test_many_rows import tasks
from leaderboard.running.board import load_board
from leaderboard.report.site import write_site
from leaderboard.report.sentences import build_report
from leaderboard.report.terminal import print_tables

out, begin = Path(sys.argv[1]), time.process_time()
board = load_board(tasks(), out)
report = build_report(board)
print_tables(report, Console(file=(out / "tables.txt").open("w"), width=80))
page = write_site(board, report, out)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(peak, time.process_time() - begin, page.stat().st_size / 1e6)
"""


def tasks():
    return [task(f"held_out_{k}", **SHORT) for k in range(TASKS)]


def many_rows(out, rows):
    """Store `rows` results of entries with made-up names, the same on every task."""
    for one in tasks():
        entries = {"a": Reader(), "b": Reader(gain=0.5), "c": Learner()}
        results = run_task(one, entries, (1, 2), simulate=fake_drives)
        for n in range(rows // TASKS):
            row = dataclasses.replace(results[n % len(results)], estimator=f"entry_{n:05d}")
            write_text(store.row_path(out, one.name, row.estimator), store.to_text(row))


def driver(out):
    """Run DRIVER; return its peak memory [GiB], processor time [s] and size of the index [MB]."""
    path = os.pathsep.join(
        [str(Path(__file__).parents[1] / "support"), *map(os.path.abspath, sys.path)]
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore::ResourceWarning", "-c", DRIVER, str(out)],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    return tuple(map(float, done.stdout.split()))


@pytest.mark.slow
@pytest.mark.parametrize("rows", [1_000, 10_000])
def test_memory_stays_below_1_gib_for_any_number_of_rows(tmp_path, rows):
    many_rows(tmp_path, rows)
    peak, seconds, index = driver(tmp_path)
    print(f"{rows} rows: {peak:.2f} GiB, {seconds:.0f} s, index of {index:.1f} MB")
    assert peak < MEMORY_LIMIT
