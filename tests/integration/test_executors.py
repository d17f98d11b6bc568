"""Executors: jobs in processes and on a Dask cluster, with hostile entries and killed runs."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fake_estimators import Reader
from fakes import task
from hostile import Hostile
from in_process import InProcessExecutor

from estimators import create
from leaderboard.entries.entries import make_entry
from leaderboard.entries.entry import Entry
from leaderboard.evaluation import store
from leaderboard.evaluation.results import RUN, RUN_DEPENDENT, to_plain
from leaderboard.metrics.baselines import BASELINES
from leaderboard.running import dask_executor as cluster_module
from leaderboard.running import executors, jobs
from leaderboard.running.board import RunRequest, run_board
from leaderboard.running.dask_executor import DaskExecutor
from leaderboard.running.executors import EvaluatorError, ProcessExecutor
from leaderboard.sandbox import bubblewrap, launch
from leaderboard.sandbox.limits import Limits
from road_envs.core.config import ConfigError
from road_envs.core.extras import MissingExtraError
from road_envs.roads import load_road, with_length
from road_envs.roads.formats.write import write_csv
from road_envs.vehicle.parameters import load_vehicle, write_vehicle

LIMITS = Limits(seconds=60.0, memory=0.7, processes=40, isolation="process")
"""Processes: `test_hostile_entries.py` has entries inside bubblewrap."""

VALID = {"reader": Reader(), "half_as_bad": Reader(gain=0.45)}
ONE = {"reader": VALID["reader"]}


CONDITIONS = ({"mode": "ride", "speed_kmh": 36.0}, {"mode": "handling", "speed_kmh": 54.0})


def small(conditions=1, **changes):
    """A task with 16 m of road and the simulated vehicle.

    One condition, since every job and every entry is a process; two are slow.
    """
    short = {"roads": ["iso_d"], "length": 16.0}
    settings = {"training": {**short, "seeds": [1]}, "test": {**short, "seeds": [11, 12]}}
    return task(conditions=list(CONDITIONS[:conditions]), **{**settings, **changes})


def make_request(estimators=VALID, conditions=1):
    entries = [make_entry(name, estimator) for name, estimator in estimators.items()]
    return RunRequest([small(conditions)], entries, seeds=(1, 2), limits=LIMITS)


def rows(board):
    """Return the scored results without timings and environment."""
    return {
        r.estimator: {k: x for k, x in to_plain(r).items() if k not in RUN_DEPENDENT}
        for r in board.scored(board.tasks[0])
    }


@pytest.fixture(scope="module", params=[1, pytest.param(2, marks=pytest.mark.slow)])
def conditions(request):
    """Number of conditions of the task."""
    return request.param


@pytest.fixture(scope="module")
def expected(tmp_path_factory, conditions):
    """Rows of the valid entries, run in this process."""
    request = make_request(conditions=conditions)
    executor = InProcessExecutor(estimators=VALID)
    board = run_board(request, tmp_path_factory.mktemp("expected"), executor)
    assert set(rows(board)) == {*VALID, *BASELINES} and not board.failed(board.tasks[0])
    return rows(board)


@pytest.mark.slow
def test_without_isolation_failing_entries_do_not_change_a_bit_of_the_other_rows(
    tmp_path, expected, conditions
):
    failures = {
        "exit_softly": "its process ended without a response, by exit status 0",
        "tamper": None,
        "kill_evaluation": "",
    }
    if conditions > 1:
        failures["leave_children"] = None
        failures["patch_evaluation"] = "heights z: every value must be finite"
    first, second = VALID
    hostile = {how: Hostile(how=how, where=str(tmp_path)) for how in failures}
    estimators = {first: VALID[first], **hostile, second: VALID[second]}
    board = run_board(make_request(estimators, conditions), tmp_path, ProcessExecutor(1))
    results = {r.estimator: None for r in board.scored(board.tasks[0])}
    results |= {r.estimator: r.failure for r in board.failed(board.tasks[0])}
    assert set(results) == {*failures, *expected}
    for how, failure in failures.items():
        assert (results[how] is None) == (failure is None), (how, results[how])
        assert failure is None or (failure in results[how] and "\n" not in results[how])
    assert {name: row for name, row in rows(board).items() if name in expected} == expected
    assert (
        "process was ended twice while it ran: its process ended without a response, by SIGKILL"
        in results["kill_evaluation"]
    )
    assert not running_jobs(tmp_path)


def running_jobs(out):
    """Return the processes that still run a job of `out`."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdigit() and str(out) in (folder / "cmdline").read_text():
                found.append(folder.name)
        except OSError:
            continue
    return found


