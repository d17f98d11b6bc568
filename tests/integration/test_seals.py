"""What a guest must not do: leave data to the next one, use what no limit counts, lie about time.

Each attack has changed a board before; see `tests/support/hostile` for what they do.
"""

import hashlib
import os
import platform
import random
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from fakes import fake_drives, task
from wheels import module, write_wheel

from leaderboard.entries import entries, entry_files
from leaderboard.entries.entry import Entry, EntryError, reconstruct_all
from leaderboard.sandbox import bubblewrap, client, guest, processes, seccomp
from leaderboard.sandbox.bubblewrap import count_pipes, forget_pipes
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from leaderboard.sandbox.retest import LOOKS_AHEAD, NOT_CAUSAL, NOT_RETESTED, REMEMBERS
from road_envs.core.config import ConfigError
from road_envs.records.record import Profile, profile_stations

pytestmark = [
    pytest.mark.skipif(bubblewrap.obstacle() is not None, reason=str(bubblewrap.obstacle())),
    pytest.mark.skipif(platform.machine() != "x86_64", reason="numbers of x86_64"),
]

LIMITS = Limits(seconds=30.0, memory=0.5, processes=40, file=0.05, isolation="bubblewrap")


def drives(number=2):
    t = task(test={"roads": ["iso_d"], "seeds": [*range(11, 11 + number)], "length": 40.0})
    return [d.record for d in fake_drives(t, t.test, t.conditions[0])], t.vehicle


def run(sandbox, how, where="", causal=None, retest=False, number=2):
    entry = Entry(
        name="x", reference="hostile:Hostile", settings={"how": how, "where": where}, causal=causal
    )
    (found,) = sandbox.reconstruct(entry, [], *drives(number), (1,), retest=retest)
    return found


@pytest.fixture(scope="module")
def sandbox():
    with SandboxClient(LIMITS) as made:
        yield made


@pytest.fixture(params=["as it is", pytest.param("user namespace", marks=pytest.mark.processes)])
def identity(request, monkeypatch):
    """Guests as this user starts them, and as a user without rights does."""
    if request.param == "user namespace":
        monkeypatch.setattr(bubblewrap, "is_root", lambda: False)


def test_calls_by_which_data_and_memory_outlive_a_guest_are_refused(sandbox, identity):
    with pytest.raises(EntryError, match=r"RuntimeError: not refused: \[\]$"):
        run(sandbox, "call")


