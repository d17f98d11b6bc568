"""The data of the charts and the sentences above them equal the scores."""

import dataclasses
import json
import re

import fakes
import numpy as np
import pytest
from example_site import board, lines_of, results, site, tasks, text_of
from fake_results import run_scores, runs_of

from estimators.registry import REGISTRY
from leaderboard.metrics.baselines import BASELINES
from leaderboard.metrics.heights import band_pass, scored_band
from leaderboard.metrics.registry import SCORES
from leaderboard.report.board_definitions import BELOW_BOUND, BOUND_ROW
from leaderboard.report.charts import bound_lines, task_charts
from leaderboard.report.estimator_page import _calibration_figure
from leaderboard.report.figures import line_style
from leaderboard.report.notes import sanity_warnings
from leaderboard.report.overview import ranking_chart
from leaderboard.report.sentences import build_report, headline
from leaderboard.report.site import _render_pages
from leaderboard.report.tables import Row, board_views
from leaderboard.running.board import Board
from leaderboard.sandbox.retest import REMEMBERS, UNTESTABLE


def chart(page, name):
    found = re.search(rf'id="chart-{name}">(.*?)</script>', site()[page], flags=re.S)
    return json.loads(found[1])


def lines_by_name(figure):
    """Return the lines of a figure; bands and marks share the names of lines."""
    return {x["name"]: x for x in figure["data"] if "lines" in x["mode"] and "fill" not in x}


RIDE = tasks()[0].conditions[0].label


@pytest.mark.costly
def test_encoded_heights_are_decoded_to_the_stored_ones():
    figures = chart("tasks/held_out.html", "road")["figures"]
    trace = next(r for r in results()["held_out"] if r.estimator == "reader").traces[0]
    line = lines_by_name(figures[f"{RIDE}|right|raw"])["reader"]
    expected = trace.z_estimated[1] - np.median(trace.z_estimated[1])
    step = round(line["dx"] / trace.ds)
    np.testing.assert_allclose(np.cumsum(line["dy"]) * 1e-4, expected[::step], atol=0.6e-4)
    inside = band_pass(trace.z_true, trace.ds, scored_band(14.5 / 3.6))
    line = lines_by_name(figures[f"{RIDE}|left|inside"])["truth"]
    step = round(line["dx"] / trace.ds)
    np.testing.assert_allclose(np.cumsum(line["dy"]) * 1e-4, inside[0][::step], atol=0.6e-4)
    assert inside.shape[1] == trace.s.size - 2 * round(line["x0"] / trace.ds)


def test_an_interval_is_drawn_where_the_estimate_has_a_deviation():
    lines = lines_by_name(chart("tasks/held_out.html", "road")["figures"][f"{RIDE}|left|inside"])
    assert "std" not in lines["reader"]
    std = lines["online"]["std"]
    assert len(std) == len(lines["online"]["dy"]) and set(std) == {30}


def test_truth_and_the_two_best_entries_are_shown_at_first():
    lines = lines_by_name(chart("tasks/held_out.html", "road")["figures"][f"{RIDE}|left|inside"])
    shown = [name for name, line in lines.items() if "visible" not in line]
    assert shown == ["truth", "reader", "static_lm"]


def test_an_entry_has_one_colour_on_every_page():
    colours = {"line": set(), "marker": set()}
    for page, text in site().items():
        for name in re.findall(r'json" id="chart-([\w-]+)"', text):
            for figure in chart(page, name)["figures"].values():
                for trace in figure["data"]:
                    if trace["name"] == "reader" and "fill" not in trace:
                        kind = "marker" if trace.get("type") == "bar" else "line"
                        colours[kind].add(trace[kind]["color"])
    assert colours["line"] == colours["marker"] and len(colours["line"]) == 1


def test_every_shipped_estimator_has_a_line_of_its_own():
    names = [name for name in REGISTRY if name not in BASELINES]
    looks = [(line_style(name)["color"], line_style(name)["dash"]) for name in names]
    assert len(set(looks)) == len(names), "name the new estimator in figures.FAMILIES"