DRIVER = """
import sys
from pathlib import Path
sys.path[:0] = {folders!r}
from test_executors import VALID, make_request, run_board
from leaderboard.running.executors import ProcessExecutor
request = make_request({{name: VALID[name] for name in sys.argv[3:]}}, int(sys.argv[2]))
run_board(request, Path(sys.argv[1]), ProcessExecutor(2))
"""


def driver(out, conditions, names, before=(), environment=None):
    code = DRIVER.format(
        folders=[str(Path(__file__).parent), str(Path(__file__).parents[1] / "support")]
    )
    command = [*before, sys.executable, "-c", code, str(out), str(conditions), *names]
    return subprocess.Popen(command, cwd=Path(__file__).parents[2], env=environment)


def killed_and_resumed(out, expected, delays, conditions, estimators=VALID):
    """Kill and resume a run, each delay [s] after its first job; return how often it was killed.

    Its processes must end with it, and the last run must give the expected rows.
    """
    kills = 0
    for delay in delays:
        process = driver(out, conditions, estimators)
        while process.poll() is None and len(running_jobs(out)) < 2:
            time.sleep(0.05)
        time.sleep(delay)
        process.send_signal(signal.SIGKILL)
        if process.wait() != -signal.SIGKILL:
            break
        kills += 1
        end = time.monotonic() + 10.0
        while (left := running_jobs(out)) and time.monotonic() < end:
            time.sleep(0.05)
        assert not left
    found = rows(run_board(make_request(estimators, conditions), out, ProcessExecutor(1)))
    assert found == {name: expected[name] for name in (*estimators, *BASELINES)}
    return kills


@pytest.mark.processes
def test_killing_a_run_ends_its_processes_and_it_can_be_resumed(tmp_path, expected, conditions):
    assert killed_and_resumed(tmp_path, expected, [1.5] * conditions, conditions, ONE) >= 1


@pytest.mark.costly
def test_a_failure_of_the_evaluation_is_not_attributed_to_an_entry(tmp_path, monkeypatch):
    monkeypatch.setattr(executors.jobs, "to_text", lambda job: "{")
    with pytest.raises(ConfigError, match="damaged, not valid JSON"):
        run_board(make_request({}), tmp_path, ProcessExecutor(1))
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(EvaluatorError):
        run_board(make_request({}), tmp_path, ProcessExecutor(1))
    with pytest.raises(ConfigError, match="the number of workers must be at least 1, got 0"):
        ProcessExecutor(0)


@pytest.mark.costly
def test_a_process_of_jobs_that_something_else_ends_as_it_starts_is_started_once_more(
    tmp_path, monkeypatch
):
    started, make = [], launch.Guest

    def killed_at_first(words, *rest):
        started.append(words)
        return make(["sh", "-c", "kill -KILL $$"] if len(started) == 1 else words, *rest)

    monkeypatch.setattr(launch, "Guest", killed_at_first)
    board = run_board(make_request({"flat": create("flat")}), tmp_path, ProcessExecutor(1))
    assert len(started) >= 2 and "flat" in rows(board) and not board.failed(small())


@pytest.mark.costly
def test_jobs_with_entries_of_this_package_share_a_process_and_its_guest(tmp_path, monkeypatch):
    started = []
    start = executors.start_host_process
    monkeypatch.setattr(
        executors, "start_host_process", lambda *words: started.append(1) or start(*words)
    )
    request = make_request({"flat": create("flat")}, conditions=2)
    board = run_board(request, tmp_path / "processes", ProcessExecutor(1))
    assert len(started) == 1 and not running_jobs(tmp_path)
    assert rows(board) == rows(run_board(request, tmp_path / "here", InProcessExecutor()))


def test_an_entry_that_cannot_be_constructed_is_a_failed_row(tmp_path):
    lost = Entry(name="lost", reference="nowhere:Lost", failure="cannot be constructed: no module")
    request = dataclasses.replace(make_request({}), entries=[lost])
    board = run_board(request, tmp_path, InProcessExecutor())
    (failed,) = board.failed(small())
    assert (failed.estimator, failed.failure) == ("lost", "cannot be constructed: no module")


