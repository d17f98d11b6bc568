"""Sandbox: results, limits, isolation and cleanup of entries that misbehave."""

import dataclasses
import os
import socket
import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fakes import Learner, Reader, fake_drives, task

from leaderboard.evaluation import entries
from leaderboard.evaluation.entry import EntryError, reconstruct_all
from leaderboard.sandbox import client as client_module
from leaderboard.sandbox import namespaces
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs import _numba

MODES = ["namespaces", "process"] if namespaces.available() else ["process"]
LIMITS = Limits(seconds=20.0, memory=0.5, processes=40, file=0.05)


@pytest.fixture(scope="module", params=MODES)
def any_sandbox(request):
    limits = dataclasses.replace(LIMITS, namespaces=request.param == "namespaces")
    with SandboxClient(limits) as sandbox:
        assert sandbox.isolation == request.param
        yield sandbox


@pytest.fixture
def sandbox(any_sandbox):
    """A client of the sandbox; limits and hidden folders are reset after each test."""
    limits = any_sandbox.limits
    yield any_sandbox
    any_sandbox.limits, any_sandbox.hidden = limits, ()


def limit(sandbox, **limits):
    sandbox.limits = dataclasses.replace(sandbox.limits, **limits)


def only_once(sandbox):
    if sandbox.isolation != MODES[0]:
        pytest.skip("the same in every mode")


def drives(number=1):
    t = task(test={"roads": ["iso_d"], "seeds": [11, 12], "length": 40.0, "number": number})
    training = [(d.record, d.truth) for d in fake_drives(t, t.training, t.conditions[0])]
    return training, [d.record for d in fake_drives(t, t.test, t.conditions[0])], t.vehicle


def run(sandbox, estimator=None, how="", where="", seeds=(1,), number=1, **settings):
    reference = estimator or "hostile:Hostile"
    settings = settings or {"how": how, "where": str(where)}
    training, records, car = drives(number)
    training = [] if how and how != "look_for_truth" else training
    return sandbox.reconstruct(reference, settings, training, records, car, seeds, cache="hostile")


def process_family(sandbox):
    """Return all processes with the environment of the client's server."""
    marked = f"HOME={sandbox._home}".encode()
    found = []
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            if marked in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
                found.append(int(pid))
        except OSError:
            continue
    return found


def only_server_left(sandbox, patience=5.0):
    """Return whether only the server is left, after waiting for the kernel for `patience` [s]."""
    end = time.monotonic() + patience
    while (found := process_family(sandbox)) != [sandbox._server.pid] and time.monotonic() < end:
        time.sleep(0.02)
    return found == [sandbox._server.pid]


@pytest.mark.parametrize("estimator", [Reader(gain=0.7), Learner(), Learner(spread=0.0)])
def test_estimates_in_the_sandbox_are_bitwise_those_of_this_process(sandbox, estimator):
    known = entries.make_entry("x", estimator)
    training, records, car = drives(2)
    expected = list(reconstruct_all(estimator, training, records, car, (1, 2, 3)))
    found = run(sandbox, known.reference, seeds=(1, 2, 3), number=2, **known.settings)
    assert [training_run.seed for training_run in found] == [
        training_run.seed for training_run in expected
    ]
    assert [training_run.parameters for training_run in found] == [o.parameters for o in expected]
    for mine, theirs in zip(found, expected, strict=True):
        for a, b in zip(mine.estimates, theirs.estimates, strict=True):
            np.testing.assert_array_equal(a.z, b.z)
            np.testing.assert_array_equal(a.s, b.s)
            assert a.z_std is None
    assert found[0].isolation == sandbox.isolation and 0.01 < found[0].peak_memory < 2.0
    assert found[0].estimate_seconds > 0.0 and only_server_left(sandbox)