def test_obstacles_are_marked_as_detected_missed_and_false_alarms():
    figures = chart("tasks/blocks.html", "road")["figures"]
    label = tasks()[2].conditions[0].label
    for side, height in (("left", 150.0), ("right", 100.0)):
        marks = [x for x in figures[f"{label}|{side}|raw"]["data"] if x["mode"] == "markers"]
        by_name = {mark["name"]: mark for mark in marks}
        assert by_name["truth: true obstacle"]["y"] == [pytest.approx(height, abs=0.5)]
        assert len(by_name["reader: detected"]["x"]) == 1
        assert not {"reader: missed", "reader: false alarm"} & set(by_name)


def test_densities_errors_and_performance_profiles_equal_the_scores():
    page = "tasks/held_out.html"
    reader = next(r for r in results()["held_out"] if r.estimator == "reader")
    lines = lines_by_name(chart(page, "error")["figures"][RIDE])
    assert len(lines["reader"]["y"]) == len(lines["reader"]["x"]) == 15
    assert lines["reader"]["y"][5] == pytest.approx(0.1, abs=0.02)  # 0.9 of the truth everywhere
    assert len(lines["bound"]["y"]) == 15 and min(lines["bound"]["y"]) > 0.0
    profile = lines_by_name(chart(page, "runs")["figures"][""])["reader"]
    below = [100 * np.mean(run_scores(reader, "nrmse") <= x) for x in profile["x"]]
    assert profile["y"] == pytest.approx(below, abs=0.1)
    density = chart(page, "density")
    lines = lines_by_name(density["figures"][RIDE])
    n, truth, mine = (
        np.array(x, dtype=float)
        for x in (lines["truth"]["x"], lines["truth"]["y"], lines["reader"]["y"])
    )
    below = n < 3.0  # above, the rounding of stored traces is noise
    np.testing.assert_allclose((mine / truth)[below], 0.81, rtol=0.02)
    letters = [note["text"] for note in density["layout"]["annotations"]]
    assert "".join(letters) == "ACEG"  # of the shaded classes


def test_a_task_without_a_bound_has_no_line_of_one():
    t = fakes.task()
    quiet = dataclasses.replace(t.test, noise=False)
    for changes, expected in (({}, ["bound"]), ({"bound": False}, []), ({"test": quiet}, [])):
        t = dataclasses.replace(t, **changes)
        names = [line["name"] for c in t.conditions for line in bound_lines(t, c)]
        assert names == expected * len(t.conditions)


def test_the_ranking_chart_shows_every_entry_with_its_interval():
    (section,) = board_views(board())[0].sections
    (bars,) = chart("index.html", "ranking")["figures"][""]["data"]
    rows = [row for row in section.rows if row.state == "scored"]
    assert [re.search(r">(\w+)</a>", label)[1] for label in bars["y"]] == [r.name for r in rows]
    for k, row in enumerate(rows):
        low, high = row.values["low"], row.values["high"]
        assert bars["x"][k] == pytest.approx(row.values["nrmse"], rel=1e-4)
        assert bars["x"][k] - bars["error_x"]["arrayminus"][k] == pytest.approx(low, abs=1e-4)
        assert bars["x"][k] + bars["error_x"]["array"][k] == pytest.approx(high, abs=1e-4)
    marked = " ".join(x["text"] for x in chart("index.html", "ranking")["layout"]["annotations"])
    assert "linear bound" in marked and "flat" in marked and "unrelated road" in marked


def test_a_score_in_percent_is_drawn_in_percent():
    (view,) = [v for v in board_views(board()) if v.board == "new_road"]
    values = {"level_error": 0.2, "low": 0.1, "high": 0.5}
    rows = (Row("mine", "scored", {}, values), Row("flat", "baseline", {}, {"level_error": 0.4}))
    definition = dataclasses.replace(view.definition, ranks_by="level_error")
    section = dataclasses.replace(
        view.sections[0], rows=rows, task=dataclasses.replace(tasks()[0], board=definition)
    )
    drawn = ranking_chart(section)
    (bars,), layout = drawn["figures"][""]["data"], drawn["layout"]
    assert bars["x"] == [20.0] and ">20.0<" in bars["y"][0]
    assert (bars["error_x"]["arrayminus"], bars["error_x"]["array"]) == ([10.0], [30.0])
    assert layout["xaxis"]["title"]["text"].endswith("[%]")
    assert layout["annotations"][0]["x"] == layout["shapes"][0]["x0"] == 40.0
    assert layout["xaxis"]["range"] == [0.0, 43.2]