# on a cluster


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A scheduler and two workers in separate processes: address, and the workers.

    A worker has an empty folder in place of all temporary folders of the tests, and cannot import
    the modules of the tests: what it needs of them must be sent to it.
    """
    pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    if (obstacle := bubblewrap.obstacle()) is not None:
        pytest.skip(obstacle)
    folder = tmp_path_factory.mktemp("dask")
    tests = Path(__file__).resolve().parents[1]
    paths = [path for path in map(os.path.abspath, sys.path) if tests not in Path(path).parents]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(paths),
        "DASK_DISTRIBUTED__WORKER__DAEMON": "False",
    }

    def start(module, *words, before=()):
        with (folder / "log.txt").open("ab") as log:
            command = [*before, sys.executable, "-m", "distributed.cli." + module, *words]
            return subprocess.Popen(command, cwd=folder, env=environment, stderr=log, stdout=log)

    file = folder / "scheduler.json"
    options = ("--scheduler-file", str(file), "--no-dashboard", "--host", "127.0.0.1")
    processes = [start("dask_scheduler", *options, "--port", "0")]
    end = time.monotonic() + 60.0
    while not file.exists() and time.monotonic() < end:
        time.sleep(0.1)
    address = json.loads(file.read_text())["address"]
    hidden = str(tmp_path_factory.getbasetemp())
    alone = ("bwrap", "--dev-bind", "/", "/", "--tmpfs", hidden, "--die-with-parent")
    alone += ("--chdir", hidden)
    worker = ("dask_worker", address, "--no-dashboard", "--nthreads", "1", "--no-nanny")
    processes += [start(*worker, "--name", str(k), before=alone) for k in range(2)]
    yield address, processes[1:]
    for process in processes:
        process.kill()
        process.wait()


def request_of_files(folder):
    """Return a request for a measured surface and a vehicle in files of `folder`."""
    road, car = folder / "surface.csv", folder / "vehicle.yaml"
    surface = with_length(load_road("iso_d"), 16.0).realise(np.random.default_rng(3))
    write_csv(surface, road)
    write_vehicle(car, load_vehicle("land_rover_defender_110"))
    test = {"roads": [{"kind": "measured", "path": str(road)}], "seeds": [11, 12]}
    return dataclasses.replace(make_request(ONE), tasks=[small(car=str(car), test=test)])


@pytest.mark.slow
def test_a_cluster_without_shared_files_that_loses_a_worker_gives_the_same_board(tmp_path, cluster):
    address, workers = cluster
    request = request_of_files(tmp_path)
    expected = rows(run_board(request, tmp_path / "here", InProcessExecutor(estimators=ONE)))
    assert set(expected) == {*ONE, *BASELINES}
    executor = DaskExecutor(address)
    executor._client.wait_for_workers(2, timeout=60)
    seen = executor._client.run(lambda *paths: any(map(os.path.exists, paths)), str(tmp_path))
    assert list(seen.values()) == [False, False]
    executor.workers = 3  # so that each worker has a job to lose
    done = []

    def lose_a_worker(text, share):
        done.append(share)
        if len(done) == 2:
            workers[0].kill()

    board = run_board(request, tmp_path / "cluster", executor, lose_a_worker)
    assert rows(board) == expected and not board.failed(request.tasks[0])
    assert workers[0].wait() == -signal.SIGKILL
    assert done[-1] == 1.0
    executor._client.close()


def test_a_missing_dask_scheduler_is_reported(monkeypatch):
    pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    monkeypatch.setattr(cluster_module, "SCHEDULER_TIMEOUT", 1.0)
    for address in ("tcp://127.0.0.1:9", "no address"):
        with pytest.raises(ConfigError, match=f"no Dask scheduler answers at '{address}'"):
            DaskExecutor(address)


def test_without_dask_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'road-envs\[dask\]'"):
        DaskExecutor("tcp://127.0.0.1:9")


@pytest.mark.costly
def test_run_job_stores_the_result_of_a_run(tmp_path, expected, conditions):
    from typer.testing import CliRunner

    from leaderboard.cli import app
    from leaderboard.running.board import write_jobs

    count = write_jobs(make_request(ONE, conditions), tmp_path / "out", tmp_path / "jobs")
    assert count == conditions * (1 + len(BASELINES))
    specs = sorted((tmp_path / "jobs").glob("*.json"))
    spec = next(path for path in specs if '"name": "reader"' in path.read_text())
    job = jobs.from_text(spec.read_text(), str(spec))
    label = job.task.conditions[job.condition].label
    called = CliRunner().invoke(app, ["run-job", str(spec), "--out", str(tmp_path / "out")])
    assert called.exit_code == 0, called.output
    assert f"small: reader, {label}: done" in " ".join(called.output.split())
    known = jobs.result_identity(job.task, job.condition, job.entries[0], job.seeds)
    part = store.load_part(store.part_path(tmp_path / "out", known))
    names = [*RUN, "score"]
    table = pd.DataFrame(expected["reader"]["scores"])
    whole = table[table["condition"] == label].set_index(names)["value"]
    assert part.scores.set_index(names)["value"].to_dict() == whole.to_dict()