def test_standard_deviations_are_returned_from_the_sandbox(sandbox):
    (training_run,) = run(sandbox, "fakes:Doubtful", std=0.003)
    np.testing.assert_array_equal(training_run.estimates[0].z_std, 0.003)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("exit_softly", "its process ended without a response, by exit status 0"),
        ("exit_hard", "its process ended without a response, by "),
        ("crash", "by SIGSEGV; its last output: "),
        ("grasp", "estimating test drive 1 of 1, seed 1: "),
        ("hoard", "memory limit"),
        ("hoard_in_children", "using more than 0.5 GiB, the memory limit"),
        ("multiply", "more than 40 processes"),
        ("patch_evaluation", "test drive 1 of 1, seed 1: heights z: every value must be finite"),
        ("fill", "File too large"),
    ],
)
def test_every_failure_is_one_sentence_and_leaves_no_process(sandbox, how, message):
    with pytest.raises(EntryError) as error:
        run(sandbox, how=how)
    text = str(error.value)
    assert message in text or (how in ("hoard", "grasp") and "MemoryError" in text), text
    assert "\n" not in text and len(text) < 500
    assert only_server_left(sandbox)
    assert len(run(sandbox, how="nothing")) == 1  # the next entry is not affected


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("forge_answer", "its response is invalid: "),
        ("link_answer", "response.json cannot be read: "),
        ("answer_with_a_pipe", "response.json is not a regular file"),
        ("answer_at_length", "response.json has 2000015 bytes, the limit is 1000000"),
        ("answer_without_estimates", "its estimates of the training with seed 1 are missing"),
        ("send_a_pickle", "must be float64 (2, 1585), got object (1,)"),
        ("send_a_bomb", "must be float64 (2, 1585), got float64 (2, 4194304)"),
        ("send_another_name", "unexpected array 'truth'"),
        ("send_half", "seed-1.npz: File is not a zip file"),
    ],
)
def test_a_forged_response_is_rejected(sandbox, how, message):
    only_once(sandbox)
    with pytest.raises(EntryError) as error:
        run(sandbox, how=how)
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("how", ["hang", "spin"])
def test_an_entry_that_does_not_return_is_stopped_at_the_time_limit(sandbox, how):
    limit(sandbox, seconds=0.5)
    begin = time.monotonic()
    with pytest.raises(EntryError, match=r"stopped after 0\.5 s, the time limit"):
        run(sandbox, how=how)
    assert time.monotonic() - begin < 10.0 and only_server_left(sandbox)


def test_child_processes_do_not_outlive_their_entry(sandbox):
    assert len(run(sandbox, how="leave_children")) == 1
    assert only_server_left(sandbox)


def test_100_megabytes_of_output_are_counted_and_discarded(sandbox):
    assert len(run(sandbox, how="print")) == 1
    assert sandbox.run_status.output_size == 100_000_000 + len("that was 100 MB\n")
    assert sandbox.run_status.output_tail.endswith("that was 100 MB\n")
    assert len(sandbox.run_status.output_tail) <= 4000


@pytest.mark.parametrize("how", ["kill_parent", "kill_grandparent", "stop_parent"])
def test_an_entry_that_attacks_its_supervisor_harms_only_itself(sandbox, how, monkeypatch):
    monkeypatch.setattr(client_module, "GRACE_PERIOD", 1.0)
    limit(sandbox, seconds=1.5)
    with pytest.raises(EntryError) as error:
        run(sandbox, how=how)
    if sandbox.isolation == "namespaces":  # it sees no other process
        assert "ProcessLookupError: no process above" in str(error.value)
    else:
        assert "its supervisor was ended by" in str(error.value)
    limit(sandbox, seconds=20.0)
    assert len(run(sandbox, how="nothing")) == 1 and only_server_left(sandbox)


def test_environment_variables_are_not_passed_to_an_entry(sandbox, monkeypatch):
    only_once(sandbox)
    monkeypatch.setenv("ROADRECON_SECRET", "a token")
    sandbox._stop()
    sandbox._server = sandbox._start()
    with pytest.raises(EntryError) as error:
        run(sandbox, how="ask_for_secrets")
    assert "it has None at " in str(error.value) and str(Path.home()) not in str(error.value)


def test_test_records_come_without_truth_road_and_seed(sandbox, tmp_path):
    with pytest.raises(EntryError) as error:
        run(sandbox, how="look_for_truth", where=tmp_path)
    files = ["request.json", "test-0.parquet"]
    files += [f"training-{k}.{kind}" for k in range(2) for kind in ("npz", "parquet")]
    assert f"found [], input files {files} and" in str(error.value)
    keys = ["car", "reference", "seeds", "settings", "tests", "training"]
    assert str(error.value).endswith(f"and {keys}")


