"""Stored drives are run again: on this machine to rounding, on other kernels within a tolerance."""

import dataclasses
import json
import os
import subprocess
import sys

import pytest
from board_runs import ESTIMATORS, NAMES, make_request, run
from fakes import SHORT_TASK, fake_drives

from leaderboard.entries.entries import make_entry
from leaderboard.evaluation import evaluate, store
from leaderboard.evaluation.comparison import OTHER_KERNELS, SAME_KERNELS
from leaderboard.evaluation.provenance import describe_environment
from leaderboard.metrics.baselines import BASELINES
from leaderboard.running.board import create_baselines, load_board
from leaderboard.running.verification import (
    kernel_notes,
    kernels_of,
    load_verified,
    save_verified,
    verify_folder,
)
from road_envs.core.config import ConfigError


def chosen_fakes(task, drives, condition, chosen):
    for drive in fake_drives(task, drives, condition):
        if drives is task.training or drive.index in chosen:
            yield drive


def run_here(entry, data, seeds):
    estimators = ESTIMATORS | create_baselines()
    yield from evaluate.in_process(estimators[entry.name])(entry, data, seeds)


def verify(out, entries=None, **options):
    if entries is None:
        entries = [make_entry(name, estimator) for name, estimator in ESTIMATORS.items()]
    found = verify_folder(out, run_here, entries, simulate=chosen_fakes, seed=1, **options)
    return {row.estimator: row for row in found}


def alter(out, name, **changes):
    """Store a row with other fields, or with other scores of its last drive."""
    row = store.load(store.row_path(out, "small", name))
    scores = changes.pop("scores", {})
    *others, last = row.drives
    last = dataclasses.replace(last, scores=last.scores | scores)
    store.save(dataclasses.replace(row, drives=(*others, last), **changes), out)


def test_a_tenth_of_the_drives_of_an_unaltered_folder_agrees_to_rounding(tmp_path):
    run(tmp_path)
    found = verify(tmp_path)
    assert found.keys() == NAMES
    for row in found.values():
        assert row.agrees and row.distance <= SAME_KERNELS == row.tolerance, row
    # one of six drives, with both training seeds of what is trained
    assert found["reader"].runs == 1 and found["learner"].runs == 2
    whole = verify(tmp_path, share=1.0)
    assert whole["reader"].runs == 6 and whole["learner"].runs == 12


def test_an_altered_score_is_found_by_its_distance(tmp_path):
    run(tmp_path)
    score = store.load(store.row_path(tmp_path, "small", "reader")).drives[-1].scores["nrmse"]
    alter(tmp_path, "reader", scores={"nrmse": 1.01 * score})
    found = verify(tmp_path, share=1.0)
    assert [name for name, row in found.items() if not row.agrees] == ["reader"]
    assert found["reader"].score == "nrmse"
    assert found["reader"].distance == pytest.approx(0.01 * score / max(1.01 * score, 0.1))


def test_a_score_and_a_drive_that_a_row_lacks_are_as_far_as_can_be_and_kept_so(tmp_path):
    run(tmp_path)
    row = store.load(store.row_path(tmp_path, "small", "reader"))
    store.save(dataclasses.replace(row, drives=row.drives[:-1]), tmp_path)
    found = verify(tmp_path, share=1.0)
    assert found["reader"].distance == 2.0 and not found["reader"].agrees
    save_verified(found.values(), tmp_path)
    assert load_verified(tmp_path)[row.identity] == [found["reader"]]


def test_of_a_row_of_other_kernels_the_ranking_score_is_compared_at_a_wider_tolerance(tmp_path):
    run(tmp_path)
    scores = store.load(store.row_path(tmp_path, "small", "reader")).drives[-1].scores
    elsewhere = describe_environment() | {"blas": "openblas Z80"}
    for share, agrees in ((0.9, True), (1.1, False)):
        moved = {"nrmse": scores["nrmse"] / (1.0 - share * OTHER_KERNELS), "r": 0.0}
        alter(tmp_path, "reader", scores=moved, environment=elsewhere)
        found = verify(tmp_path, share=1.0)["reader"]
        assert found.agrees == agrees and found.tolerance == OTHER_KERNELS
        assert found.score == "nrmse"
        assert found.distance == pytest.approx(share * OTHER_KERNELS)


