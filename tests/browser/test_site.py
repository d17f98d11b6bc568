"""The site shows the stored results, is self-contained, and works in a browser."""

import csv
import dataclasses
import io
import json
import re
import shutil
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Browser
from fakes import Broken, Learner, Reader, fake_drives, task
from html_checker import HtmlChecker

from estimators.registry import REGISTRY
from leaderboard.evaluation.entry import Entry
from leaderboard.evaluation.evaluate import run_task
from leaderboard.evaluation.store import row_path, save
from leaderboard.metrics.baselines import BASELINES
from leaderboard.metrics.heights import band_pass, scored_band
from leaderboard.metrics.registry import SCORES
from leaderboard.policies.page import write_policy_page
from leaderboard.report import export
from leaderboard.report.cache import CACHE_FILE, build_report
from leaderboard.report.charts import task_charts
from leaderboard.report.figures import line_style, rounded
from leaderboard.report.overview import ranking_chart
from leaderboard.report.sentences import findings, unrelated_level_errors
from leaderboard.report.site import file_name, render_pages, write_site
from leaderboard.report.tables import Row, board_views
from leaderboard.running.board import Board, create_baselines, load_board
from road_envs._atomic_io import write_text
from road_envs.data.record import Estimate

POLICIES = Path(__file__).parents[2] / "docs" / "policies"
ENTRIES = ("static_lm", "reader", "online", "broken")


class Online(Reader):
    causal = True

    def estimate(self, record, car):
        found = super().estimate(record, car)
        return Estimate(found.s, found.z, np.full_like(found.z, 0.003))


def tasks():
    return [
        task(
            "held_out",
            test={
                "roads": ["iso_d", "iso_c"],
                "seeds": [11, 12, 13, 14, 15],  # intervals and ranks need five roads of a family
                "length": 40.0,
                "families": ["rough", "smooth"],
            },
        ),
        task(
            "paving",
            title="Paving & <cobbles>",
            board="paper",
            conditions=[{"mode": "ride", "speed_kmh": 14.5}],
            training={"roads": ["belgian_training"], "seeds": [1]},
            test={"roads": ["belgian"], "seeds": [11]},
            trains_on_test_road=True,
            claimed_level_error=0.102,
        ),
        task(
            "blocks",
            board="paper",
            conditions=[{"mode": "ride", "speed_kmh": 14.5}],
            training={"roads": ["bump_asymmetric_training_pp"], "seeds": [1]},
            test={"roads": ["bump_asymmetric"], "seeds": [11]},
            trains_on_test_road=True,
            bumps=True,
        ),
    ]


@cache
def results():
    """Return results of every kind on each task; the learner replaces the network."""
    entries = dict(
        zip(ENTRIES, (Learner(), Reader(), Online(gain=0.7), Broken(how="raises")), strict=True)
    )
    return {
        t.name: tuple(
            run_task(t, {**entries, **create_baselines()}, (1, 2, 3), simulate=fake_drives)
        )
        for t in tasks()
    }


def board():
    return Board(tuple(tasks()), results())


@cache
def site():
    made = board()
    return dict(render_pages(made, build_report(made)))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    built(board(), folder)
    return folder


def built(made, folder):
    """Build the site of a board in a folder and return its index."""
    return write_site(made, build_report(made), folder)


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    with Browser() as made:
        yield made


def text_of(html):
    html = re.sub(r"<(style|script).*?</\1>|<[^>]*>", " ", html, flags=re.S)
    return " ".join(html.split())


# --- the files ------------------------------------------------------------------------------------


def test_every_page_is_well_formed_and_all_its_links_resolve(written):
    for name in site():
        parser = HtmlChecker()
        parser.feed((written / name).read_text())
        assert parser.open == [], name
        assert len(set(parser.ids)) == len(parser.ids)
        for address in parser.addresses:
            if address.startswith("#"):
                assert address[1:] in parser.ids, address
            elif not address.startswith("data:"):
                assert ((written / name).parent / address).is_file(), (name, address)
        assert "@import" not in site()[name] and "http" not in re.sub(
            r"http://www\.w3\.org/2000/svg", "", site()[name]
        )


def test_there_is_a_page_for_each_task_and_each_entry():
    names = {f"tasks/{t.name}.html" for t in tasks()}
    names |= {f"estimators/{name}.html" for name in [*ENTRIES, *create_baselines()]}
    assert set(site()) == names | {"index.html"}


