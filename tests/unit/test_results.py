"""Results: storage and staleness."""

import dataclasses
import hashlib
import json
import shutil

import numpy as np
import pytest
from fake_results import (
    ENTRIES,
    result_of,
    results_by_fakes,
    run_scores,
    runs_of,
    with_last_run,
    with_runs,
)
from fakes import task

from leaderboard.evaluation import results
from leaderboard.evaluation.results import content_digest
from leaderboard.evaluation.store import load, load_rows, row_path, save
from leaderboard.report.notes import isolation_notice
from leaderboard.report.tables import board_views
from leaderboard.running.board import Board
from road_envs.core import atomic_io, config
from road_envs.core.artifacts import CHECKSUM_PREFIX, _text_checksum
from road_envs.core.config import ConfigError


def test_the_version_of_the_evaluation_is_of_the_shipped_instruments_too(tmp_path, monkeypatch):
    """Estimators read them by name, whatever instruments a task has."""
    shutil.copytree(config.folder() / "sensors", tmp_path / "sensors")
    before = results.evaluation_version()
    monkeypatch.setattr(config, "folder", lambda: tmp_path)
    assert results.evaluation_version.__wrapped__() == before
    (tmp_path / "sensors" / "paper.yaml").write_text("noise_density: 0.02\n")
    assert results.evaluation_version.__wrapped__() != before


def edited(tmp_path, change):
    """Return the file of the reader's result after changing its text."""
    path = save(result_of("reader"), tmp_path)
    path.write_text(change(path.read_text()))
    return path


def with_valid_checksum(change):
    """Return a change of a text that also updates the checksum."""

    def apply(text):
        text = change(text)
        return text.replace(json.loads(text)["sha256"], _text_checksum(text))

    return apply


def replaced(old, new):
    def apply(text):
        assert text.count(old) == 1
        return text.replace(old, new)

    return apply


def without_scores(text):
    return json.dumps(json.loads(text) | {"scores": None}, indent=1)


def test_a_result_is_equal_after_writing_and_reading(tmp_path):
    for result in results_by_fakes():
        path = save(result, tmp_path)
        assert path == row_path(tmp_path, "small", result.estimator)
        again = load(path)
        assert content_digest(again) == content_digest(result)
        assert again.train_seconds == result.train_seconds
    rows = load_rows(tmp_path, task())
    assert [row.estimator for row in rows] == sorted(ENTRIES)


def test_undefined_scores_stay_undefined(tmp_path):
    runs = {run: {**own, "r": None} for run, own in runs_of(result_of("reader")).items()}
    back = load(save(with_runs(result_of("reader"), runs), tmp_path))
    assert np.isnan(run_scores(back, "r")).all() and np.isfinite(run_scores(back, "nrmse")).all()


def test_heights_of_a_trace_are_stored_to_a_hundredth_of_a_millimetre():
    z = np.random.default_rng(0).standard_normal((2, 50))
    stored = results.Trace.quantized(z)
    trace = dataclasses.replace(result_of("reader").traces[0], truth=stored, estimate=stored)
    np.testing.assert_allclose(trace.z_true, z, atol=0.51e-5)
    assert trace.s.shape == (50,) and trace.s[1] == trace.ds


INVALID = [
    (lambda text: text[:1000], "damaged, not valid JSON"),
    (lambda text: "", "damaged, not valid JSON"),
    (lambda text: "[" * 100_000, "damaged, not valid JSON"),
    (lambda text: "[]", "not a result (it has no format)"),
    (lambda text: "{}", "not a result (it has no format)"),
    (lambda text: '{"format": 6}', "does not begin with its checksum"),
    (lambda text: json.dumps(json.loads(text)), "does not begin with its checksum"),
    (replaced('"format": 6', '"format": 1'), "written in format 1, this version reads 6"),
    (replaced('"format": 6', '"format": 9'), "written in format 9 by a newer version"),
    (replaced('"role": "entry"', '"role": "king"'), "modified since it was written, by hand or"),
    (with_valid_checksum(replaced('"role": "entry"', '"role": "king"')), "role: "),
    (with_valid_checksum(replaced('"format": 6', '"format": 6, "score": 1')), "score: unknown key"),
    (with_valid_checksum(replaced('"seeds": [1, 2, 3]', '"seeds": ["1"]')), "seeds"),
    (with_valid_checksum(replaced('"drive": [0, ', '"drive": [')), "different lengths"),
    (with_valid_checksum(without_scores), "neither scores nor a failure"),
    (
        with_valid_checksum(replaced('"estimator": "reader"', '"estimator": "x"')),
        "contains the result of x on",
    ),
]