def test_a_ranking_of_bad_entries_only_is_drawn_too():
    row = Row("bad", "scored", {}, {"nrmse": 70.0})
    (view,) = [v for v in board_views(board()) if v.board == "new_road"]
    section = dataclasses.replace(view.sections[0], rows=(row,))
    chart = ranking_chart(section)
    assert chart["layout"]["xaxis"]["range"] == [0.0, view.definition.scale]
    assert ranking_chart(dataclasses.replace(section, rows=())) is None


def test_the_headline_names_best_next_and_certainty():
    text = text_of(site()["index.html"])
    cells = lines_of()["reader"].cells
    assert f"reader is best: its error is {cells['nrmse']}, where" in text
    assert "static_lm follows with" in text and "The first place is decided" in text
    online = lines_of()["online"].cells["nrmse"]
    assert f"online with {online}, the best that may run while driving" in text


def test_the_first_place_is_not_decided_where_another_entry_shares_it():
    section, *_ = board_views(board())[0].sections
    assert headline(section)[0].startswith("reader is best: its error is ")
    for rank in (1, None):  # or where there are too few roads
        rows = [
            dataclasses.replace(row, values={**row.values, "rank": rank})
            if row.name in ("reader", "static_lm")
            else row
            for row in section.rows
        ]
        first, *_, last = headline(dataclasses.replace(section, rows=rows))
        assert first.startswith("reader has the lowest error: ")
        tied = "The first place is not decided: these drives cannot tell static_lm from it."
        assert last == tied if rank else last.startswith("Too few roads")


def test_nothing_is_a_multiple_of_an_exact_estimate():
    section, *_ = board_views(board())[0].sections
    assert "times as much" in headline(section)[1]
    rows = [
        dataclasses.replace(row, values=row.values | {"nrmse": 0.0})
        if row.name == "reader"
        else row
        for row in section.rows
    ]
    _, others, *_ = headline(dataclasses.replace(section, rows=rows))
    assert "static_lm follows with" in others and "times as much" not in others


def test_calibration_counts_the_errors_inside_the_stated_intervals():
    figure = chart("estimators/online.html", "calibration")["figures"]["held_out"]
    line = lines_by_name(figure)["online"]
    (online,) = [r for r in results()["held_out"] if r.estimator == "online"]
    errors = []
    for trace in online.traces:
        band = scored_band(trace.speed_kmh / 3.6)
        errors.append(np.abs(band_pass(trace.z_estimated - trace.z_true, trace.ds, band)).ravel())
    # 0.003 m is one standard deviation, and 0.675 of it bound half of a normal distribution
    half = 100.0 * np.mean(np.concatenate(errors) <= 0.67449 * 0.003)
    assert line["y"][line["x"].index(50.0)] == pytest.approx(half, abs=0.2)
    assert "calibration" not in site()["estimators/reader.html"]


def test_errors_without_a_deviation_are_inside_no_interval_unless_they_are_0():
    """Left out, an entry without deviations where it errs would look calibrated on its page."""
    (online,) = [r for r in results()["held_out"] if r.estimator == "online"]

    def inside(share, **changes):
        odd = np.arange(online.traces[0].s.size) % 2
        traces = tuple(
            dataclasses.replace(x, deviation=share * odd * x.deviation, **changes)
            for x in online.traces
        )
        drawn = _calibration_figure(None, dataclasses.replace(online, traces=traces))
        return drawn["data"][1]["y"][-1]

    truth = online.traces[0].truth
    assert 45.0 < inside(1) < 55.0 and inside(0) < 5.0
    assert inside(0, truth=truth, estimate=truth) == 100.0


def test_the_page_of_an_estimator_has_method_worst_drives_and_cost():
    text = text_of(site()["estimators/static_lm.html"])
    assert "Levenberg-Marquardt" in text and "estimators/networks/static_lm.py" in text
    assert "comes from another package" in text_of(site()["estimators/reader.html"])
    reader = next(r for r in results()["held_out"] if r.estimator == "reader")
    worst = max(scores["nrmse"] for scores in runs_of(reader).values())
    assert SCORES["nrmse"].format_value(worst) in text_of(site()["estimators/reader.html"])
    assert "RuntimeError: no idea" in text_of(site()["estimators/broken.html"])