def test_the_index_shows_the_scores_of_every_entry_and_the_reason_of_every_failure():
    text = text_of(site()["index.html"])
    for name in ("static_lm", "reader", "flat", "mean", "unrelated_road", "truth_plus_noise"):
        assert name in text
    assert text.count("estimating test drive 1 of") == 3
    assert "RuntimeError: no idea" in text
    assert "Paving &amp; &lt;cobbles&gt;" in text
    reader = next(r for r in results()["held_out"] if r.estimator == "reader")
    assert f"{np.median(reader.values('nrmse')):.3f}" in text
    assert reader.package_version in text and reader.task_digest[:12] in text
    assert "paper&#39;s claim" in text and "10.2" in text


def test_the_page_of_an_entry_gives_the_provenance_of_every_result():
    text = text_of(site()["estimators/reader.html"])
    for result in (r for found in results().values() for r in found if r.estimator == "reader"):
        assert f"results/{result.task}/reader.json" in text and result.task_digest in text
        assert str(result.environment["numpy"]) in text
    assert "gain 0.9" in text and "training seeds 1, 2, 3" in text


def test_an_entry_of_any_name_has_a_page_of_its_own():
    assert file_name("my entry/../x") == "my_entry_.._x.html"


def test_the_site_is_small(written):
    size = sum(path.stat().st_size for path in written.rglob("*") if path.is_file())
    assert size < 2.1e6


def test_the_site_is_built_from_stored_results(tmp_path, written):
    for found in results().values():
        for result in found:
            save(result, tmp_path)
    path = built(load_board(tasks(), tmp_path), tmp_path)
    assert path == tmp_path / "index.html"
    assert path.read_text() == (written / "index.html").read_text()


def test_pages_of_removed_tasks_and_entries_are_deleted(tmp_path):
    write_text(tmp_path / "tasks" / "old.html", "old")
    write_text(tmp_path / "estimators" / "old.html", "old")
    built(Board(tuple(tasks()[:1]), {"held_out": results()["held_out"]}), tmp_path)
    assert [p.name for p in (tmp_path / "tasks").iterdir()] == ["held_out.html"]
    assert not (tmp_path / "estimators" / "old.html").exists()


def test_an_unchanged_site_is_not_rewritten_and_any_change_rebuilds_it(tmp_path):
    for result in results()["paving"]:
        save(result, tmp_path)
    paving = tasks()[1:2]

    def build():
        made = load_board(paving, tmp_path)
        index = write_site(made, build_report(made, tmp_path), tmp_path)
        return {path: path.stat().st_mtime_ns for path in index.parent.rglob("*.html")}

    first = build()
    assert build() == first  # nothing was written
    page = tmp_path / "tasks" / "paving.html"
    for change in (
        page.unlink,
        lambda: page.write_text("cut short"),
        (tmp_path / CACHE_FILE).unlink,
        lambda: (tmp_path / CACHE_FILE).write_text("{"),
        (tmp_path / "static" / "charts.js").unlink,
        lambda: save(dataclasses.replace(results()["paving"][0], notes=("new",)), tmp_path),
        row_path(tmp_path, "paving", "reader").unlink,
    ):
        change()
        again = build()
        assert again[page] != first[page] and build() == again
        assert "paving" in page.read_text()  # and not the text written above
        first = again


def test_a_cached_report_is_exact_and_a_damaged_cache_is_rebuilt(tmp_path):
    for found in results().values():
        for result in found:
            save(result, tmp_path)
    made = load_board(tasks(), tmp_path)
    fresh = build_report(made, tmp_path)
    write_site(made, fresh, tmp_path)
    first = build_report(made, tmp_path)
    assert dataclasses.replace(first, pages={}) == fresh and first.pages
    cache_file = tmp_path / CACHE_FILE
    text = cache_file.read_text()
    cache_file.write_text(text.replace('"findings": [', '"findings": ["forged", '))
    assert build_report(made, tmp_path) == fresh
    cache_file.write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "leaderboard.report.cache.board_views", lambda board: pytest.fail("built again")
        )
        assert build_report(made, tmp_path) == first
    other = dataclasses.replace(made, entries={("held_out", "reader"): Entry(
        name="reader", reference="x", code="y")})  # fmt: skip
    assert build_report(other).key == first.key  # the entry has no code digest
    fewer = dataclasses.replace(made, tasks=made.tasks[:1])
    assert build_report(fewer).key != first.key