def test_a_row_that_cannot_be_run_again_says_why(tmp_path):
    run(tmp_path)
    other = dataclasses.replace(ESTIMATORS["reader"], gain=0.1)
    found = verify(tmp_path, entries=[make_entry("reader", other)])
    assert found["learner"].reason == "not of this package: give it with --estimator"
    assert found["reader"].reason == "made with other settings"
    assert not found["reader"].agrees and all(found[name].agrees for name in BASELINES)
    alter(tmp_path, "reader", code="0" * 16)
    assert verify(tmp_path)["reader"].reason == "its code or its weights have changed"


def test_a_task_that_is_not_the_one_of_its_file_is_refused(tmp_path):
    run(tmp_path)
    (path,) = (tmp_path / "definitions").iterdir()
    path.rename(path.with_stem("0" * 64))
    with pytest.raises(ConfigError, match="the task small, or a file that it names, is not the"):
        verify(tmp_path)
    path.with_stem("0" * 64).unlink()
    with pytest.raises(ConfigError, match="no results with the task that they were made with"):
        verify(tmp_path)


def made_on(blas, results):
    environment = describe_environment() | {"blas": blas}
    return [dataclasses.replace(r, environment=environment) for r in results]


def test_rows_of_other_kernels_are_noted_unless_they_were_verified(tmp_path):
    board, _ = run(tmp_path)
    first, *others = (r for r in board.results["small"] if r.estimator != "reader")
    reader = next(r for r in board.results["small"] if r.estimator == "reader")
    (usual,) = {kernels_of(r.environment) for r in others}
    results = [*others, *made_on("openblas Z80", [first, reader])]
    (note,) = kernel_notes(results, {})
    assert note.startswith(f"{first.estimator}, reader ran on ")
    assert "Z80" in note and usual in note and note.endswith("not verified there.")
    save_verified([dataclasses.replace(row, tolerance=OTHER_KERNELS) for row in
                   verify(tmp_path, share=1.0).values()], tmp_path)  # fmt: skip
    verified = load_verified(tmp_path)
    assert kernel_notes(results, verified) == []
    apart = {reader.identity: [dataclasses.replace(verified[reader.identity][0], distance=0.3)]}
    (note,) = kernel_notes(results, verified | apart)
    assert note.startswith("reader ran on ") and note.endswith("3.0e-01 apart there.")


def test_what_was_verified_is_kept_by_row_and_kernels_and_shown(tmp_path):
    board, _ = run(tmp_path)
    found = verify(tmp_path)["reader"]
    for kernels, distance in (("A", 0.3), ("B", 0.1), ("A", 0.2)):
        row = dataclasses.replace(found, kernels=kernels, distance=distance)
        save_verified([row, dataclasses.replace(found, reason="stale", identity="x")], tmp_path)
    (rows,) = load_verified(tmp_path).values()
    assert {row.kernels: row.distance for row in rows} == {"A": 0.2, "B": 0.1}
    assert load_board(board.tasks, tmp_path, make_request().rows()).verified == {
        found.identity: rows
    }
    (tmp_path / "verified.json").write_text("{}")
    assert load_verified(tmp_path) == {}


@pytest.mark.processes
def test_a_folder_made_with_one_blas_kernel_is_verified_with_another(tmp_path):
    (tmp_path / "short.yaml").write_text(SHORT_TASK)
    out = tmp_path / "out"
    command = [sys.executable, "-m", "leaderboard.cli"]
    made = ["leaderboard", "--task", "short.yaml", "--estimator", "wiener", "--out", str(out)]
    for kernel, arguments in (("Haswell", made), ("Sandybridge", ["verify", str(out), "--json"])):
        process = subprocess.run(
            [*command, *arguments],
            env=os.environ | {"OPENBLAS_CORETYPE": kernel},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert process.returncode == 0, process.stderr
    found = {row["estimator"]: row for row in json.loads(process.stdout)}
    assert "wiener" in found and all(row["agrees"] for row in found.values())
    assert all(row["tolerance"] == OTHER_KERNELS for row in found.values())
    assert "Sandybridge" in found["wiener"]["kernels"] and found["wiener"]["runs"] == 1
