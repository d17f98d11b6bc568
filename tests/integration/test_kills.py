"""A run that is killed between any two writes, and resumed, leaves the board of an undisturbed one.

The killed runs are forks of the test, which kill themselves before or after a chosen write: of a
part, a row, a chart or a page.
"""

import os
import signal
from types import SimpleNamespace

import pytest
from agreement import disagreements
from board_runs import Counting, make_request

from leaderboard.entries import entry
from leaderboard.report.sentences import build_report
from leaderboard.report.site import write_site
from leaderboard.running.board import run_board

STAGES = ("jobs", "results", "page")


def run_and_write(out):
    board = run_board(make_request(), out, Counting())
    write_site(board, build_report(board), out)
    return board


def killed_run(out, writes, before):
    """Run in a fork until it has written so many files; return the last of them, None if done."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        left, replace = [writes], os.replace

        def replace_and_die(source, target):
            left[0] -= 1
            if left[0] == 0:
                os.write(write, os.fsencode(target))
            if left[0] > 0 or not before:
                replace(source, target)
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)

        os.replace = replace_and_die
        status = 1
        try:
            run_and_write(out)
            status = 0
        finally:
            os._exit(status)
    os.close(write)
    with open(read) as file:
        last = file.read()
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == (-signal.SIGKILL if last else 0)
    return last or None


def stage_of(path, out):
    first = os.path.relpath(path, out).partition(os.sep)[0]
    return first if first in STAGES else "page"


@pytest.mark.processes
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_run_killed_20_times_gives_the_same_board(tmp_path, monkeypatch):
    # times differ from run to run, and are shown on the pages
    monkeypatch.setattr(entry, "time", SimpleNamespace(perf_counter=lambda: 0.0))
    expected = run_and_write(tmp_path / "undisturbed")
    out = tmp_path / "killed"
    kills = dict.fromkeys(STAGES, 0)
    while sum(kills.values()) < 20:
        # a killed site is written from its beginning, so it is killed later and later
        writes = 1 + kills["page"] if kills["page"] else 1 + sum(kills.values()) % 3
        last = killed_run(out, writes, before=sum(kills.values()) % 2 == 0)
        assert last is not None, kills
        kills[stage_of(last, out)] += 1
    assert min(kills.values()) >= 2
    for partial in out.rglob("*.partial"):
        os.utime(partial, (0.0, 0.0))  # a day later
    found = run_and_write(out)
    for name, results in expected.results.items():
        rows = {r.estimator: r for r in found.results[name]}
        assert len(rows) == len(results)
        for result in results:
            assert disagreements(rows[result.estimator], result) == []
    pages = {path.relative_to(tmp_path / "undisturbed"): path.read_bytes() for path in
             (tmp_path / "undisturbed").rglob("*.html")}  # fmt: skip
    assert len(pages) > 5
    for path, content in pages.items():
        assert (out / path).read_bytes() == content, path
    assert not list(out.rglob("*.partial"))