def test_an_interrupted_build_leaves_the_old_index(tmp_path, monkeypatch):
    write_text(tmp_path / "index.html", "old")

    def interrupted(views, out):
        raise KeyboardInterrupt

    monkeypatch.setattr(export, "write_exports", interrupted)
    with pytest.raises(KeyboardInterrupt):
        built(board(), tmp_path)
    assert (tmp_path / "index.html").read_text() == "old"
    assert not list(tmp_path.rglob(".*"))


def test_a_damaged_result_is_a_row_with_its_error_and_other_rows_remain(tmp_path):
    for result in results()["paving"]:
        save(result, tmp_path)
    row_path(tmp_path, "paving", "reader").write_text("{")
    text = text_of(built(load_board(tasks(), tmp_path), tmp_path).read_text())
    assert "its result cannot be read: " in text and "reader.json: damaged" in text
    assert "static_lm" in text


def test_a_site_can_be_built_when_every_entry_failed():
    failed = {
        name: [r for r in found if r.estimator == "broken"] for name, found in results().items()
    }
    made = Board(tuple(tasks()), failed)
    index = dict(render_pages(made, build_report(made)))["index.html"]
    assert text_of(index).count("RuntimeError: no idea") == 3


def test_stale_results_are_marked_stale():
    changed = Board(tuple(dataclasses.replace(t, version=9) for t in tasks()), results())
    text = text_of(dict(render_pages(changed, build_report(changed)))["index.html"])
    assert text.count("stale: the task has changed") == sum(map(len, results().values()))


# --- findings and exports -------------------------------------------------------------------------


def test_the_findings_quote_the_scores():
    views = board_views(board())
    unrelated, new, best, *causal, trained, memory = findings(views)
    rows = [x for v in views if v.board == "new_road" for s in v.sections for x in s.rows]
    assert len(causal) == any(x.causal for x in rows if x.state == "scored")
    assert all("best causal entry" in sentence for sentence in causal)
    levels, r = unrelated_level_errors()
    assert f"{100.0 * np.median(levels):.0f}\u00a0% in the median" in unrelated
    assert np.median(levels) == pytest.approx(0.09, abs=0.02) and abs(r.mean()) < 0.02
    for about_mean, expected in ((True, 0.20), (False, 0.26)):
        with_long_waves, _ = unrelated_level_errors(longest_wave=100.0, about_mean=about_mean)
        assert np.median(with_long_waves) == pytest.approx(expected, abs=0.01)
        assert f"{100.0 * np.median(with_long_waves):.0f}\u00a0%" in unrelated
    assert "altered copy of the paving" in trained and "of 3 trainings" in trained
    assert "uses no measurement" in memory
    assert "better than a flat road" in new  # the fake estimator uses the truth
    assert best.startswith("New road: the best entry is ")


def test_findings_without_results_are_omitted():
    nothing = Board(tuple(tasks()), {t.name: () for t in tasks()})
    assert len(findings(board_views(nothing))) == 1


def test_the_exports_hold_the_same_numbers(written):
    (section,) = board_views(board())[0].sections
    line = next(line for line in section.rows if line.name == "reader")
    rows = list(csv.DictReader(io.StringIO((written / "export/new_road.csv").read_text())))
    mine = [row for row in rows if row["estimator"] == "reader"]
    assert [row["group"] for row in mine] == ["", *section.groups["condition"], "rough", "smooth"]
    assert float(mine[0]["nrmse"]) == pytest.approx(line.values["nrmse"], rel=1e-5)
    assert float(mine[4]["nrmse"]) == pytest.approx(line.groups["smooth"]["nrmse"], rel=1e-5)
    assert {row["causal"] for row in rows if row["estimator"] == "online"} == {"true"}
    data = json.loads((written / "export/paper.json").read_text())
    assert [one["task"] for one in data] == ["paving", "blocks"]
    tex = (written / "export/new_road.tex").read_text()
    assert r"static\_lm & " in tex and line.cells["nrmse"] in tex and tex.count(r"\toprule") == 1
    columns = tex.split(r"\begin{tabular}{")[1].split("}")[0]
    for row in re.findall(r"^[a-z].*&.*\\\\$", tex, flags=re.M):
        if "multicolumn" not in row:
            assert row.count("&") == len(columns) - 1
    assert "@article{ngwangwa" in (written / "export/road_recon.bib").read_text()


# --- data of the scripts --------------------------------------------------------------------------


def chart(page, name):
    found = re.search(rf'id="chart-{name}">(.*?)</script>', site()[page], flags=re.S)
    return json.loads(found[1])


