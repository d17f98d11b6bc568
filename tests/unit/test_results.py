"""Results: storage and staleness."""

import dataclasses
import hashlib
import json

import numpy as np
import pytest
from fake_results import ENTRIES, result_of, results_by_fakes, run_scores
from fakes import task

from leaderboard.evaluation import results
from leaderboard.evaluation.results import content_digest, isolation_notice
from leaderboard.evaluation.store import (
    RowChangedError,
    load,
    load_rows,
    row_path,
    save,
)
from leaderboard.report.tables import board_views
from leaderboard.running.board import ATTEMPTS, Board, RunRequest, load_board, render_with_retry
from road_envs.core import atomic_io
from road_envs.core.artifacts import CHECKSUM_PREFIX, text_checksum
from road_envs.core.config import ConfigError


def edited(tmp_path, change):
    """Return the file of the reader's result after changing its text."""
    path = save(result_of("reader"), tmp_path)
    path.write_text(change(path.read_text()))
    return path


def with_valid_checksum(change):
    """Return a change of a text that also updates the checksum."""

    def apply(text):
        text = change(text)
        return text.replace(json.loads(text)["sha256"], text_checksum(text))

    return apply


def replaced(old, new):
    def apply(text):
        assert text.count(old) == 1
        return text.replace(old, new)

    return apply


def test_a_result_is_equal_after_writing_and_reading(tmp_path):
    for result in results_by_fakes():
        path = save(result, tmp_path)
        assert path == row_path(tmp_path, "small", result.estimator)
        assert load(path) == result
    rows = load_rows(tmp_path, task())
    assert [row.estimator for row in rows] == sorted(ENTRIES)


def test_undefined_scores_stay_undefined(tmp_path):
    drives = tuple(
        dataclasses.replace(d, scores={**d.scores, "r": None}) for d in result_of("reader").drives
    )
    back = load(save(dataclasses.replace(result_of("reader"), drives=drives), tmp_path))
    assert np.isnan(run_scores(back, "r")).all() and np.isfinite(run_scores(back, "nrmse")).all()


def test_heights_of_a_trace_are_stored_to_a_hundredth_of_a_millimetre():
    z = np.random.default_rng(0).standard_normal((2, 50))
    stored = results.quantize_heights(z)
    trace = dataclasses.replace(result_of("reader").traces[0], truth=stored, estimate=stored)
    np.testing.assert_allclose(trace.z_true, z, atol=0.51e-5)
    assert trace.s.shape == (50,) and trace.s[1] == trace.ds


INVALID = [
    (lambda text: text[:1000], "damaged, not valid JSON"),
    (lambda text: "", "damaged, not valid JSON"),
    (lambda text: "[" * 100_000, "damaged, not valid JSON"),
    (lambda text: "[]", "not a result (it has no format)"),
    (lambda text: "{}", "not a result (it has no format)"),
    (lambda text: '{"format": 5}', "does not begin with its checksum"),
    (lambda text: json.dumps(json.loads(text)), "does not begin with its checksum"),
    (replaced('"format": 5', '"format": 1'), "written in format 1, this version reads 5"),
    (replaced('"format": 5', '"format": 9'), "written in format 9 by a newer version"),
    (replaced('"role": "entry"', '"role": "king"'), "modified since it was written, by hand or"),
    (with_valid_checksum(replaced('"role": "entry"', '"role": "king"')), "role: "),
    (with_valid_checksum(replaced('"format": 5', '"format": 5, "score": 1')), "score: unknown key"),
    (with_valid_checksum(replaced('"seeds": [1, 2, 3]', '"seeds": ["1"]')), "seeds"),
    (
        with_valid_checksum(replaced('"drive": [0, 1, 2, 3, 4, 0, 1, 2, 3, 4]', '"drive": [0]')),
        "different lengths",
    ),
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
    assert text.startswith(CHECKSUM_PREFIX + checksum) and text_checksum(text) == checksum
    for at in np.linspace(100, len(text) - 2, 50, dtype=int):
        path.write_text(text[:at] + chr(ord(text[at]) ^ 1) + text[at + 1 :])
        with pytest.raises(ConfigError):
            load(path)


def test_the_content_digest_ignores_only_timings_and_environment():
    result = result_of("learner")
    digest = content_digest(result)
    rerun = {"train_seconds": (9.0,), "environment": {}, "peak_memory": 9.0, "isolation": "x"}
    assert content_digest(dataclasses.replace(result, **rerun)) == digest
    first, *others = result.drives
    worse = dataclasses.replace(first, scores={**first.scores, "nrmse": 0.0})
    for change in ({"drives": (worse, *others)}, {"parameters": 2}, {"failure": "it failed"}):
        assert content_digest(dataclasses.replace(result, **change)) != digest


def test_rows_that_ran_without_isolation_are_named():
    flat, reader = result_of("flat"), result_of("reader")
    isolated = dataclasses.replace(reader, isolation="bubblewrap")
    assert flat.role == "baseline" and isolation_notice([flat, isolated]) is None
    mixed = dataclasses.replace(reader, isolation="bubblewrap or process")
    for run in (reader, mixed):
        assert isolation_notice([flat, run]).startswith("Run without isolation: reader. These ")
    assert isolation_notice([dataclasses.replace(reader, failure="it failed")]) is None


def test_drives_of_board_rows_are_read_on_demand(tmp_path):
    for result in results_by_fakes():
        save(result, tmp_path)
    rows = load_rows(tmp_path, task())
    for row in rows:
        expected = result_of(row.estimator)
        assert not isinstance(row.drives, tuple) and len(row.drives) == len(expected.drives)
        assert row == expected
        np.testing.assert_array_equal(run_scores(row, "nrmse"), run_scores(expected, "nrmse"))
        assert [trace.seed for trace in row.traces] == [trace.seed for trace in expected.traces]


def test_reading_a_row_replaced_by_a_different_one_raises_an_error(tmp_path):
    path = save(result_of("reader"), tmp_path)
    (row,) = load_rows(tmp_path, task())
    save(dataclasses.replace(result_of("reader"), seeds=(4, 5)), tmp_path)
    with pytest.raises(ConfigError, match="another run has replaced it by a different result"):
        run_scores(row, "nrmse")
    assert path.exists()


def test_a_row_rewritten_with_other_timings_can_still_be_read(tmp_path):
    row_ = dataclasses.replace(result_of("learner"), identity="of all that it depends on")
    save(row_, tmp_path)
    (row,) = load_rows(tmp_path, task())
    save(dataclasses.replace(row_, train_seconds=(9.0, 9.0)), tmp_path)
    np.testing.assert_array_equal(
        run_scores(row, "nrmse"), run_scores(result_of("learner"), "nrmse")
    )


def test_a_board_is_reloaded_if_its_rows_are_replaced_while_rendering(tmp_path):
    save(result_of("reader"), tmp_path)
    others = [dataclasses.replace(result_of("reader"), seeds=(k,)) for k in range(9)]
    request = RunRequest([task()], [])

    def render_while(replacements):
        """Render the board while another run stores one of `replacements` in each attempt."""

        def render(board):
            if replacements:
                save(replacements.pop(), tmp_path)
            return run_scores(board.results["small"][0], "nrmse")

        return render_with_retry(load_board([task()], tmp_path), request, tmp_path, render)

    np.testing.assert_array_equal(
        render_while(others[: ATTEMPTS - 1]), run_scores(result_of("reader"), "nrmse")
    )
    save(others[4], tmp_path)  # one whose drives are not cached
    with pytest.raises(RowChangedError):
        render_while(others[-ATTEMPTS:])


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
