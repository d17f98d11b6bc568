"""Sandbox: results, limits, isolation and cleanup of entries that misbehave."""

import dataclasses
import fcntl
import os
import random
import re
import signal
import socket
import sys
import threading
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fake_estimators import CalibratedReader, Learner, Reader
from fakes import fake_drives, task
from guests import LIMITS, MARK, drives, marked_processes, nothing_left, run
from hostile import poisoned_kernels

from estimators.api import CalibrationDrive
from leaderboard.entries import entries
from leaderboard.entries.entry import Entry, EntryError, LocalSession, reconstruct_all
from leaderboard.sandbox import bubblewrap, limits
from leaderboard.sandbox import client as client_module
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.retest import NOT_RETESTED
from road_envs.core.code_digest import ROOT
from road_envs.core.config import ConfigError

MODES = ["process"] if bubblewrap.obstacle() else ["bubblewrap", "process"]
"""Each guest takes a second: the second mode is slow, and `test_executors.py` has attacks in it."""

REFUSED_PLACE = "Read-only file system|Permission denied|No such file or directory"
CALIBRATED = "fake_estimators:CalibratedReader"


@pytest.fixture(
    scope="module",
    params=[MODES[0], *(pytest.param(mode, marks=pytest.mark.slow) for mode in MODES[1:])],
)
def any_sandbox(request):
    names = limits.INHERITED_VARIABLES
    limits.INHERITED_VARIABLES = (*names, MARK)
    os.environ[MARK] = "1"
    with SandboxClient(dataclasses.replace(LIMITS, isolation=request.param)) as sandbox:
        assert sandbox.isolation == request.param
        yield sandbox
    limits.INHERITED_VARIABLES = names
    del os.environ[MARK]


@pytest.fixture
def sandbox(any_sandbox):
    """A client of the sandbox; its limits are reset after each test."""
    limits = any_sandbox.limits
    yield any_sandbox
    any_sandbox.limits = limits


def limit(sandbox, **limits):
    sandbox.limits = dataclasses.replace(sandbox.limits, **limits)


def only_once(sandbox):
    if sandbox.isolation != MODES[0]:
        pytest.skip("the same in every mode")


@pytest.mark.costly
@pytest.mark.parametrize(
    "estimator",
    [pytest.param(Reader(gain=0.7), marks=pytest.mark.slow), Learner(), Learner(spread=0.0)],
)
def test_estimates_in_the_sandbox_are_bitwise_those_of_this_process(sandbox, estimator):
    known = entries.make_entry("x", estimator)
    training, records, car = drives(2)
    expected = list(reconstruct_all(LocalSession(estimator, car), training, records, (1, 2, 3)))
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
    assert found[0].estimate_seconds > 0.0 and nothing_left()
    one_training = len(found) == 1 and isinstance(estimator, Learner)
    assert found[0].notes == (("its training does not depend on the seed",) * one_training)


def calibration_drives(number, known):
    """Drives of the vehicle of each of `number` records, two of each, the second measured."""
    t = task(training={"roads": ["iso_d"], "seeds": [*range(1, 2 * number + 1)], "length": 20.0})
    made = list(fake_drives(t, t.training, t.conditions[0]))
    return [
        [
            CalibrationDrive(made[2 * k].record, name="first"),
            CalibrationDrive(
                made[2 * k + 1].record, made[2 * k + 1].truth if known else None, 0.002
            ),
        ]
        for k in range(number)
    ]


@pytest.mark.costly
@pytest.mark.parametrize("known", [pytest.param(False, marks=pytest.mark.slow), True])
def test_each_estimate_follows_the_calibration_to_its_own_vehicle(sandbox, known):
    """In this process and in a guest, which asks for the estimates in any order."""
    training, records, car = drives(2)
    given = calibration_drives(2, known)
    estimator, entry = (
        CalibratedReader(),
        Entry(name="x", reference="fake_estimators:CalibratedReader"),
    )
    session = LocalSession(estimator, car)
    (here,) = reconstruct_all(session, training, records, (1,), None, given)
    (there,) = sandbox.reconstruct(
        entry, training, records, car, (1,), calibrations=given, retest=True
    )
    for k in range(2):
        profile = given[k][1].profile
        gain = np.abs(profile.z).max() + 0.002 if profile else 2.0
        expected = Reader(gain=gain).estimate(records[k], car).z
        np.testing.assert_array_equal(here.estimates[k].z, expected)
        np.testing.assert_array_equal(there.estimates[k].z, expected)
    assert here.calibrate_seconds >= 0.0 and there.calibrate_seconds >= 0.0
    assert there.notes == () and nothing_left()