def lines_by_name(figure):
    """Return the lines of a figure; bands and marks share the names of lines."""
    return {x["name"]: x for x in figure["data"] if "lines" in x["mode"] and "fill" not in x}


RIDE = tasks()[0].conditions[0].label


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
    below = [100 * np.mean(reader.values("nrmse") <= x) for x in profile["x"]]
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


def test_a_ranking_of_bad_entries_only_is_drawn_too():
    row = Row("bad", "scored", {}, {"nrmse": 70.0})
    (view,) = [v for v in board_views(board()) if v.board == "new_road"]
    section = dataclasses.replace(view.sections[0], rows=(row,))
    chart = ranking_chart(section, view.definition)
    assert chart["layout"]["xaxis"]["range"] == [0.0, view.definition.scale]
    assert ranking_chart(dataclasses.replace(section, rows=()), view.definition) is None


def test_the_headline_names_best_next_and_certainty():
    text = text_of(site()["index.html"])
    cells = lines_of()["reader"].cells
    assert f"reader is best: its error is {cells['nrmse']}, where" in text
    assert "static_lm follows with" in text and "The first place is not decided" in text


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


def test_the_page_of_an_estimator_has_method_worst_drives_and_cost():
    text = text_of(site()["estimators/static_lm.html"])
    assert "Levenberg-Marquardt" in text and "estimators/networks/static_lm.py" in text
    assert "comes from another package" in text_of(site()["estimators/reader.html"])
    reader = next(r for r in results()["held_out"] if r.estimator == "reader")
    worst = max(drive.scores["nrmse"] for drive in reader.drives)
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
    text = text_of(dict(render_pages(made, build_report(made)))["index.html"])
    assert "without isolation" not in text and "sealed season" in text


def test_a_flat_estimate_can_be_drawn():
    flat = {"flat": next(r for r in results()["paving"] if r.estimator == "flat")}
    (view,) = [v for v in board_views(board()) if v.board == "paper"]
    rows = {row.name: row for row in view.sections[0].rows}
    made = task_charts(tasks()[1], view.definition, flat, rows)["density"]
    (figure,) = made["figures"].values()
    assert set(lines_by_name(figure)["flat"]["y"]) == {None}


def test_rendering_twice_gives_identical_pages():
    made = board()
    again = dict(render_pages(made, build_report(made)))
    assert again == site()


# --- in a browser ---------------------------------------------------------------------------------

ROWS = """[...document.querySelectorAll('#task-%s tbody tr')].filter(r => !r.hidden)
.map(r => r.dataset.name)"""
CELL = 'document.querySelector(\'#task-%s tr[data-name="%s"] td[data-key="%s"]\').textContent'


def lines_of(name="held_out"):
    sections = [s for view in board_views(board()) for s in view.sections]
    return {line.name: line for s in sections if s.task == name for line in s.rows}


def test_no_page_logs_errors_requests_resources_or_overflows(browser, written):
    for name in site():
        for width in (1280, 400):
            browser.open(written / name, width)
            over = browser.value("document.documentElement.scrollWidth - innerWidth")
            assert over <= 0, (name, width)
    assert browser.errors == []
    assert [
        url for url in browser.requests if not url.startswith(("file:", "data:", "about:"))
    ] == []


def test_scripts_format_scores_as_python_does(browser, written):
    browser.open(written / "index.html")
    for name, line in lines_of().items():
        for key in ("nrmse", "r", "level_error", "class_exact", "iri_error", "dsd_distance_db"):
            if not line.message:
                assert browser.value(CELL % ("held_out", name, key)) == line.cells.get(key, "")
    interval = browser.value(CELL % ("held_out", "reader", "interval"))
    assert interval.strip() == lines_of()["reader"].cells["interval"]


def test_a_condition_or_a_family_has_its_own_numbers(browser, written):
    for group in ("ride, 14.5 km/h", "smooth"):
        browser.open(written / "index.html", after=f"#group={group.replace(' ', '%20')}")
        expected = lines_of()["static_lm"].groups[group]
        printed = browser.value(CELL % ("held_out", "static_lm", "nrmse"))
        assert printed == SCORES["nrmse"].format_value(expected["nrmse"])
        assert browser.value(CELL % ("held_out", "static_lm", "rank")) == f"{expected['rank']}"
    assert browser.value("document.getElementById('task-paving').hidden")
    assert browser.value("document.getElementById('paper').hidden")