@pytest.mark.parametrize(("change", "message"), INVALID)
def test_an_invalid_file_raises_an_error_that_names_it(tmp_path, change, message):
    path = edited(tmp_path, change)
    with pytest.raises(ConfigError) as error:
        load(path)
    assert str(path) in str(error.value) and message in str(error.value)


@pytest.mark.parametrize(("change", "message"), INVALID)
@pytest.mark.costly
def test_an_invalid_file_is_a_failed_row_and_other_rows_are_unaffected(tmp_path, change, message):
    path = edited(tmp_path, change)
    save(result_of("learner"), tmp_path)
    rows = {r.estimator: r for r in load_rows(tmp_path, task())}
    assert set(rows) == {"reader", "learner"} and rows["learner"].failure is None
    assert message in rows["reader"].failure and str(path) in rows["reader"].failure
    assert rows["reader"].stale_reason(task()) is None


def test_the_checksum_covers_every_byte_below_it(tmp_path):
    path = save(result_of("reader"), tmp_path)
    text = path.read_text()
    checksum = hashlib.sha256(text.split("\n", 2)[2].encode()).hexdigest()
    assert text.startswith(CHECKSUM_PREFIX + checksum) and _text_checksum(text) == checksum
    for at in np.linspace(100, len(text) - 2, 50, dtype=int):
        path.write_text(text[:at] + chr(ord(text[at]) ^ 1) + text[at + 1 :])
        with pytest.raises(ConfigError):
            load(path)


def test_the_content_digest_ignores_only_timings_and_environment():
    result = result_of("learner")
    digest = content_digest(result)
    rerun = {"train_seconds": (9.0,), "environment": {}, "peak_memory": 9.0, "isolation": "x"}
    rerun["limits"] = (60.0, 4.0)
    assert content_digest(dataclasses.replace(result, **rerun)) == digest
    worse = with_last_run(result, lambda scores: scores | {"nrmse": 0.0})
    for change in ({"scores": worse.scores}, {"parameters": 2}, {"failure": "it failed"}):
        assert content_digest(dataclasses.replace(result, **change)) != digest


@pytest.mark.parametrize("given", [(None, 1.0, 3.0), (1.0, None, 3.0)])
def test_a_row_calibrates_if_it_does_so_under_some_condition_and_takes_the_mean_time(given):
    one = result_of("reader")
    parts = [
        dataclasses.replace(one, calibrates=seconds is not None, calibrate_seconds=seconds)
        for seconds in given
    ]
    merged = results.merge_parts(parts, "")
    assert merged.calibrates is True and merged.calibrate_seconds == 2.0
    never = results.merge_parts([parts[given.index(None)]] * 2, "")
    assert never.calibrates is False and never.calibrate_seconds is None
    assert results.merge_parts([one, one], "").calibrates is None


def test_rows_that_ran_without_isolation_are_named():
    flat, reader = result_of("flat"), result_of("reader")
    isolated = dataclasses.replace(reader, isolation="bubblewrap")
    assert flat.role == "baseline" and isolation_notice([flat, isolated]) is None
    mixed = dataclasses.replace(reader, isolation="bubblewrap or process")
    for run in (reader, mixed):
        assert isolation_notice([flat, run]).startswith("Run without isolation: reader. These ")
    assert isolation_notice([dataclasses.replace(reader, failure="it failed")]) is None


def test_an_interrupted_write_leaves_only_the_old_file(tmp_path, monkeypatch):
    path = save(result_of("reader"), tmp_path)
    before = path.read_text()

    def interrupted(*names):
        raise KeyboardInterrupt

    monkeypatch.setattr(atomic_io.os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save(result_of("reader"), tmp_path)
    assert path.read_text() == before and list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"task_digest": "0" * 64}, "the task has changed"),
        ({"package_version": "0.0.1"}, "made by version 0.0.1"),
        ({"metric_version": 0}, "scored by metrics 0"),
        ({"evaluation_code": "0" * 16}, "driven or scored by other code"),
    ],
)
def test_a_result_of_another_task_version_or_metric_is_stale(change, why):
    assert result_of("reader").stale_reason(task()) is None
    old = dataclasses.replace(result_of("reader"), **change)
    assert why in old.stale_reason(task())
    (section,) = board_views(Board((task(),), {"small": (old,)}))[0].sections
    (line,) = section.rows
    assert line.state == "stale" and line.cells == {} and why in line.message