@pytest.mark.costly
@pytest.mark.parametrize("second_first", [True, False])
@pytest.mark.parametrize("causal", [True, False])
def test_the_page_cache_is_dropped_before_each_guest_of_an_entry(
    sandbox, monkeypatch, causal, second_first
):
    """Another entry may have had the drives: what only the first of two guests knew of it told
    them which of them was the first.
    """

    class Chosen(random.SystemRandom):
        def random(self):
            return 0.1 if second_first else 0.9

    steps, start = [], SandboxClient._start
    monkeypatch.setattr(client_module.random, "SystemRandom", Chosen)
    monkeypatch.setattr(
        SandboxClient, "_start", lambda self, name: steps.append("guest") or start(self, name)
    )
    monkeypatch.setattr(
        client_module.bubblewrap, "forget_reads", lambda more: steps.append("dropped")
    )
    if sandbox.isolation != "bubblewrap":
        pytest.skip("processes of the user are trusted: they share the files")
    entry = Entry(name="x", reference="fake_estimators:Reader", causal=causal)
    sandbox.reconstruct(entry, *drives(2), (1,), retest=True)
    assert steps == ["dropped", "guest", "dropped", "guest"]


@pytest.mark.costly
@pytest.mark.parametrize(("kills", "notes"), [(1, ()), (2, (NOT_RETESTED,))])
def test_a_second_guest_that_something_else_ended_is_asked_once_more(
    sandbox, monkeypatch, kills, notes
):
    class SecondGuestLast(random.SystemRandom):
        def random(self):
            return 0.9

    sessions, dropped, make_session = [], [], SandboxClient._session

    def killed_session(self, guest, *rest):
        sessions.append(make_session(self, guest, *rest))
        if 2 <= len(sessions) < 2 + kills:
            os.kill(guest.pid, signal.SIGKILL)
        return sessions[-1]

    monkeypatch.setattr(client_module.random, "SystemRandom", SecondGuestLast)
    monkeypatch.setattr(SandboxClient, "_session", killed_session)
    monkeypatch.setattr(
        client_module.bubblewrap, "forget_reads", lambda more: dropped.append(len(sessions))
    )
    training, records, car = drives(2)
    entry = Entry(name="x", reference="fake_estimators:Reader", causal=True)
    (run,) = sandbox.reconstruct(entry, training, records, car, (1,), retest=True)
    assert [note[: len(NOT_RETESTED)] for note in run.notes] == list(notes)
    assert run.looks_ahead == bool(notes)
    assert len(sessions) == 3 and nothing_left()
    # else an attempt could tell the next one
    assert dropped == ([0, 1, 2] if sandbox.isolation == "bubblewrap" else [])


def test_an_estimator_that_cannot_be_calibrated_ignores_the_drives(sandbox):
    training, records, car = drives()
    entry = Entry(name="x", reference="fake_estimators:Reader")
    given = calibration_drives(1, False)
    (there,) = sandbox.reconstruct(entry, training, records, car, (1,), calibrations=given)
    assert there.calibrate_seconds is None
    np.testing.assert_array_equal(there.estimates[0].z, Reader().estimate(records[0], car).z)


def test_a_failing_calibration_fails_the_entry_with_its_sentence(sandbox):
    training, records, car = drives()
    entry = Entry(name="x", reference=CALIBRATED, settings={"how": "raises"})
    reason = (
        "calibrating to the vehicle of test drive 1, seed 1: CalibrationError: first: too smooth"
    )
    with pytest.raises(EntryError, match=reason):
        sandbox.reconstruct(
            entry, training, records, car, (1,), calibrations=calibration_drives(1, False)
        )
    assert nothing_left()


def test_standard_deviations_are_returned_from_the_sandbox(sandbox):
    (training_run,) = run(sandbox, "fake_estimators:Doubtful", std=0.003)
    np.testing.assert_array_equal(training_run.estimates[0].z_std, 0.003)