def test_filters_select_divisions_boards_names_and_baselines(browser, written):
    browser.open(written / "index.html")
    everyone = browser.value(ROWS % "held_out")
    assert everyone[:3] == ["reader", "static_lm", "online"] and everyone[-1] == "broken"
    browser.open(written / "index.html", after="#division=causal&baselines=off")
    assert browser.value(ROWS % "held_out") == ["online", "broken"]
    assert browser.value(CELL % ("held_out", "online", "rank")) == "1"
    browser.open(written / "index.html", after="#find=read")
    assert browser.value(ROWS % "held_out") == ["reader"]
    browser.open(written / "index.html", after="#board=paper")
    assert browser.value("document.getElementById('new_road').hidden")
    assert browser.value("document.getElementById('count').textContent").endswith(" rows")


def test_selected_filters_are_stored_in_the_address(browser, written):
    browser.open(written / "index.html")
    browser.value(
        "(() => { const f = document.getElementById('filters').elements.division;"
        "f.value = 'causal'; f.dispatchEvent(new Event('input', {bubbles: true})); })()"
    )
    assert browser.value("location.hash") == "#division=causal"
    assert "reader" not in browser.value(ROWS % "held_out")


def test_tables_can_be_sorted_with_the_keyboard(browser, written):
    browser.open(written / "index.html")
    head = "document.querySelector('#task-held_out th[data-key=\"r\"]')"
    browser.value(f"{head}.querySelector('button').focus()")
    browser.press("Enter")
    assert browser.value(f"{head}.getAttribute('aria-sort')") == "descending"
    order = browser.value(ROWS % "held_out")
    r = [lines_of()[name].values.get("r") for name in order if not lines_of()[name].message]
    defined = [rounded(x) for x in r if x is not None]  # as the page has them
    assert defined == sorted(defined, reverse=True) and order[-1] == "broken"
    browser.press("Enter")
    assert browser.value(f"{head}.getAttribute('aria-sort')") == "ascending"
    assert browser.value(ROWS % "held_out") != order


def test_all_controls_are_reached_by_tab_with_a_visible_focus(browser, written):
    browser.open(written / "index.html")
    reached = []
    for _ in range(50):
        browser.press("Tab")
        reached.append(
            browser.value("document.activeElement.name || document.activeElement.tagName")
        )
    assert {"board", "division", "group", "find"} <= set(reached)
    assert browser.value("getComputedStyle(document.activeElement).outlineStyle") == "solid"


def test_the_page_of_the_policies_shows_the_kept_comparison(browser, written, tmp_path):
    kept = json.loads((POLICIES / "policies.json").read_text())
    for folder in ("static", "estimators"):
        shutil.copytree(written / folder, tmp_path / folder)
    shutil.copy(tmp_path / "estimators/reader.html", tmp_path / "estimators/fir_ridge.html")
    page = write_policy_page(kept, {}, tmp_path)
    parser = HtmlChecker()
    parser.feed(page.read_text())
    assert parser.open == [] and "estimators/fir_ridge.html" in parser.addresses
    before = len(browser.errors)
    for width in (1280, 400):
        browser.open(page, width)
        assert browser.value("document.documentElement.scrollWidth - innerWidth") <= 0
    assert browser.errors[before:] == []
    points = "document.querySelector('[data-chart=pareto]').data.filter(t => t.mode === 'markers')"
    looks = browser.value(f"{points}.map(t => t.name + ' ' + t.marker.symbol + t.marker.color)")
    rows = [row["policy"] for row in kept["rows"]]
    assert [look.rsplit(" ", 1)[0] for look in looks] == [name for name in rows for _ in range(2)]
    assert len({look.rsplit(" ", 1)[1] for look in looks}) == len(rows)  # no two alike
    filled = browser.value(f"{points}.filter(t => !t.marker.symbol.endsWith('-open')).length")
    assert filled == 2 * sum(row["pareto"] for row in kept["rows"])


def test_the_site_links_to_the_policies_once_they_are_compared(tmp_path):
    made = Board(tuple(tasks()[:1]), {"held_out": results()["held_out"]})
    report = build_report(made)
    assert "policies.html" not in write_site(made, report, tmp_path).read_text()
    write_text(tmp_path / "policies.html", "made meanwhile")
    index = write_site(made, build_report(made, tmp_path), tmp_path)
    assert 'href="policies.html"' in index.read_text()
    assert 'href="../policies.html"' in (tmp_path / "estimators/reader.html").read_text()


