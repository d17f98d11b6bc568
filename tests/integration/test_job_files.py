"""Files of jobs: what they carry, how they are split, and what is refused."""

import dataclasses
import json
import shutil
from functools import partial

import numpy as np
import pytest
import wheels
from board_runs import (
    ESTIMATORS,
    PARTS,
    make_request,
    small,
)
from fakes import fake_drives, task
from in_process import InProcessExecutor
from oracles_roads import erd_file

from leaderboard.entries import entry_files
from leaderboard.entries.entry import Entry
from leaderboard.evaluation import evaluate, store
from leaderboard.evaluation.results import content_digest
from leaderboard.evaluation.store import part_path
from leaderboard.evaluation.tasks import shipped_tasks
from leaderboard.metrics.baselines import BASELINES
from leaderboard.running import jobs, plan, verification
from leaderboard.running.board import RunRequest, write_jobs
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs.core.config import ConfigError, build
from road_envs.roads import load_road, with_length
from road_envs.roads.formats.write import write_csv
from road_envs.vehicle.parameters import load_vehicle, write_vehicle


@pytest.mark.parametrize("t", [small(), *shipped_tasks()], ids=lambda t: t.name)
def test_a_job_is_equal_after_writing_and_reading_its_file(t):
    job = jobs.Job(task=t, condition=0, entries=make_request().entries, seeds=(1, 2))
    again = jobs.from_text(jobs.to_text(job), "a job")
    assert again.task == t and again.task.digest == t.digest
    assert (again.entries, again.seeds, again.limits) == (tuple(job.entries), (1, 2), job.limits)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: "{", "a job: damaged, not valid JSON"),
        (lambda data: [], "a job: not a job"),
        (
            lambda data: json.dumps({**data, "files": "kept", "task": "deep"}).replace(
                '"deep"', "[" * 600 + "]" * 600
            ),
            "a job: damaged, not valid JSON: nested too deeply",
        ),
        (lambda data: {**data, "colour": 1}, "colour: unknown key"),
        (lambda data: {**data, "condition": 7}, "small has no condition 7"),
        (lambda data: {**data, "evaluation_code": "0"}, "planned by other code or weights"),
        (lambda data: {**data, "task_digest": "0"}, "the task small or one of its files differs"),
    ],
)
def test_an_invalid_job_file_is_rejected_with_the_reason(change, message):
    job = jobs.Job(task=small(), condition=0, entries=make_request().entries, seeds=(1,))
    data = change(json.loads(jobs.to_text(job)))
    with pytest.raises(ConfigError, match=message):
        jobs.from_text(data if isinstance(data, str) else json.dumps(data), "a job")


def test_a_job_is_not_run_where_the_weights_differ(tmp_path, monkeypatch):
    job = jobs.Job(task=small(), condition=0, entries=(), seeds=(1,))
    text = jobs.to_text(job)
    monkeypatch.setattr(jobs, "read_package_code", lambda: "of other weights")
    with pytest.raises(ConfigError, match="a job: planned by other code or weights; plan it again"):
        jobs.from_text(text, "a job")


def test_what_was_run_while_the_weights_changed_is_not_stored(tmp_path, monkeypatch):
    planned = jobs.Job(task=small(), condition=0, entries=make_request().entries, seeds=(1,))
    job = jobs.from_text(jobs.to_text(planned), "a job")
    run = partial(jobs.run_job, job, "no drives", run=evaluate.in_process(None))
    first, *_ = run(out=tmp_path)
    monkeypatch.setattr(jobs, "read_package_code", lambda: "of other weights")
    with pytest.raises(ConfigError, match=r"code or weights changed while it ran; run it again"):
        next(run(out=tmp_path / "later"))
    assert store.part_path(tmp_path, first.identity).exists()
    assert not (tmp_path / "later").exists()