def test_an_entry_has_no_network_in_namespaces(sandbox):
    received = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        # without a network nothing arrives; with one, the sandbox needs time to start
        server.settimeout(0.5 if sandbox.isolation == "namespaces" else 20.0)

        def listen():
            try:
                line, _ = server.accept()
                received.append(line.recv(100))
                line.close()
            except TimeoutError:
                pass

        thread = threading.Thread(target=listen)
        thread.start()
        call = partial(run, sandbox, how="connect", where=server.getsockname()[1])
        if sandbox.isolation == "namespaces":
            with pytest.raises(EntryError, match=r"Network is unreachable|refused"):
                call()
        else:
            call()
        thread.join()
    assert received == ([] if sandbox.isolation == "namespaces" else [b"the record is mine"])


def test_in_namespaces_other_folders_are_read_only_and_results_are_hidden(sandbox, tmp_path):
    if sandbox.isolation != "namespaces":
        pytest.skip("no namespaces: an entry may write where its user may")
    results, other = tmp_path / "results", tmp_path / "other"
    for folder in (results, other):
        folder.mkdir()
        (folder / "row.json").write_text("{}")
    sandbox.hidden = (str(results),)
    with pytest.raises(EntryError, match="Read-only file system"):
        run(sandbox, how="write_elsewhere", where=other)
    with pytest.raises(EntryError, match=r"Read-only|No space"):
        run(sandbox, how="write_elsewhere", where=results)
    with pytest.raises(EntryError, match=r"found \[\],"):
        run(sandbox, how="look_for_truth", where=results)
    with pytest.raises(EntryError, match=r"found \['row.json'\],"):
        run(sandbox, how="look_for_truth", where=other)
    run(sandbox, how="poison_kernels")
    assert [p.name for p in results.iterdir()] == [p.name for p in other.iterdir()] == ["row.json"]
    assert not (_numba.CACHE / "hostile.nbc").exists()
    (_numba.CACHE.parent / "entries" / _numba.CACHE.name / "hostile" / "hostile.nbc").unlink()


def test_the_server_has_one_thread_when_it_forks(sandbox):
    run(sandbox, how="nothing")
    assert len(os.listdir(f"/proc/{sandbox._server.pid}/task")) == 1


def test_a_plug_in_is_described_without_being_loaded_in_this_process(
    sandbox, tmp_path, monkeypatch
):
    only_once(sandbox)
    (tmp_path / "external_slope.py").write_text(
        "import sys\n"
        "from dataclasses import dataclass\n"
        "from typing import ClassVar\n"
        "@dataclass(frozen=True, kw_only=True)\n"
        "class Slope:\n"
        "    causal: ClassVar[bool] = True\n"
        "    steep: float = 0.5\n"
        "    def estimate(self, record, car): ...\n"
    )
    about = tmp_path / "external_slope-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: external-slope\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        "[road_envs.estimators]\nslope = external_slope:Slope\nsunken = no_such_module:Hole\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with SandboxClient(sandbox.limits) as fresh:
        slope, sunken, flat = entries.resolve_entries(["slope", "sunken", "flat"], fresh)
    assert (slope.settings, slope.causal, slope.failure) == ({"steep": 0.5}, True, None)
    assert len(slope.code) == 16 and "external_slope" not in sys.modules
    assert "cannot be constructed: ConfigError: the estimator 'sunken'" in sunken.failure
    assert flat.reference == "flat" and flat.failure is None
    before = slope.code
    (tmp_path / "external_slope.py").write_text(
        (tmp_path / "external_slope.py").read_text().replace("0.5", "0.6")
    )
    with SandboxClient(sandbox.limits) as fresh:
        (slope,) = entries.resolve_entries(["slope"], fresh)
    assert slope.code != before and slope.settings == {"steep": 0.6}


def test_limits_must_be_positive():
    for name in ("seconds", "memory", "processes", "file"):
        with pytest.raises(ValueError, match=f"{name} must be positive, got 0"):
            Limits(**{name: 0})