def test_rows_without_isolation_are_named_above_the_ranking():
    text = text_of(site()["index.html"])
    assert "Run without isolation: online, reader, static_lm" in text
    safe = {
        name: tuple(dataclasses.replace(r, isolation="bubblewrap") for r in found)
        for name, found in results().items()
    }
    made = Board(tuple(tasks()), safe)
    text = text_of(dict(_render_pages(made, build_report(made)))["index.html"])
    assert "without isolation" not in text and "roads of this board are public" not in text


def test_the_page_of_a_public_board_says_in_its_head_that_ranks_come_from_seasons():
    """The roads of a shipped task can be drawn by anybody, those of its season cannot."""
    (held_out, *_), found = tasks(), results()["held_out"]
    for name, is_public in (("new_road", True), ("new_road_0123abcd", False)):
        public = dataclasses.replace(held_out, name=name)
        rows = tuple(dataclasses.replace(r, task_digest=public.digest) for r in found)
        made = Board((public,), {name: rows})
        report = build_report(made)
        pages = dict(_render_pages(made, report))
        for page in ("index.html", f"tasks/{name}.html"):
            text = text_of(pages[page])
            head = text[: text.index("Who is best?" if page == "index.html" else "estimator")]
            assert ("A rank counts only in a sealed season" in head) is is_public, page
        (section,) = report.views[0].sections
        first = next(iter(section.notes), "")
        assert first.startswith("The test roads of this board are public") is is_public


def test_what_the_judge_has_found_out_about_an_entry_is_read_beside_its_row():
    notes = tuple(f"reader: {note}" for note in (REMEMBERS, UNTESTABLE))
    for task in tasks():
        rows = [
            dataclasses.replace(r, notes=(*r.notes, *notes), causal=False)
            if r.estimator == "reader"
            else r
            for r in results()[task.name]
        ]
        made = Board((task,), {task.name: rows})
        report = build_report(made)
        pages = dict(_render_pages(made, report))
        (section,) = (x for view in report.views for x in view.sections)
        assert {f"{note}." for note in notes} <= set(section.notes)
        assert not [x for x in section.notes if x.startswith("Surface") and "reader" in x]
        for page in ("index.html", f"tasks/{task.name}.html"):
            assert all(note in text_of(pages[page]) for note in notes), page


def test_an_entry_is_causal_if_it_was_found_so_on_all_tasks():
    one, other = (task for task in tasks() if task.name in ("held_out", "paving"))
    for last in (True, False):
        rows = {
            task.name: [
                dataclasses.replace(r, causal=causal) if r.estimator == "reader" else r
                for r in results()[task.name]
            ]
            for task, causal in ((one, True), (other, last))
        }
        made = Board((one, other), rows)
        page = dict(_render_pages(made, build_report(made)))["estimators/reader.html"]
        assert ("Causal: the height" in text_of(page)) is last


def test_the_sentence_on_an_entry_below_the_bound_does_not_comfort_on_public_roads():
    rows = [
        Row("redrawn", "scored", values={"nrmse": 0.055, BELOW_BOUND: 1.0}),
        Row(BOUND_ROW, "baseline", values={"nrmse": 0.24}),
    ]
    (public,), (sealed,) = (sanity_warnings(rows, "nrmse", public) for public in (True, False))
    assert (
        public
        == f"{sealed}: it knows more than the sensors tell, or has drawn these public roads again"
    )


def test_a_flat_estimate_can_be_drawn():
    flat = {"flat": next(r for r in results()["paving"] if r.estimator == "flat")}
    (view,) = [v for v in board_views(board()) if v.board == "paper"]
    rows = {row.name: row for row in view.sections[0].rows}
    made = task_charts(tasks()[1], flat, rows, np.zeros((1, 1), bool))["density"]
    (figure,) = made["figures"].values()
    assert set(lines_by_name(figure)["flat"]["y"]) == {None}


def test_rendering_twice_gives_identical_pages():
    made = board()
    again = dict(_render_pages(made, build_report(made)))
    assert again == site()