def test_a_guest_sees_no_results_beside_the_programs_that_it_needs(tmp_path, monkeypatch):
    for name in ("bin", "results"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr("sys.prefix", str(tmp_path))
    seen = bubblewrap._system_mounts()
    assert tmp_path / "bin" in seen
    for hidden in (tmp_path / "results", Path("/usr/src/app")):
        assert not any(hidden.is_relative_to(path) for path in seen)


def test_the_filter_refuses_the_same_calls_on_each_machine():
    programs = [seccomp.program(machine) for machine in seccomp.AUDIT_ARCH]
    assert len({len(program) for program in programs}) == 1 and len(set(programs)) == 2
    assert len(programs[0]) % 8 == 0 and seccomp.program("riscv64") is None
    for column in range(2):
        numbers = [(rule.numbers[column], rule.when) for rule in seccomp.RULES]
        assert len(set(numbers)) == len(numbers)


@pytest.mark.costly
def test_what_one_guest_has_seen_of_the_future_is_not_kept_for_the_next(sandbox, identity):
    found = run(sandbox, "keep_the_future", causal=True, retest=True)
    assert found.looks_ahead and found.notes[-1] == LOOKS_AHEAD


@pytest.mark.costly
def test_the_end_of_the_odometer_counts_as_a_later_sample(sandbox):
    found = run(sandbox, "end_the_odometer", causal=True, retest=True)
    assert found.looks_ahead and LOOKS_AHEAD in found.notes


@pytest.mark.parametrize("number", [1, 2])
def test_a_drive_is_asked_with_another_future_before_it_is_asked_as_it_is(sandbox, number):
    found = run(sandbox, "recall_the_future", causal=True, retest=True, number=number)
    assert found.looks_ahead and not set(NOT_CAUSAL).isdisjoint(found.notes)


@pytest.mark.parametrize("number", [2, 3])
def test_each_of_two_or_three_drives_is_asked_with_another_future(sandbox, number):
    """Of so few, as boards have them by default, all but the first one were only repeated."""
    found = run(sandbox, "look_ahead_later", causal=True, retest=True, number=number)
    assert found.looks_ahead and LOOKS_AHEAD in found.notes


@pytest.mark.costly
def test_what_one_guest_has_seen_is_not_told_by_the_number_of_its_pipes(sandbox, monkeypatch):
    """Of 32 numbers one is the right one by chance; with other futures the answers are equal."""
    monkeypatch.setattr(bubblewrap, "forget_pipes", forget_pipes)
    for _ in range(3):
        forget_pipes(count_pipes())  # those of the guests before
        secret = random.Random(1)
        monkeypatch.setattr(client.random, "SystemRandom", lambda secret=secret: secret)
        found = run(sandbox, "count_the_future", causal=True, retest=True, number=1)
        if found.looks_ahead:
            return
    raise AssertionError(found.notes)


def test_no_program_of_the_machine_is_met_by_its_name(sandbox):
    name = f"road-recon-{os.getpid()}"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(f"\0{name}")
        server.listen()
        with pytest.raises(EntryError, match="Connection refused"):
            run(sandbox, "connect_to_a_name", where=name)


def test_no_time_of_a_file_tells_a_guest_how_long_its_run_has_lasted(sandbox):
    with pytest.raises(EntryError, match=r"RuntimeError: written at 0$"):
        run(sandbox, "tell_when_its_code_was_written")


@pytest.mark.costly
def test_no_guest_reads_the_files_of_code_that_another_has_read(sandbox):
    """Whether a page of a file is in memory can be timed: each guest has files of its own, in a
    folder whose name does not tell how many were before it.
    """
    called = set()
    for _ in range(2):
        with pytest.raises(EntryError, match=r"RuntimeError: called [0-9a-f]{16}\.code$") as error:
            run(sandbox, "tell_the_name_of_its_folder")
        called.add(str(error.value))
    assert len(called) == 2


@pytest.mark.costly
def test_entries_do_not_run_side_by_side(monkeypatch):
    """What one guest of an entry tells a guest of another lane, it could tell the second guest."""
    running, seen = [], []

    def count(*given):
        running.append(1)
        seen.append(len(running))
        time.sleep(0.5)
        found = list(reconstruct_all(*given))
        running.pop()
        return found

    def hold():
        with SandboxClient(LIMITS) as made:
            run(made, "nothing", retest=True)

    monkeypatch.setattr(client, "reconstruct_all", count)
    both = [threading.Thread(target=hold) for _ in range(2)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert seen == [1, 1, 1, 1]


@pytest.mark.costly
def test_the_threads_of_one_guest_leave_room_for_those_of_another():
    limits = Limits(seconds=30.0, processes=4, isolation="bubblewrap")
    most = 4 * limits.processes + 64
    failures = []

    def hold():
        try:
            with SandboxClient(limits) as made:
                run(made, "start_threads", where=str(most - 10))
        except EntryError as error:
            failures.append(str(error))

    both = [threading.Thread(target=hold) for _ in range(2)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert failures == []


def test_no_guest_has_more_threads_than_its_processes_may_have(sandbox):
    """Threads that are left to nobody else keep another guest, or the judge, from starting."""
    most = 4 * LIMITS.processes + 64
    with pytest.raises(EntryError, match="RuntimeError: can't start new thread"):
        run(sandbox, "start_threads", where=str(most + 10))


def test_page_tables_count_as_memory(sandbox):
    with pytest.raises(EntryError, match=r"more than 0\.5 GiB, the memory limit"):
        run(sandbox, "map_sparsely")


def test_memory_of_no_process_is_not_to_be_had(sandbox, identity):
    with pytest.raises(EntryError, match=r"Error: \[Errno (13|19|30)\]"):
        run(sandbox, "map_the_zero_device")


def test_files_without_content_count_as_memory(sandbox, identity, monkeypatch):
    monkeypatch.setattr(processes, "INODE", 2**20)
    with pytest.raises(EntryError, match=r"more than 0\.5 GiB, the memory limit"):
        run(sandbox, "make_empty_files")


@pytest.mark.parametrize("root", [True, False])
def test_no_process_of_a_guest_that_it_could_change_has_other_limits(sandbox, monkeypatch, root):
    monkeypatch.setattr(bubblewrap, "is_root", lambda: root and os.geteuid() == 0)
    with pytest.raises(EntryError, match=r"Error: ended first, limits \[.*\]$") as error:
        run(sandbox, "look_at_limits")
    limits = [int(x) for x in str(error.value).rpartition("[")[2].rstrip("]").split(", ") if x]
    assert all(0 < x <= 256 for x in limits[::2]) and all(0 < x < 2**31 for x in limits[1::2])
    assert len(limits) == (0 if bubblewrap.is_root() else 4)


def test_what_sockets_hold_is_little(sandbox):
    with pytest.raises(EntryError, match=r"RuntimeError: holds (\d+) MB$") as error:
        run(sandbox, "fill_sockets")
    assert int(str(error.value).split()[-2]) < 100


def test_no_guest_reads_counts_of_the_machine(sandbox, identity):
    with pytest.raises(EntryError, match=r"RuntimeError: reads \[\]$"):
        run(sandbox, "read_counters")


@pytest.mark.costly
def test_work_in_a_process_that_nobody_waits_for_takes_time(sandbox):
    assert run(sandbox, "work_unseen").estimate_seconds > 0.8


@pytest.mark.costly
def test_samples_of_the_last_tenth_are_tested_for_causality(sandbox, monkeypatch):
    secret = random.Random(1)  # a point at the very beginning of the tenth would not show it
    monkeypatch.setattr(client.random, "SystemRandom", lambda: secret)
    found = run(sandbox, "look_at_the_end", causal=True, retest=True)
    assert found.notes == (LOOKS_AHEAD,)


@pytest.mark.costly
@pytest.mark.parametrize("how", ["deviate_by_the_end", "hasten_by_the_end"])
def test_deviations_and_the_use_of_speed_are_tested_for_causality(sandbox, how):
    found = run(sandbox, how, causal=True, retest=True)
    assert found.notes == (LOOKS_AHEAD,) and found.looks_ahead


def test_deviations_are_tested_for_memory(sandbox):
    assert run(sandbox, "deviate_by_memory", retest=True).notes == (REMEMBERS,)


@pytest.mark.parametrize(
    ("cls", "settings", "notes"),
    [
        ("Learner", {"gains": (1.0, 1.0, 1.0), "deviations": (0.1, 0.2, 0.3)}, ()),
        ("Learner", {"gains": (1.0, 1.0, 0.9), "deviations": (0.1, 0.1, 0.1)}, ()),
        ("Learner", {"gains": (1.0,) * 3, "deviations": (0.1,) * 3}, (client.ONE_TRAINING,)),
        ("SinglePrecision", {}, ()),
        ("Refuser", {}, ()),
        ("Refuser", {"limit": 1.0}, (NOT_RETESTED,)),
    ],
)
@pytest.mark.parametrize("chance", range(3))
@pytest.mark.costly
def test_an_honest_causal_entry_does_not_look_ahead(
    sandbox, monkeypatch, cls, settings, notes, chance
):
    """Whichever of three training seeds the second guest has."""
    secret = random.Random(chance)
    secret.choice = lambda seeds: seeds[chance]
    monkeypatch.setattr(client.random, "SystemRandom", lambda: secret)
    entry = Entry(name="x", reference=f"honest:{cls}", settings=settings, causal=True)
    records, car = drives()
    training = [(records[0], Profile(s := profile_stations(40.0), np.zeros((2, s.size))))]
    found = sandbox.reconstruct(entry, training, records, car, (1, 2, 3), retest=True)
    assert len(found[0].notes) == len(notes)
    assert all(a.startswith(b) for a, b in zip(found[0].notes, notes, strict=True))
    assert found[0].looks_ahead == (NOT_RETESTED in notes)
    if found[0].looks_ahead:
        assert found[0].notes[0].endswith("ValueError: the speed jumps, rival cheats")
    assert len(found) == (3 if cls == "Learner" and not notes else 1)


@pytest.mark.costly
@pytest.mark.parametrize("place", [2, 3])
def test_memory_is_tested_on_any_drive_but_the_first(sandbox, place):
    found = run(sandbox, "remember_one", where=str(place), retest=True, number=3)
    assert found.notes == (REMEMBERS,)


@pytest.mark.costly
def test_the_second_guest_is_the_first_in_half_of_the_runs(sandbox, monkeypatch):
    asked = []

    def log(session, training, records, *rest):
        asked.append(len(records))
        return reconstruct_all(session, training, records, *rest)

    monkeypatch.setattr(client, "reconstruct_all", log)
    for coin in (0.2, 0.8):
        secret = random.Random(1)
        secret.random = lambda coin=coin: coin
        monkeypatch.setattr(client.random, "SystemRandom", lambda secret=secret: secret)
        assert run(sandbox, "nothing", retest=True, number=4).notes == ()
    assert asked == [2, 4, 4, 2]


def test_the_name_of_a_process_may_be_any_bytes(sandbox):
    assert run(sandbox, "rename").estimates


def ended_at_once(monkeypatch, times):
    """Let guests be killed as they start, so many times."""
    left = [times]

    def start(words, **options):
        process = popen(words, **options)
        if left[0] > 0:
            left[0] -= 1
            process.kill()
        return process

    popen = guest.subprocess.Popen
    monkeypatch.setattr(guest.subprocess, "Popen", start)


def test_a_guest_that_is_killed_as_it_starts_is_started_again(sandbox, monkeypatch):
    ended_at_once(monkeypatch, 1)
    assert run(sandbox, "nothing").estimates
    ended_at_once(monkeypatch, 2)
    with pytest.raises(EntryError, match=r"its guest ended as it started: .*SIGKILL"):
        run(sandbox, "nothing")


@pytest.mark.costly
def test_no_module_of_a_wheel_stands_before_those_of_the_judge(sandbox, tmp_path):
    code = "raise SystemExit('loaded')\n"
    names = ("numpy/__init__", "leaderboard/__init__", "sitecustomize", "usercustomize", "colorsys")
    files = [(f"{name}.py", code) for name in names]
    (entry,) = entries.resolve_entries(
        # the last one is loaded by nothing before the wheel
        [str(write_wheel(tmp_path, "shadow", module(head="import colorsys"), files=files))],
        sandbox.describe,
    )
    assert entry.failure is None
    assert sandbox.reconstruct(entry, [], *drives(1), (1,))[0].estimates


def test_a_module_that_is_installed_beside_the_judge_does_not_run_in_the_name_of_a_wheel(
    sandbox, tmp_path
):
    """Its digest would be that of other code."""
    wheel = write_wheel(tmp_path, "json", module(), "json = json:JSONDecoder")
    (entry,) = entries.resolve_entries([str(wheel)], sandbox.describe)
    assert "its module json is that of the judge's machine" in entry.failure


def test_an_entry_runs_whatever_the_umask(tmp_path):
    before = os.umask(0o077)
    try:
        with SandboxClient(LIMITS) as made:
            assert run(made, "nothing").estimates
    finally:
        os.umask(before)


def test_a_line_break_in_the_name_of_a_file_cannot_imitate_a_second_file(tmp_path):
    digest = hashlib.sha256(b"x = 1").hexdigest()
    for name, files in {
        "one": {f"a {digest}\nb": b"y = 2"},
        "two": {"a": b"x = 1", "b": b"y = 2"},
    }.items():
        (tmp_path / name).mkdir()
        for file, content in files.items():
            (tmp_path / name / file).write_bytes(content)
    assert entry_files.snapshot(str(tmp_path / "two"), None)
    with pytest.raises(EntryError, match="the name of a file must be printable"):
        entry_files.snapshot(str(tmp_path / "one"), None)


def test_a_wheel_by_a_link_is_a_wheel_whatever_the_name_of_its_file(tmp_path):
    """Stores of files (git-annex, Bazel) keep them by digest, and link to them by name."""
    (tmp_path / "store").mkdir()
    for name, target in (("mine-1.0.whl", "5d41402a"), ("mine.npz", "7d793037")):
        (tmp_path / "store" / target).touch()
        (tmp_path / name).symlink_to(tmp_path / "store" / target)
        assert entries.find_reference(str(tmp_path / name)) == str(tmp_path / name)
    (tmp_path / "store" / "rival-1.0.whl").touch()
    for link in ("latest", "latest.whl"):
        (tmp_path / link).symlink_to(tmp_path / "store" / "rival-1.0.whl")
        found = entries.find_reference(str(tmp_path / link))
        assert found == str((tmp_path / "store" / "rival-1.0.whl").resolve())


def test_what_has_no_end_is_no_entry(tmp_path):
    os.mkfifo(tmp_path / "pipe.whl")
    (tmp_path / "device.npz").symlink_to("/dev/zero")
    for path in tmp_path.iterdir():
        with pytest.raises(ConfigError, match="no such file"):
            entries.find_reference(str(path))
