"""A run leaves the same board whatever happens to it on the way."""

import contextlib
import dataclasses
import functools
import json
import os
import random
import shutil
import signal
import subprocess
import time

import pytest
from fakes import Broken, Learner, Reader, fake_drives, task

from leaderboard.evaluation import evaluate, store
from leaderboard.evaluation.entries import make_entry
from leaderboard.evaluation.results import content_digest
from leaderboard.evaluation.store import part_path, row_path
from leaderboard.evaluation.tasks import shipped_tasks
from leaderboard.metrics.baselines import BASELINES
from leaderboard.running import board as board_module
from leaderboard.running import jobs, plan
from leaderboard.running.board import RunRequest, load_board, run_board, write_jobs
from leaderboard.running.executors import InProcessExecutor
from road_envs.config import ConfigError, build

SHORT = {
    "training": {"roads": ["iso_d"], "seeds": [1], "length": 12.0},
    "test": {"roads": ["iso_d"], "seeds": [11, 12, 13], "length": 12.0},
}
"""Very short roads: what is tested here is not the scores."""

MADE = {"reader": Reader(), "learner": Learner()}
NAMES = {*MADE, *BASELINES}
PARTS = 2 * len(NAMES)


@functools.cache
def small(**changes):
    return task(**{**SHORT, **changes})


def wanted(made=MADE, t=None, **options):
    entries = [make_entry(name, estimator) for name, estimator in made.items()]
    return RunRequest([t or small()], entries, **{"seeds": (1, 2), **options})


class Counting(InProcessExecutor):
    """Runs here, and counts what it ran."""

    def __init__(self, made=MADE, drive=fake_drives):
        super().__init__(drive, made)
        self.ran = []

    def run(self, jobs_, out):
        for done in super().run(jobs_, out):
            self.ran.append((done.entry, done.condition))
            yield done


def run(out, made=MADE, **options):
    """The board, and what had to be run for it."""
    executor = Counting(made)
    found = run_board(wanted(made, **options), out, executor)
    return found, executor.ran


def rows(found):
    """All that must be the same from run to run: everything but times and where it was made."""
    return {
        (name, r.estimator): dataclasses.replace(
            r,
            train_seconds=(),
            estimate_ms_per_100m=None,
            environment={},
            drives=tuple(r.drives),
            traces=tuple(r.traces),
        )
        for name, results in found.results.items()
        for r in results
    }


def quick_scores(truth, estimate, v, *rest):
    error = estimate.z - truth.z
    return {"nrmse": float(error.std() / truth.z.std()), "r": float(v), "lag": float("nan")}


@pytest.fixture(scope="module", autouse=True)
def _quickly():
    """Scores that cost nothing: what is tested here is what becomes of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "scores", quick_scores)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The board of a run to which nothing happened."""
    found, ran = run(tmp_path_factory.mktemp("whole"))
    assert len(ran) == PARTS and {name for _, name in rows(found)} == NAMES
    return rows(found)


# what is kept, and what is run again


def test_what_is_stored_and_still_valid_is_not_run_again(tmp_path, whole):
    assert len(run(tmp_path)[1]) == PARTS
    found, ran = run(tmp_path)
    assert ran == [] and rows(found) == whole
    assert len(run(tmp_path, resume=False)[1]) == PARTS


@pytest.mark.parametrize(
    ("change", "count"),
    [
        ({"made": {**MADE, "reader": Reader(gain=0.5)}}, 2),
        ({"seeds": (1, 2, 3)}, PARTS),
        ({"t": small(version=2)}, PARTS),
        ({"roads": 2}, PARTS),
        ({"made": {**MADE, "third": Reader(gain=0.1)}}, 2),
    ],
)
def test_a_change_runs_again_what_depends_on_it_and_no_more(tmp_path, change, count):
    run(tmp_path)
    assert len(run(tmp_path, **change)[1]) == count
    assert run(tmp_path, **change)[1] == []
    assert run(tmp_path)[1] == []  # what was there before is there still


@pytest.mark.parametrize("name", ["package_version", "evaluation_version"])
def test_another_package_or_judge_runs_everything_again(tmp_path, monkeypatch, name):
    run(tmp_path)
    monkeypatch.setattr(jobs, name, lambda: "another")
    assert len(run(tmp_path)[1]) == PARTS


def test_code_of_an_estimator_that_has_changed_runs_it_again(tmp_path, monkeypatch):
    run(tmp_path)
    one = wanted()
    reader, learner = one.entries
    again = dataclasses.replace(one, entries=(dataclasses.replace(reader, code="new"), learner))
    executor = Counting()
    run_board(again, tmp_path, executor)
    assert {entry for entry, _ in executor.ran} == {"reader"}


def test_failures_are_tried_again_and_the_rest_of_the_entry_is_not_run(tmp_path):
    made = {**MADE, "broken": Broken(how="raises")}
    found, ran = run(tmp_path, made)
    assert [name for name, _ in ran].count("broken") == 1
    (failed,) = found.failed(found.tasks[0])
    assert failed.failure.startswith("ride, 14.5 km/h, estimating test drive 1 of 3")
    assert run(tmp_path, made)[1] == [("broken", small().conditions[0].label)]