RANGE = "document.querySelector('[data-chart=road]')._fullLayout.xaxis.range.map(Number)"
SHOWN = """document.querySelector('[data-chart=road]').data
.filter(t => t.visible !== 'legendonly' && t.showlegend !== false).map(t => t.name)"""


def test_the_road_chart_is_panned_zoomed_and_reset_with_the_keyboard(browser, written, tmp_path):
    browser.open(written / "tasks/held_out.html")
    whole = browser.value(RANGE)
    browser.value("document.querySelector('[data-chart=road]').focus()")
    browser.press("+", "+")
    low, high = browser.value(RANGE)
    assert high - low == pytest.approx((whole[1] - whole[0]) / 4)
    browser.press("ArrowRight")
    assert browser.value(RANGE) == pytest.approx([low + (high - low) / 5, high + (high - low) / 5])
    browser.press("Home")
    assert browser.value(RANGE) == whole
    browser.picture(tmp_path / "road.png")
    assert (tmp_path / "road.png").stat().st_size > 20_000


def test_the_wheel_zooms_a_chart_only_after_a_click(browser, written):
    browser.open(written / "tasks/held_out.html", height=2000)
    whole = browser.value(RANGE)
    box = "document.querySelector('[data-chart=road]').getBoundingClientRect()"
    at = {"x": browser.value(f"{box}.x") + 400, "y": browser.value(f"{box}.y") + 150}
    wheel = {"type": "mouseWheel", "deltaX": 0, "deltaY": -300, **at}
    browser.call("Input.dispatchMouseEvent", **wheel)
    assert browser.value(RANGE) == whole
    for kind in ("mousePressed", "mouseReleased"):
        press = {"type": kind, "button": "left", "clickCount": 1, **at}
        browser.call("Input.dispatchMouseEvent", **press)
    browser.call("Input.dispatchMouseEvent", **wheel)
    low, high = browser.value(RANGE)
    assert high - low < 0.95 * (whole[1] - whole[0])


def test_lines_are_hidden_by_their_digit_and_stay_so_under_another_condition(browser, written):
    browser.open(written / "tasks/held_out.html")
    assert browser.value(SHOWN) == ["truth", "reader", "static_lm"]
    browser.value("document.querySelector('[data-chart=road]').focus()")
    browser.press("2")
    assert browser.value(SHOWN) == ["truth", "static_lm"]
    browser.value(
        "(() => { const f = document.querySelector('[name=condition]'); f.selectedIndex = 1;"
        "f.dispatchEvent(new Event('input', {bubbles: true})); })()"
    )
    assert browser.value(SHOWN) == ["truth", "static_lm"]


def test_a_filter_without_matches_says_so_and_can_be_cleared(browser, written):
    browser.open(written / "index.html", after="#find=nobody")
    nothing = "document.getElementById('nothing')"
    assert not browser.value(f"{nothing}.hidden")
    browser.value("document.getElementById('clear').click()")
    assert browser.value(f"{nothing}.hidden") and browser.value("location.hash") == ""
    assert "reader" in browser.value(ROWS % "held_out")


def test_text_on_both_pages_has_enough_contrast(browser, written):
    """WCAG 2: at least 4.5 for text, and 3 for the lines of charts."""
    try:
        for scheme in ("light", "dark"):
            feature = {"name": "prefers-color-scheme", "value": scheme}
            browser.call("Emulation.setEmulatedMedia", features=[feature])
            browser.open(written / "index.html")
            for names, least in (
                (("ink", "quiet", "series-1", "bad", "stale"), 4.5),
                ([f"line-{k}" for k in range(7)], 3.0),
            ):
                for name in names:
                    ratios = [
                        contrast(css_colour(browser, name), css_colour(browser, back))
                        for back in ("card", "paper")
                    ]
                    assert min(ratios) >= least, (scheme, name, ratios)
            drawn = browser.value("document.querySelector('[data-chart=strip]').layout.font.color")
            assert drawn == css_colour(browser, "ink")
    finally:
        browser.call("Emulation.setEmulatedMedia", features=[])


def css_colour(browser, name):
    style = "getComputedStyle(document.documentElement)"
    return browser.value(f"{style}.getPropertyValue('--{name}').trim()")


def contrast(one, other):
    """Return the contrast ratio of two colours #rrggbb by WCAG 2."""
    lights = sorted(map(luminance, (one, other)))
    return (lights[1] + 0.05) / (lights[0] + 0.05)


def luminance(colour):
    parts = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])
