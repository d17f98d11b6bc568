"""The attainable error on boards: scores, row, cache, and which drives have none."""

from dataclasses import replace

import numpy as np
import pytest
from fake_estimators import Reader
from fake_results import run_scores, runs_of
from fakes import fake_drives, task

from leaderboard.evaluation.evaluate import run_task
from leaderboard.evaluation.results import content_digest
from leaderboard.report import attainable
from leaderboard.report.sentences import build_report
from leaderboard.report.site import write_site
from leaderboard.report.tables import board_views
from leaderboard.running.board import Board
from leaderboard.running.verification import Verified


@pytest.fixture
def computed(tmp_path, monkeypatch):
    """Records for which the attainable error, here 0.01 m of RMS height, was computed."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    records = []

    def error(record, truth, car, prior, **options):
        records.append(record)
        assert options == {"bandwidth": 100.0, "instruments": task().instruments}
        return 0.01 / truth.z.std()

    monkeypatch.setattr(attainable, "simulate_drives", fake_drives)
    monkeypatch.setattr(attainable, "attainable_error", error)
    monkeypatch.setattr(error, "__module__", "estimators.map_smoother.attainable")
    return records


def test_every_drive_is_computed_once_and_efficiency_is_relative_to_it(computed):
    t = task()
    rows = run_task(t, {"reader": Reader(), "flat": Reader(gain=0.0)}, (1,), simulate=fake_drives)
    for _ in range(2):
        board = attainable.with_attainable(Board((t,), {t.name: rows}))
        runs = [scores for row in board.results[t.name] for scores in runs_of(row).values()]
        assert len(computed) == len(runs) / 2
    for scores in runs:
        expected = (scores["attainable_nrmse"] / scores["nrmse"]) ** 2
        assert scores["attainable_efficiency"] == pytest.approx(expected)
    (view,) = board_views(board)
    by_name = {row.name: row for row in view.sections[0].rows}
    errors = run_scores(board.results[t.name][0], "attainable_nrmse")
    assert by_name["attainable"].values["nrmse"] == pytest.approx(np.mean(errors), rel=0.2)
    assert by_name["reader"].values["attainable_efficiency"] > 0.0
    (plain,) = board_views(Board((t,), {t.name: rows}))
    assert "attainable" not in {row.name for row in plain.sections[0].rows}


def test_what_was_verified_of_a_row_holds_with_its_attainable_errors(computed):
    t = task()
    (row,) = run_task(t, {"reader": Reader()}, (1,), simulate=fake_drives)
    found = Verified(task=t.name, estimator="reader", content=content_digest(row), runs=1)
    board = Board((t,), {t.name: [row]}, verified={content_digest(row): [found]})
    board = attainable.with_attainable(board)
    (more,) = board.results[t.name]
    assert content_digest(more) != content_digest(row)
    assert board.verified[content_digest(more)] == [found]


def test_drives_of_perturbed_vehicles_or_without_noise_and_tasks_without_a_bound_have_none(
    computed,
):
    t = task()
    field = replace(t, conditions=tuple(replace(c, grade="S2") for c in t.conditions))
    quiet = replace(t, test=replace(t.test, noise=False))
    for other in (field, quiet, replace(t, bound=False)):
        rows = run_task(other, {"reader": Reader()}, (1,), simulate=fake_drives)
        board = attainable.with_attainable(Board((other,), {other.name: rows}))
        assert "attainable_nrmse" not in set(board.results[other.name][0].scores["score"])
    assert computed == []


def test_the_row_is_of_the_drives_of_the_error_beside_it(computed):
    t = task(conditions=[{"mode": "ride", "speed_kmh": 54.0, "grade": x} for x in ("S0", "S3")])
    rows = run_task(t, {"reader": Reader()}, (1,), simulate=fake_drives)
    (view,) = board_views(attainable.with_attainable(Board((t,), {t.name: rows})))
    (row,) = (row for row in view.sections[0].rows if row.name == "attainable")
    assert row.values["nrmse"] is None and row.groups["car S3"]["nrmse"] is None
    assert row.groups["car S0"]["nrmse"] > 0.0


def test_the_pages_of_a_board_have_its_row(computed, tmp_path):
    t = task()
    rows = run_task(t, {"flat": Reader(gain=0.0)}, (1,), simulate=fake_drives)
    board = attainable.with_attainable(Board((t,), {t.name: rows}))
    write_site(board, build_report(board), tmp_path)
    (page,) = (p for p in tmp_path.rglob("*.html") if p.stem == t.name)
    assert '<th scope="row">attainable' in page.read_text()
    assert not any(p.stem == "attainable" for p in tmp_path.rglob("*.html"))