def test_stored_rows_of_other_entries_stay_on_the_board(tmp_path):
    run(tmp_path)
    found, _ = run(tmp_path, {"third": Reader(gain=0.2)})
    assert {r.estimator for r in found.scored(small())} == {*NAMES, "third"}


# damage


def test_a_row_that_is_lost_or_damaged_is_put_together_again_from_its_parts(tmp_path, whole):
    run(tmp_path)
    row_path(tmp_path, "small", "reader").unlink()
    row_path(tmp_path, "small", "learner").write_text("{")
    text = row_path(tmp_path, "small", "flat").read_text()
    row_path(tmp_path, "small", "flat").write_text(text.replace('"nrmse": [1.0', '"nrmse": [0.0'))
    found, ran = run(tmp_path)
    assert ran == [] and rows(found) == whole


@pytest.mark.parametrize("damage", [lambda text: text[:500], lambda text: "", lambda text: "[]"])
def test_a_part_that_is_damaged_is_run_again_and_no_other(tmp_path, whole, damage):
    run(tmp_path)
    t = small()
    (reader, _) = wanted().entries
    part = part_path(tmp_path, jobs.identity(t, 1, reader, (1, 2)))
    part.write_text(damage(part.read_text()))
    row_path(tmp_path, "small", "reader").unlink()
    found, ran = run(tmp_path)
    assert ran == [("reader", t.conditions[1].label)] and rows(found) == whole


def test_a_row_of_a_newer_version_is_never_written_over(tmp_path):
    run(tmp_path)
    path = row_path(tmp_path, "small", "reader")
    newer = path.read_text().replace('"format": 3', '"format": 4')
    path.write_text(newer)
    executor = Counting()
    with pytest.raises(ConfigError, match=r"reader\.json: written in format 4 by a newer version"):
        run_board(wanted(), tmp_path, executor)
    assert executor.ran == [] and path.read_text() == newer
    found = load_board([small()], tmp_path)
    (failed,) = found.failed(small())
    assert "by a newer version" in failed.failure and len(found.scored(small())) == len(NAMES) - 1


def test_clocks_that_jump_change_nothing(tmp_path, whole):
    run(tmp_path)
    for k, path in enumerate(sorted(tmp_path.rglob("*.json"))):
        then = (-1e9, 0.0, 4e9)[k % 3]
        os.utime(path, (then, then))
    found, ran = run(tmp_path)
    assert ran == [] and rows(found) == whole


# interruptions


@contextlib.contextmanager
def forked(work):
    """A process of its own, without the time that an interpreter needs to start."""
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


def test_killed_at_any_moment_and_resumed_it_leaves_the_same_board(tmp_path, whole):
    begin = time.monotonic()
    run(tmp_path / "first")
    span = time.monotonic() - begin
    rng, kills, finished = random.Random(0), 0, 0
    while kills < 30:
        out = tmp_path / str(finished)
        with forked(lambda out=out: run(out)) as (pid, ended):
            time.sleep(rng.uniform(0.0, 1.2 * span))
            os.kill(pid, signal.SIGKILL)
            ended.append(os.waitpid(pid, 0))
        kills += ended[0][1] == signal.SIGKILL
        if rng.random() < 0.2:
            finished += 1
            found, _ = run(out)
            assert rows(found) == whole
            assert not list(out.rglob("*.partial"))
    assert finished > 3


def test_an_exception_at_any_write_leaves_the_same_board(tmp_path, monkeypatch, whole):
    write, count = store.write_text, 0
    for stop in range(0, PARTS + len(NAMES), 4):
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
        before = len(list(out.rglob("*.json")))
        found, ran = run(out)
        assert before == stop and len(ran) == PARTS - min(stop, PARTS) and rows(found) == whole