@pytest.mark.costly
def test_estimators_of_this_package_share_a_guest_until_one_fails(sandbox):
    first = run(sandbox, "flat")
    guest = sandbox.guest
    assert run(sandbox, "mean") and sandbox.guest is guest
    assert first[0].estimates[0].z.any() == np.False_
    with pytest.raises(EntryError, match="cannot be constructed: ConfigError: unknown setting"):
        run(sandbox, "flat", gain=1.0)
    assert nothing_left() and run(sandbox, "flat") and sandbox.guest is not guest
    sandbox._close_guests()


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("exit_softly", "its process ended without a response, by exit status 0"),
        pytest.param(
            "exit_hard", "its process ended without a response, by ", marks=pytest.mark.slow
        ),
        ("crash", "by SIGSEGV; its last output: "),
        pytest.param("grasp", "estimating test drive 1 of 1, seed 1: ", marks=pytest.mark.slow),
        pytest.param("hoard", "memory limit", marks=pytest.mark.processes),
        ("hoard_in_children", "using more than 0.5 GiB, the memory limit"),
        pytest.param("multiply", "more than 40 processes", marks=pytest.mark.processes),
        pytest.param(
            "patch_evaluation", "heights z: every value must be finite", marks=pytest.mark.processes
        ),
        pytest.param("fill", "", marks=pytest.mark.processes),
    ],
)
def test_every_failure_is_one_sentence_and_leaves_no_process(sandbox, how, message):
    with pytest.raises(EntryError) as error:
        run(sandbox, how=how)
    text = str(error.value)
    assert message in text or (how in ("hoard", "grasp") and "MemoryError" in text), text
    assert how != "fill" or "File too large" in text or "No space left" in text
    assert "\n" not in text and len(text) < 500
    assert nothing_left()


@pytest.mark.parametrize("how", [pytest.param("hang", marks=pytest.mark.processes), "spin"])
def test_an_entry_that_does_not_return_is_stopped_at_the_time_limit(sandbox, how):
    limit(sandbox, seconds=0.5)
    with pytest.raises(EntryError, match=r"stopped after 0\.5 s, the time limit"):
        run(sandbox, how=how)
    assert nothing_left()


def test_child_processes_do_not_outlive_their_entry(sandbox):
    assert len(run(sandbox, how="leave_children")) == 1
    assert nothing_left()


@pytest.mark.processes
def test_100_megabytes_of_output_are_counted_and_discarded(sandbox):
    with pytest.raises(EntryError, match=r"by SIGKILL; its last output: that was 100 MB"):
        run(sandbox, how="print")
    assert sandbox.guest.output_size == 100_000_000 + len("that was 100 MB\n")
    assert len(sandbox.guest.output_tail) <= 4000


@pytest.mark.parametrize(
    "how", ["kill_parent", pytest.param("stop_parent", marks=pytest.mark.processes)]
)
def test_an_entry_that_attacks_the_guests_first_process_harms_only_itself(sandbox, how):
    limit(sandbox, seconds=20.0 if sandbox.isolation == "bubblewrap" else 3.0)
    with pytest.raises(EntryError) as error:
        run(sandbox, how=how)
    expected = "stopped after 3 s" if how == "stop_parent" else "by SIGKILL"
    if sandbox.isolation == "bubblewrap":
        expected = "Operation not permitted" if bubblewrap.is_root() else ""
    assert expected in str(error.value) and nothing_left()


def test_the_processor_time_of_all_threads_counts(sandbox):
    only_once(sandbox)
    (training_run,) = run(sandbox, how="work_in_secret")
    assert 0.3 < training_run.estimate_seconds < 3.0


def test_environment_variables_are_not_passed_to_an_entry(sandbox, monkeypatch):
    only_once(sandbox)
    monkeypatch.setenv("ROADRECON_SECRET", "a token")
    with pytest.raises(EntryError) as error:
        run(sandbox, how="ask_for_secrets")
    assert "it has None at " in str(error.value) and str(Path.home()) not in str(error.value)


def test_a_guest_sees_neither_roads_nor_seeds_nor_results(sandbox, tmp_path):
    if sandbox.isolation != "bubblewrap":
        pytest.skip("a process sees what its user sees")
    (tmp_path / "row.json").write_text("{}")
    with pytest.raises(EntryError) as error:
        run(sandbox, how="look_for_truth", where=str(tmp_path))
    found, _, rest = str(error.value).partition(", root ")
    assert found.endswith("found []")
    held = ["a", "damper_high", "length", "low_pass", "s", "sensors", "spring_stiff", "t", "v"]
    assert f"record {held}, words []" in rest or len(rest) > 250
    needed = {Path(place).parts[1] for place in (ROOT, sys.prefix, sys.base_prefix)}
    hidden = {"work", "home", "run"} - needed  # wherever the checkout and Python stand
    assert not [name for name in hidden if f"'{name}'" in rest]