def test_entries_are_split_into_jobs_only_if_workers_would_be_idle(tmp_path):
    request = make_request()
    missing = plan.Plan(request.rows(), tmp_path, request.limits).missing()
    assert len(missing) == PARTS
    for workers, count in ((1, 2), (2, 2), (4, 4), (99, PARTS)):
        planned = plan.make_jobs(missing, workers, request.limits)
        assert len(planned) == count
        done = [(entry.name, job.condition) for job in planned for entry in job.entries]
        assert sorted(done) == sorted((row.entry.name, k) for row, k in missing)


def write_files(given):
    """Write a vehicle and a surface into a new folder."""
    given.mkdir()
    write_vehicle(given / "car.yaml", load_vehicle("land_rover_defender_110"))
    surface = with_length(load_road("iso_d"), 16.0).realise(np.random.default_rng(3))
    write_csv(surface, given / "road.csv")


def test_files_of_a_task_are_found_from_another_folder(tmp_path, monkeypatch):
    """By the process that runs a job, and by whoever verifies a folder of results."""
    write_files(tmp_path / "given")
    monkeypatch.chdir(tmp_path)
    t = task(
        car="given/car.yaml",
        training={"roads": [{"kind": "measured", "path": "given/road.csv"}], "seeds": [1]},
        trains_on_test_road=True,
    )
    text = jobs.to_text(jobs.Job(task=t, condition=0, entries=(), seeds=(1,)))
    verification.save_definition(t, tmp_path / "out")
    monkeypatch.chdir("/")
    ((defined,), _) = verification._load_definitions(tmp_path / "out")
    assert defined.vehicle == load_vehicle(tmp_path / "given/car.yaml")
    assert jobs.from_text(text, "a job").task.vehicle == load_vehicle(tmp_path / "given/car.yaml")


@pytest.mark.costly
def test_planned_jobs_need_no_other_file(tmp_path):
    given = tmp_path / "given"
    write_files(given)
    (given / "elsewhere.py").write_text(wheels.module())
    z = np.random.default_rng(5).standard_normal((2, 900))
    header, body = erd_file(z, "<")  # heights in a file of their own
    (given / "section.erd").write_bytes(header)
    (given / "section.bin").write_bytes(body)
    changed = {"kind": "noisy_copy", "road": {"kind": "measured", "path": str(given / "road.csv")}}
    t = task(
        car=str(given / "car.yaml"),
        training={"roads": [changed, str(given / "section.erd")], "seeds": [1]},
        trains_on_test_road=True,
    )
    code = entry_files.snapshot(str(given), None)
    entry = Entry(name="elsewhere", reference=str(given), code=code)
    request = RunRequest([t], [entry], seeds=(1,))
    count = write_jobs(request, tmp_path / "out", tmp_path / "jobs")
    assert count == len(t.conditions) * (1 + len(BASELINES) + 1)  # and `memory`
    shutil.rmtree(given)
    for path in sorted((tmp_path / "jobs").glob("*.json")):
        job = jobs.from_text(path.read_text(), str(path), path.parent)
        assert job.task.digest == t.digest
        again = jobs.from_text(jobs.to_text(job), "on a worker", tmp_path / "elsewhere")
        assert again == dataclasses.replace(job, task_digest=t.digest)
        code_folders = jobs._code_folders(again)
        if again.entries == (entry,):
            with SandboxClient(Limits(isolation="process"), code=code_folders) as sandbox:
                assert sandbox._snapshot(str(given))[0] == code


def test_the_summary_of_a_result_is_equal_after_json(tmp_path):
    request = make_request()
    missing = plan.Plan(request.rows(), tmp_path, request.limits).missing()
    (job, *_) = plan.make_jobs(missing, 1, request.limits)
    for done in InProcessExecutor(fake_drives, ESTIMATORS).run([job], tmp_path):
        assert build(jobs.JobDone, json.loads(json.dumps(dataclasses.asdict(done))), "done") == done
        assert (
            content_digest(store.load_part(part_path(tmp_path, done.identity)))
            == done.content_digest
        )