def test_a_disk_that_is_full_is_said_and_no_valid_row_is_lost(tmp_path, whole):
    disk = tmp_path / "disk"
    disk.mkdir()
    size = ["mount", "-t", "tmpfs", "-o", "size=60k,mode=700", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(size, capture_output=True).returncode:
        pytest.skip("no small disk can be mounted here")
    try:
        with pytest.raises(OSError, match="No space left on device"):
            run(disk)
        kept = sorted(disk.rglob("*.json"))
        assert kept and not list(disk.rglob("*.partial"))
        texts = [path.read_text() for path in kept]
        for path in kept:
            (store.load if path.parent.name == "small" else store.load_part)(path)
        subprocess.run(["mount", "-o", "remount,size=10m", str(disk)], check=True)
        found, ran = run(disk)
        assert rows(found) == whole and len(ran) < PARTS
        assert [path.read_text() for path in kept] == texts
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_runs_that_share_a_folder_do_each_other_no_harm(tmp_path, whole):
    with forked(lambda: run(tmp_path)), forked(lambda: run(tmp_path, resume=False)):
        found, _ = run(tmp_path)
        assert rows(found) == whole
    assert rows(load_board([small()], tmp_path)) == whole


class Meddler(Counting):
    """While it runs, somebody else changes results, checksum and all, up to `times` times."""

    def __init__(self, target, times):
        super().__init__()
        self.target, self.times = target, times

    def run(self, jobs_, out):
        yield from super().run(jobs_, out)
        if self.times:
            self.times -= 1
            path = self.target(out)
            text = path.read_text().replace('"nrmse": [', '"nrmse": [-')
            path.write_text(text.replace(json.loads(text)["sha256"], store.text_checksum(text)))


def part(out):
    return part_path(out, jobs.identity(small(), 0, wanted().entries[0], (1, 2)))


def row(out):
    return row_path(out, "small", "flat")


@pytest.mark.parametrize("target", [part, row])
def test_what_is_changed_while_entries_run_is_found_and_made_again(tmp_path, whole, target):
    if target is row:
        run(tmp_path)
        executor = Meddler(target, 1)
        made = {**MADE, "third": Reader(gain=0.3)}
        executor._estimators = made
        found = rows(run_board(wanted(made), tmp_path, executor))
        assert {k: v for k, v in found.items() if k[1] != "third"} == whole
    else:
        executor = Meddler(target, 1)
        assert rows(run_board(wanted(), tmp_path, executor)) == whole
        assert len(executor.ran) == PARTS + 1
    assert executor.times == 0


def test_somebody_who_does_not_stop_is_named_as_the_trouble(tmp_path):
    with pytest.raises(ConfigError, match="somebody else changes the files of this run"):
        run_board(wanted(), tmp_path, Meddler(part, 99))
    assert not row_path(tmp_path, "small", "reader").exists()
    assert board_module.ATTEMPTS < 99


# jobs


@pytest.mark.parametrize("t", [small(), *shipped_tasks()], ids=lambda t: t.name)
def test_a_job_comes_back_from_its_file_as_it_was(t):
    job = jobs.Job(task=t, condition=0, entries=wanted().entries, seeds=(1, 2))
    again = jobs.from_text(jobs.to_text(job), "a job")
    assert again.task == t and again.task.digest == t.digest
    assert (again.entries, again.seeds, again.limits) == (tuple(job.entries), (1, 2), job.limits)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda data: "{", "a job: damaged, not valid JSON"),
        (lambda data: [], "a job: not a job"),
        (lambda data: {**data, "colour": 1}, "colour: unknown key"),
        (lambda data: {**data, "condition": 7}, "small has no condition 7"),
        (lambda data: {**data, "judge": "0"}, "planned by other code than this"),
        (lambda data: {**data, "task_digest": "0"}, "small is another task here, or lacks"),
    ],
)
def test_a_job_that_cannot_be_run_says_why(change, said):
    job = jobs.Job(task=small(), condition=0, entries=wanted().entries, seeds=(1,))
    data = change(json.loads(jobs.to_text(job)))
    with pytest.raises(ConfigError, match=said):
        jobs.from_text(data if isinstance(data, str) else json.dumps(data), "a job")


def test_jobs_share_drives_unless_workers_would_be_idle(tmp_path):
    missing = plan.Plan(wanted().rows(), tmp_path, True).missing()
    assert len(missing) == PARTS
    limits = wanted().limits
    for workers, count in ((1, 2), (2, 2), (4, 4), (99, PARTS)):
        found = plan.make_jobs(missing, workers, limits)
        assert len(found) == count
        done = [(entry.name, job.condition) for job in found for entry in job.entries]
        assert sorted(done) == sorted((row.entry.name, k) for row, k in missing)


def test_planned_jobs_are_what_a_run_would_do(tmp_path, whole):
    assert write_jobs(wanted(), tmp_path / "out", tmp_path / "jobs") == PARTS
    files = sorted((tmp_path / "jobs").glob("*.json"))
    assert len(files) == PARTS
    for path in reversed(files):  # in any order
        job = jobs.from_text(path.read_text(), str(path))
        list(InProcessExecutor(fake_drives, MADE).run([job], tmp_path / "out"))
    found, ran = run(tmp_path / "out")
    assert ran == [] and rows(found) == whole
    assert write_jobs(wanted(), tmp_path / "out", tmp_path / "more") == 0


def test_what_a_job_has_done_can_be_told_in_one_line(tmp_path):
    (job, *_) = plan.make_jobs(
        plan.Plan(wanted().rows(), tmp_path, True).missing(), 1, wanted().limits
    )
    for done in InProcessExecutor(fake_drives, MADE).run([job], tmp_path):
        assert build(jobs.JobDone, json.loads(json.dumps(dataclasses.asdict(done))), "done") == done
        assert (
            content_digest(store.load_part(part_path(tmp_path, done.identity)))
            == done.content_digest
        )
