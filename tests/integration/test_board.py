"""Runs of a board: resuming, damaged files, interruptions, parallel runs, and job files."""

import contextlib
import dataclasses
import json
import os
import random
import shutil
import signal
import subprocess
import time

import pytest
from board_runs import (
    ESTIMATORS,
    Counting,
    make_request,
    quick_scores,
    rows,
    run,
    small,
)
from fake_estimators import Broken, Reader
from fakes import fake_drives
from in_process import InProcessExecutor

from leaderboard.entries.entry import BUILTIN, Entry
from leaderboard.evaluation import evaluate, provenance, store
from leaderboard.evaluation.results import RESULT, content_digest
from leaderboard.evaluation.store import part_path, row_path
from leaderboard.running import board as board_module
from leaderboard.running import jobs
from leaderboard.running.board import RunRequest, load_board, run_board, write_jobs
from leaderboard.sandbox.limits import Limits
from road_envs.core.artifacts import _text_checksum
from road_envs.core.code_digest import closure
from road_envs.core.config import ConfigError

FEW_BASELINES = "flat", "truth_plus_noise"
NAMES = {*ESTIMATORS, *FEW_BASELINES}
PARTS = 2 * len(NAMES)


@pytest.fixture(scope="module", autouse=True)
def _quickly():
    """Replace the scores by cheap ones, and leave out baselines that are made as others are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(board_module, "BASELINES", FEW_BASELINES)
        patch.setattr(evaluate, "compute_scores", quick_scores)
        yield


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """Rows of an undisturbed run."""
    board, ran = run(tmp_path_factory.mktemp("undisturbed"))
    assert len(ran) == PARTS and {name for _, name in rows(board)} == NAMES
    return rows(board)


# resuming


@pytest.mark.costly
def test_valid_stored_results_are_not_run_again(tmp_path, expected):
    assert len(run(tmp_path)[1]) == PARTS
    board, ran = run(tmp_path)
    assert ran == [] and rows(board) == expected
    assert len(run(tmp_path, resume=False)[1]) == PARTS


@pytest.mark.parametrize(
    ("change", "count"),
    [
        ({"estimators": {**ESTIMATORS, "reader": Reader(gain=0.5)}}, 2),
        ({"seeds": (1, 2, 3)}, PARTS),
        ({"t": small(version=2)}, PARTS),
        ({"roads": 2}, PARTS),
        ({"estimators": {**ESTIMATORS, "third": Reader(gain=0.1)}}, 2),
    ],
)
@pytest.mark.costly
def test_a_change_reruns_only_the_results_that_depend_on_it(tmp_path, change, count):
    run(tmp_path)
    assert len(run(tmp_path, **change)[1]) == count
    assert run(tmp_path, **change)[1] == []
    assert run(tmp_path)[1] == []  # the earlier results are still stored


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("package_version", lambda: "another"),
        ("evaluation_version", lambda: "another"),
        ("RESULT", dataclasses.replace(RESULT, modules=("road_envs.core.config",))),
    ],
)
@pytest.mark.costly
def test_another_package_or_evaluation_version_reruns_everything(
    tmp_path, monkeypatch, name, other
):
    run(tmp_path)
    monkeypatch.setattr(jobs, name, other)
    assert len(run(tmp_path)[1]) == PARTS


def test_changed_code_of_an_estimator_reruns_only_that_estimator(tmp_path, monkeypatch):
    run(tmp_path)
    request = make_request()
    reader, learner = request.entries
    edited = (dataclasses.replace(reader, code="new"), learner)
    executor = Counting()
    request = dataclasses.replace(request, entries=edited, replace=("reader",))
    run_board(request, tmp_path, executor)
    assert {entry for entry, _ in executor.ran} == {"reader"}


def test_failures_are_run_again_and_end_the_other_conditions_of_the_entry(tmp_path):
    estimators = {**ESTIMATORS, "broken": Broken(how="raises")}
    board, ran = run(tmp_path, estimators)
    assert [name for name, _ in ran].count("broken") == 1
    (failed,) = board.failed(board.tasks[0])
    assert failed.failure.startswith("ride, 14.5 km/h, estimating test drive 1 of 3")
    assert run(tmp_path, estimators)[1] == [("broken", small().conditions[0].label)]


@pytest.mark.costly
def test_a_row_made_with_wider_limits_is_run_again_by_a_narrower_run_of_its_entry_alone(tmp_path):
    """A row of another entry stays valid: nothing has shown that it needs more."""
    own, wide = Limits(seconds=4.0, memory=2.0), Limits(seconds=60.0)
    assert len(run(tmp_path, limits=wide)[1]) == PARTS
    row = store.load(row_path(tmp_path, "small", "reader"))
    assert row.limits == (60.0, wide.memory)
    only = {"reader": ESTIMATORS["reader"]}
    board, ran = run(tmp_path, only, limits=own)
    assert len(ran) == PARTS - 2  # not the learner, which is none of this run
    for seen in (board, load_board([small()], tmp_path)):
        assert not seen.stale(small()) and len(seen.scored(small())) == len(NAMES)
    assert store.load(row_path(tmp_path, "small", "learner")).limits == (60.0, 4.0)
    narrow = store.load(row_path(tmp_path, "small", "reader"))
    assert narrow.limits == (4.0, 2.0) and content_digest(narrow) == content_digest(row)
    for limits in (own, wide):
        assert run(tmp_path, only, limits=limits)[1] == []
    for planned in make_request(only).rows():  # as before rows named their limits
        old = dataclasses.replace(
            store.load_part(part_path(tmp_path, planned.parts[0])), limits=(0, 0)
        )
        store.save_part(store.to_text(old), tmp_path, old.identity)
    shutil.rmtree(tmp_path / "results")
    board, ran = run(tmp_path, only, limits=own)
    assert ran == [] and not board.stale(small())
    assert store.load(row_path(tmp_path, "small", "reader")).limits == (4.0, 2.0)  # the widest
    assert run(tmp_path, only, limits=Limits(seconds=4.0, memory=1.0))[1]


@pytest.mark.parametrize("narrow", [Limits(seconds=4.0), Limits(memory=1.0)])
def test_what_failed_within_narrow_limits_is_stale_for_those_who_have_wider_ones(tmp_path, narrow):
    estimators = {**ESTIMATORS, "broken": Broken(how="raises")}
    board, _ = run(tmp_path, estimators, limits=narrow)
    assert [row.estimator for row in board.failed(small())] == ["broken"]
    read = load_board([small()], tmp_path)
    ((stale, reason),) = read.stale(small())
    told = f"failed within narrower limits: {narrow.seconds:g} s, {narrow.memory:g} GiB"
    assert (stale.estimator, reason, read.failed(small())) == ("broken", told, [])
    for limits in (Limits(), Limits(seconds=1e4)):
        board, _ = run(tmp_path, estimators, limits=limits)
        (failed,) = load_board([small()], tmp_path).failed(small())
        assert failed.estimator == "broken" and not board.stale(small())


def test_stored_rows_of_other_entries_stay_on_the_board(tmp_path):
    run(tmp_path)
    board, _ = run(tmp_path, {"third": Reader(gain=0.2)})
    assert {r.estimator for r in board.scored(small())} == {*NAMES, "third"}


# damage


def test_a_missing_or_damaged_row_is_assembled_again_from_its_parts(tmp_path, expected):
    run(tmp_path)
    row_path(tmp_path, "small", "reader").unlink()
    row_path(tmp_path, "small", "learner").write_text("{")
    text = row_path(tmp_path, "small", "flat").read_text()
    row_path(tmp_path, "small", "flat").write_text(text.replace('"nrmse": [1.0', '"nrmse": [0.0'))
    board, ran = run(tmp_path)
    assert ran == [] and rows(board) == expected


def test_an_entry_by_others_is_run_again_when_the_package_that_it_builds_on_changes(monkeypatch):
    (entry, _), references = make_request().entries, ("wiener", BUILTIN, "a:B")
    entries = [dataclasses.replace(entry, reference=x) for x in references]
    before = [jobs.result_identity(small(), 1, entry, (1,)) for entry in entries]
    monkeypatch.setattr(jobs, "package_code", lambda: "of today")
    after = [jobs.result_identity(small(), 1, entry, (1,)) for entry in entries]
    assert after[:2] == before[:2] and after[2] != before[2]


def test_the_package_that_others_build_on_has_weights_and_vehicles(monkeypatch):
    kept = {}

    def digest_of(paths, root=None):
        kept.update((path.name, path) for path in paths)
        return ""

    monkeypatch.setattr(provenance, "digest", digest_of)
    provenance.package_code.__wrapped__()
    assert {"fir_ridge.safetensors", "land_rover_defender_110.yaml", "provenance.py"} <= {*kept}
    shown = kept["new_road.yaml"].parent.name  # a board changes no result
    assert shown == "tasks" and "measured.yaml" not in kept


def test_a_row_is_of_the_code_that_looks_for_foul_play_too():
    judge = {path.name for path in closure(*RESULT.modules)}
    assert {"retest.py", "seccomp.py", "evaluate.py"} <= judge


@pytest.mark.parametrize("damage", [lambda text: text[:500], lambda text: "", lambda text: "[]"])
@pytest.mark.costly
def test_only_a_damaged_part_is_run_again(tmp_path, expected, damage):
    run(tmp_path)
    t = small()
    (reader, _) = make_request().entries
    part = part_path(tmp_path, jobs.result_identity(t, 1, reader, (1, 2)))
    part.write_text(damage(part.read_text()))
    row_path(tmp_path, "small", "reader").unlink()
    board, ran = run(tmp_path)
    assert ran == [("reader", t.conditions[1].label)] and rows(board) == expected


def test_a_row_of_a_newer_version_is_never_overwritten(tmp_path):
    run(tmp_path)
    path = row_path(tmp_path, "small", "reader")
    newer = path.read_text().replace('"format": 6', '"format": 7')
    path.write_text(newer)
    executor = Counting()
    with pytest.raises(ConfigError, match=r"reader\.json: written in format 7 by a newer version"):
        run_board(make_request(), tmp_path, executor)
    assert executor.ran == [] and path.read_text() == newer
    board = load_board([small()], tmp_path)
    (failed,) = board.failed(small())
    assert "by a newer version" in failed.failure and len(board.scored(small())) == len(NAMES) - 1


def test_file_times_have_no_effect(tmp_path, expected):
    run(tmp_path)
    for k, path in enumerate(sorted(tmp_path.rglob("*.json"))):
        then = (-1e9, 0.0, 4e9)[k % 3]
        os.utime(path, (then, then))
    board, ran = run(tmp_path)
    assert ran == [] and rows(board) == expected


# interruptions


def stored(out):
    """Files of parts and rows; those of the tasks are written first."""
    return sorted(path for path in out.rglob("*.json") if path.parent.name != "definitions")


@contextlib.contextmanager
def forked(work):
    """Run `work` in a forked process, which starts faster than a new interpreter."""
    pid = os.fork()
    if pid == 0:
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    ended = []
    try:
        yield pid, ended
    finally:
        if not ended:
            os.waitpid(pid, 0)


@pytest.mark.costly
@pytest.mark.parametrize(
    "wanted",
    [5, pytest.param(30, marks=pytest.mark.slow)],
)
def test_a_run_killed_at_any_time_and_resumed_gives_the_same_board(tmp_path, expected, wanted):
    begin = time.monotonic()
    run(tmp_path / "first")
    span = time.monotonic() - begin
    rng, kills, finished = random.Random(3), 0, 0
    while kills < wanted:
        out = tmp_path / str(finished)
        with forked(lambda out=out: run(out)) as (pid, ended):
            time.sleep(rng.uniform(0.0, 1.2 * span))
            os.kill(pid, signal.SIGKILL)
            ended.append(os.waitpid(pid, 0))
        kills += ended[0][1] == signal.SIGKILL
        if rng.random() < 0.2:
            finished += 1
            for partial in out.rglob("*.partial"):
                os.utime(partial, (0.0, 0.0))  # a day later
            board, _ = run(out)
            assert rows(board) == expected
            assert not list(out.rglob("*.partial"))
    assert finished > wanted // 10


@pytest.mark.costly
def test_a_run_resumed_after_an_exception_at_any_write_gives_the_same_board(
    tmp_path, monkeypatch, expected
):
    write, count = store.write_text, 0
    for stop in range(0, PARTS + len(NAMES), 3):
        count = 0

        def failing(*words, stop=stop, **options):
            nonlocal count
            if count == stop:
                raise OSError(28, "No space left on device")
            count += 1
            write(*words, **options)

        monkeypatch.setattr(store, "write_text", failing)
        out = tmp_path / str(stop)
        with pytest.raises(OSError, match="No space left on device"):
            run(out)
        monkeypatch.setattr(store, "write_text", write)
        before = len(stored(out))
        board, ran = run(out)
        assert before == stop and len(ran) == PARTS - min(stop, PARTS) and rows(board) == expected


def test_a_full_disk_is_reported_and_no_valid_row_is_lost(tmp_path, expected):
    disk = tmp_path / "disk"
    disk.mkdir()
    size = ["mount", "-t", "tmpfs", "-o", "size=40k,mode=700", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(size, capture_output=True).returncode:
        pytest.skip("no small disk can be mounted here")
    try:
        with pytest.raises(OSError, match="No space left on device"):
            run(disk)
        kept = stored(disk)
        assert kept and not list(disk.rglob("*.partial"))
        texts = [path.read_text() for path in kept]
        for path in kept:
            (store.load if path.parent.name == "small" else store.load_part)(path)
        subprocess.run(["mount", "-o", "remount,size=10m", str(disk)], check=True)
        board, ran = run(disk)
        assert rows(board) == expected and len(ran) < PARTS
        assert [path.read_text() for path in kept] == texts
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.costly
def test_parallel_runs_in_one_folder_give_the_same_board(tmp_path, expected):
    with forked(lambda: run(tmp_path)), forked(lambda: run(tmp_path, resume=False)):
        board, _ = run(tmp_path)
        assert rows(board) == expected
    assert rows(load_board([small()], tmp_path)) == expected


class Meddler(Counting):
    """Alters a result file with a valid checksum after a run, up to `times` times."""

    def __init__(self, target, times):
        super().__init__()
        self.target, self.times = target, times

    def run(self, jobs_, out):
        yield from super().run(jobs_, out)
        if self.times:
            self.times -= 1
            path = self.target(out)
            text = path.read_text().replace('"value": [', '"value": [-')
            path.write_text(text.replace(json.loads(text)["sha256"], _text_checksum(text)))


def part(out):
    return part_path(out, jobs.result_identity(small(), 0, make_request().entries[0], (1, 2)))


def row(out):
    return row_path(out, "small", "flat")


@pytest.mark.parametrize("target", [part, row])
@pytest.mark.costly
def test_files_altered_during_a_run_are_detected_and_made_again(tmp_path, expected, target):
    if target is row:
        run(tmp_path)
        executor = Meddler(target, 1)
        estimators = {**ESTIMATORS, "third": Reader(gain=0.3)}
        executor._estimators = estimators
        result = rows(run_board(make_request(estimators), tmp_path, executor))
        assert {k: v for k, v in result.items() if k[1] != "third"} == expected
    else:
        executor = Meddler(target, 1)
        assert rows(run_board(make_request(), tmp_path, executor)) == expected
        assert len(executor.ran) == PARTS + 1
    assert executor.times == 0


def test_files_altered_in_every_attempt_raise_an_error_that_says_so(tmp_path):
    with pytest.raises(
        ConfigError, match="another process changed the files of this run in 3 attempts"
    ):
        run_board(make_request(), tmp_path, Meddler(part, 99))
    assert not row_path(tmp_path, "small", "reader").exists()
    assert board_module.ATTEMPTS < 99


def disturb(monkeypatch, out, step, times):
    """Let a run with other seeds into the same folder end before each of the first calls of a step
    of `run_board`.
    """
    monkeypatch.setattr(board_module, "probe_entries", lambda *arguments: 0)
    original, left = getattr(board_module, step), [None] * times

    def disturbed(*arguments):
        if left:
            left.pop()
            with monkeypatch.context() as patch:
                patch.setattr(board_module, step, original)
                run(out, seeds=(3,))
        return original(*arguments)

    monkeypatch.setattr(board_module, step, disturbed)


@pytest.mark.parametrize("step", ["probe_entries", "load_board"])
def test_a_run_returns_its_own_rows_whatever_another_has_stored(
    tmp_path, expected, step, monkeypatch
):
    disturb(monkeypatch, tmp_path, step, 1)
    assert rows(run(tmp_path, probes=True)[0]) == expected


@pytest.mark.costly
def test_a_run_whose_rows_another_always_replaces_returns_none(tmp_path, monkeypatch):
    disturb(monkeypatch, tmp_path, "load_board", 99)
    with pytest.raises(ConfigError, match="changed the files of this run in 3 attempts"):
        run(tmp_path)


def test_planned_jobs_give_the_results_of_a_run(tmp_path, expected):
    assert write_jobs(make_request(), tmp_path / "out", tmp_path / "jobs") == PARTS
    files = sorted((tmp_path / "jobs").glob("*.json"))
    assert len(files) == PARTS
    for path in reversed(files):  # in any order
        job = jobs.from_text(path.read_text(), str(path))
        list(InProcessExecutor(fake_drives, ESTIMATORS).run([job], tmp_path / "out"))
    board, ran = run(tmp_path / "out")
    assert ran == [] and rows(board) == expected
    assert write_jobs(make_request(), tmp_path / "out", tmp_path / "more") == 0


def outside(name, code):
    return Entry(name=name, reference=f"/elsewhere/{name}.whl", causal=False, code=code)


def run_entry(out, entry, **options):
    request = RunRequest([small()], [entry], (1,), **options)
    return run_board(request, out, Counting({entry.name: Reader(gain=0.7)}))


def test_the_row_of_another_wheel_is_replaced_only_on_request(tmp_path):
    run_entry(tmp_path, outside("rival", "0" * 16))
    path = store.row_path(tmp_path, small().name, "rival")
    before = path.read_bytes()
    with pytest.raises(ConfigError, match=r"rows of rival .* other code; .* --replace rival"):
        run_entry(tmp_path, outside("rival", "1" * 16))
    for alike in ("RIVAL", "r1vaI"):
        with pytest.raises(ConfigError, match=f"{alike} looks the same; rename the entry"):
            run_entry(tmp_path, outside(alike, "1" * 16), replace=(alike,))
    assert path.read_bytes() == before
    run_entry(tmp_path, outside("rival", "0" * 16))  # its own row
    run_entry(tmp_path, outside("rival", "1" * 16), replace=("rival",))
    assert store.load(path).code == "1" * 16


def test_the_row_of_another_wheel_that_is_written_during_a_run_is_not_replaced(tmp_path):
    slow, fast = outside("rival", "0" * 16), outside("rival", "1" * 16)

    class Slow(Counting):
        def run(self, jobs_, out):
            yield from super().run(jobs_, out)
            run_entry(tmp_path, fast)

    request = RunRequest([small()], [slow], (1,))
    with pytest.raises(ConfigError, match=r"rows of rival .* other code"):
        run_board(request, tmp_path, Slow({"rival": Reader(gain=0.7)}))
    assert store.load(store.row_path(tmp_path, small().name, "rival")).code == "1" * 16


def test_an_entry_that_imports_another_version_is_run_again_and_says_so(tmp_path):
    old = dataclasses.replace(outside("rival", "0" * 16), imports=("numpy 1.0", "zz_helper 1.0"))
    new = dataclasses.replace(old, imports=("numpy 1.0", "zz_helper 1.1"))
    path = store.row_path(tmp_path, small().name, "rival")
    for entry in (old, new):  # of the same code, so nothing has to be replaced
        run_entry(tmp_path, entry)
        assert store.load(path).environment["imports"] == ", ".join(entry.imports)


def test_an_entry_that_cannot_be_described_replaces_no_row_of_another(tmp_path):
    run_entry(tmp_path, outside("rival", "0" * 16))
    path = store.row_path(tmp_path, small().name, "rival")
    before = path.read_bytes()
    broken = Entry(name="rival", reference="/other/rival.whl", failure="cannot be constructed")
    with pytest.raises(ConfigError, match=r"rows of rival .* other code; .* --replace rival"):
        run_entry(tmp_path, broken)
    assert path.read_bytes() == before
    run_entry(tmp_path, broken, replace=("rival",))
    assert store.load(path).failure == "cannot be constructed"


@pytest.mark.parametrize("name", ["victim", "../../../elsewhere"])
@pytest.mark.costly
def test_a_part_of_another_entry_is_not_assembled(tmp_path, name, expected):
    run(tmp_path)
    shutil.rmtree(tmp_path / "results")
    (row,) = [row for row in make_request().rows() if row.entry.name == "reader"]
    path = part_path(tmp_path, row.parts[0])
    other = dataclasses.replace(store.load_part(path), estimator=name)
    store.save_part(store.to_text(other), tmp_path, row.parts[0])
    board, ran = run(tmp_path)
    assert [entry for entry, _ in ran] == ["reader"] and rows(board) == expected


def test_a_stored_row_by_others_is_stale_once_what_they_build_on_has_changed(tmp_path):
    run(tmp_path)
    row = store.load(store.row_path(tmp_path, small().name, "reader"))
    elsewhere = dataclasses.replace(row, environment=row.environment | {"code": "other weights"})
    store.save(elsewhere, tmp_path)
    ((stale, reason),) = load_board([small()], tmp_path).stale(small())
    assert stale.estimator == "reader"
    assert reason == "made with other code or weights of this package"
    ours = dataclasses.replace(elsewhere, estimator="wiener")
    assert ours.stale_reason(small()) is None


def test_a_stored_row_of_other_drives_is_stale(tmp_path):
    run(tmp_path)
    row = store.load(store.row_path(tmp_path, small().name, "reader"))
    for scores in (row.scores[row.scores["road_seed"] > 12], row.scores[:0]):
        store.save(dataclasses.replace(row, scores=scores), tmp_path)
        board = load_board([small()], tmp_path)
        ((stale, reason),) = board.stale(small())
        assert stale.estimator == "reader" and "not those of its task" in reason


@pytest.mark.parametrize("change", ["uneven", "NaN", "1e999"])
@pytest.mark.costly
def test_a_row_of_uneven_length_or_of_no_numbers_is_a_failed_row_whatever_its_checksum(
    tmp_path, change
):
    board, _ = run(tmp_path)
    path = store.row_path(tmp_path, small().name, "reader")
    stored = store.load(path)
    text = store.to_text(stored)
    first = json.dumps(stored.traces[0].estimate[0].tolist())
    other, reason = json.dumps(stored.traces[0].estimate[0][:-3].tolist()), "one number of heights"
    if change != "uneven":  # a drive without scores would count as not driven
        first, other = json.dumps(stored.scores["value"].iloc[0]), change
        reason = "scores: a value is not finite"
    assert first in text
    cut = text.replace(first, other, 1)
    path.write_text(cut.replace(json.loads(text)["sha256"], _text_checksum(cut)))
    again = load_board(board.tasks, tmp_path)
    (row,) = again.failed(small())
    assert row.estimator == "reader" and reason in row.failure