def test_an_entry_has_no_network_in_bubblewrap(sandbox):
    received = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.5 if sandbox.isolation == "bubblewrap" else 60.0)

        def listen():
            try:
                line, _ = server.accept()
                received.append(line.recv(100))
                line.close()
            except TimeoutError:
                pass

        thread = threading.Thread(target=listen)
        thread.start()
        call = partial(run, sandbox, how="connect", where=str(server.getsockname()[1]))
        if sandbox.isolation == "bubblewrap":
            with pytest.raises(EntryError, match=r"unreachable|refused|family not supported"):
                call()
        else:
            call()
        thread.join()
    assert received == ([] if sandbox.isolation == "bubblewrap" else [b"the record is mine"])


def test_in_bubblewrap_nothing_outside_can_be_written(sandbox, tmp_path):
    if sandbox.isolation != "bubblewrap":
        pytest.skip("an entry may write where its user may")
    places = (tmp_path, Path(sys.prefix), "/", "/dev", "/etc", "/proc/sys/kernel")
    with pytest.raises(EntryError, match=REFUSED_PLACE) as error:
        run(sandbox, how="write_elsewhere", where=os.pathsep.join(map(str, places)))
    found = str(error.value).rpartition("OSError: ")[2].split("; ")
    assert len(found) == len(places) and all(re.fullmatch(REFUSED_PLACE, one) for one in found)
    assert not list(tmp_path.iterdir())


def test_an_entry_cannot_change_the_compiled_kernels_of_others(sandbox):
    if sandbox.isolation != "bubblewrap":
        pytest.skip("an entry may write where its user may")
    run(sandbox, how="poison_kernels")
    assert not poisoned_kernels()


@pytest.mark.processes
def test_user_namespaces_serve_hosts_that_are_not_root(sandbox, monkeypatch):
    if sandbox.isolation != "bubblewrap" or os.geteuid() != 0:
        pytest.skip("the other way to start bubblewrap")
    monkeypatch.setattr(bubblewrap, "is_root", lambda: False)
    assert len(run(sandbox, how="nothing")) == 1
    with pytest.raises(EntryError, match=REFUSED_PLACE):
        run(sandbox, how="write_elsewhere", where="/proc/sys/kernel")


@pytest.mark.costly
def test_without_bubblewrap_only_the_estimators_of_this_package_run(monkeypatch):
    monkeypatch.setattr(bubblewrap, "obstacle", lambda: "bubblewrap is not installed")
    with SandboxClient(dataclasses.replace(LIMITS, isolation="auto")) as sandbox:
        assert sandbox.isolation == "process" and len(run(sandbox, "flat")) == 1
        with pytest.raises(EntryError, match=r"^not run: bubblewrap is not installed; .*: --iso"):
            run(sandbox, how="nothing")
    with pytest.raises(ConfigError, match=r"not installed; install it, or choose the isolation"):
        SandboxClient(dataclasses.replace(LIMITS, isolation="bubblewrap"))


@pytest.mark.costly
def test_a_guest_starts_its_children_from_one_thread(sandbox):
    run(sandbox, "flat")
    (worker,) = [p for p in marked_processes() if count_threads(p) and is_worker(p)][:1]
    assert count_threads(worker) == 1
    sandbox._close_guests()


def count_threads(pid):
    return len(os.listdir(f"/proc/{pid}/task"))


def is_worker(pid):
    return Path(f"/proc/{pid}/cmdline").read_bytes().startswith(sys.executable.encode())


def test_a_wait_for_a_guest_of_another_run_is_told(tmp_path, monkeypatch, capsys):
    (tmp_path / "bwrap").touch()
    monkeypatch.setattr(bubblewrap.shutil, "which", lambda name: str(tmp_path / name))
    with bubblewrap.alone():
        pass
    assert not capsys.readouterr().err
    other = open(tmp_path / "bwrap")  # closed by the timer, with its lock
    fcntl.flock(other, fcntl.LOCK_EX)
    threading.Timer(1.3, other.close).start()
    with bubblewrap.alone():
        assert capsys.readouterr().err.startswith("waiting for the guest of another run")
