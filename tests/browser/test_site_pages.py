"""The pages and files of a site: what they show, when they are written again, what damage does."""

import csv
import dataclasses
import io
import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from example_site import ENTRIES, board, built, results, site, tasks, text_of
from fake_results import run_scores, runs_of
from html_checker import HtmlChecker

from leaderboard.evaluation.store import row_path, save
from leaderboard.metrics.baselines import ALL_BASELINES
from leaderboard.policies.page import _render_page
from leaderboard.report import export
from leaderboard.report.rendering import write_pending
from leaderboard.report.sentences import build_report, findings, unrelated_level_errors
from leaderboard.report.site import _render_pages, file_name
from leaderboard.report.tables import Row, board_views
from leaderboard.running.board import Board, load_board
from road_envs.core.atomic_io import write_text


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
    names |= {f"estimators/{name}.html" for name in [*ENTRIES, *ALL_BASELINES]}
    assert set(site()) == names | {"index.html"}


def test_the_index_shows_the_scores_of_every_entry_and_the_reason_of_every_failure():
    text = text_of(site()["index.html"])
    for name in ("static_lm", "reader", "flat", "mean", "unrelated_road", "truth_plus_noise"):
        assert name in text
    assert text.count("estimating test drive 1 of") == 3
    assert "RuntimeError: no idea" in text
    assert "Paving &amp; &lt;cobbles&gt;" in text
    reader = next(r for r in results()["held_out"] if r.estimator == "reader")
    assert f"{np.median(run_scores(reader, 'nrmse')):.3f}" in text
    assert reader.package_version in text and reader.task_digest[:12] in text
    assert "paper&#39;s claim" in text and "10.2" in text


def test_the_page_of_an_entry_gives_the_provenance_of_every_result():
    text = text_of(site()["estimators/reader.html"])
    for result in (r for found in results().values() for r in found if r.estimator == "reader"):
        assert f"results/{result.task}/reader.json" in text and result.task_digest in text
        assert str(result.environment["numpy"]) in text
    assert "gain 0.9" in text and "training seeds 1, 2, 3" in text
    assert "limits unknown" in text
    rows = {name: [dataclasses.replace(r, limits=(60.0, 4.0)) for r in results()[name]]
            for name in results()}  # fmt: skip
    made = Board(tuple(tasks()), rows)
    page = dict(_render_pages(made, build_report(made)))["estimators/reader.html"]
    assert "limits 60 s, 4 GiB" in text_of(page)


def test_the_page_of_two_programs_of_one_name_says_so():
    rows = {
        name: [dataclasses.replace(r, code=r.code + name[:4]) for r in found]
        for name, found in results().items()
    }
    made = Board(tuple(tasks()), rows)
    page = text_of(dict(_render_pages(made, build_report(made)))["estimators/reader.html"])
    said = f"These rows are of {len(rows)} programs or settings of that name"
    assert said in page and all(r.code in page for r in rows["held_out"] if r.estimator == "reader")
    assert "programs or settings of that name" not in text_of(site()["estimators/reader.html"])


def test_an_entry_of_any_name_has_a_page_of_its_own():
    assert file_name("my entry/../x") == "my_entry_.._x.html"


def test_the_site_is_small(written):
    size = sum(path.stat().st_size for path in written.rglob("*") if path.is_file())
    assert size < 2.1e6


@pytest.mark.costly
def test_the_site_is_built_from_stored_results(tmp_path, written):
    for found in results().values():
        for result in found:
            save(result, tmp_path)
    path = built(load_board(tasks(), tmp_path), tmp_path)
    assert path == tmp_path / "index.html"
    assert path.read_text() == (written / "index.html").read_text()


POLICIES = json.loads((Path(__file__).parents[2] / "docs/policies/benchmark.json").read_text())


def test_board_and_policies_of_one_folder_link_to_each_other_whichever_ends_first(tmp_path):
    index, policies = tmp_path / "index.html", tmp_path / "policies.html"
    assert 'href="index.html"' not in _render_page(POLICIES)
    write_pending(index, "Estimators", "leaderboard --out here")
    write_pending(policies, "Switching policies", "policies --out here")
    assert "road-recon leaderboard --out here" in text_of(index.read_text())
    parser = HtmlChecker()
    parser.feed(index.read_text())
    assert parser.open == [] and not [x for x in parser.addresses if x.endswith(".html")]
    first = _render_page(POLICIES, board=index.exists())
    assert 'href="index.html"' in first
    last = built(Board(tuple(tasks()[:1]), {"held_out": results()["held_out"]}), tmp_path)
    assert 'href="policies.html"' in last.read_text()
    write_pending(index, "Estimators", "leaderboard --out here")
    assert "reader" in index.read_text()


def test_pages_of_removed_tasks_and_entries_are_deleted(tmp_path):
    write_text(tmp_path / "tasks" / "old.html", "old")
    write_text(tmp_path / "estimators" / "old.html", "old")
    built(Board(tuple(tasks()[:1]), {"held_out": results()["held_out"]}), tmp_path)
    assert [p.name for p in (tmp_path / "tasks").iterdir()] == ["held_out.html"]
    assert not (tmp_path / "estimators" / "old.html").exists()


def test_an_interrupted_build_leaves_the_old_index(tmp_path, monkeypatch):
    write_text(tmp_path / "index.html", "old")

    def interrupted(board, views, out):
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
    index = dict(_render_pages(made, build_report(made)))["index.html"]
    assert text_of(index).count("RuntimeError: no idea") == 3


def test_stale_results_are_marked_stale():
    changed = Board(tuple(dataclasses.replace(t, version=9) for t in tasks()), results())
    text = text_of(dict(_render_pages(changed, build_report(changed)))["index.html"])
    assert text.count("stale: the task has changed") == sum(map(len, results().values()))


# --- findings and exports -------------------------------------------------------------------------


def test_the_findings_quote_the_scores():
    views = board_views(board())
    unrelated, best, others, certainty, trained, memory = findings(views)
    levels, r = unrelated_level_errors()
    assert f"{100.0 * np.median(levels):.0f}\u00a0% in the median" in unrelated
    assert np.median(levels) == pytest.approx(0.09, abs=0.02) and abs(r.mean()) < 0.02
    for about_mean, expected in ((True, 0.20), (False, 0.26)):
        with_long_waves, _ = unrelated_level_errors(longest_wave=100.0, about_mean=about_mean)
        assert np.median(with_long_waves) == pytest.approx(expected, abs=0.01)
        assert f"{100.0 * np.median(with_long_waves):.0f}\u00a0%" in unrelated
    assert "altered copy of the paving" in trained and "of 3 trainings" in trained
    assert "uses no measurement" in memory
    assert "better than a flat road" in others  # the fake estimator uses the truth
    assert best.startswith("held_out: ") and "is best: its error is" in best
    assert "first place" in certainty


def test_findings_without_results_are_omitted():
    nothing = Board(tuple(tasks()), {t.name: () for t in tasks()})
    assert len(findings(board_views(nothing))) == 1


def test_texts_of_entries_are_no_commands_of_latex_and_no_formulas_of_a_spreadsheet():
    (view, *_) = board_views(board())
    (section,) = view.sections
    hostile = Row("=1+1", "failed", message="=HYPERLINK(1) \\input{/etc/passwd} ^^5cinput a~b")
    task = dataclasses.replace(section.task, title="A title\n\\input{x}")
    shown = dataclasses.replace(section, rows=(hostile,), task=task)
    view = dataclasses.replace(view, sections=(shown,))
    tex = export._as_latex(view, shown)
    assert r"\textbackslash input\{" in tex and "^^" not in tex
    commands = [line for line in tex.splitlines() if not line.startswith("%")]
    assert r"\input" not in "".join(commands)
    (row,) = csv.DictReader(io.StringIO(export._as_csv(view)))
    assert row["estimator"] == "'=1+1" and row["text"].startswith("'=HYPERLINK")


def test_every_score_of_every_run_is_exported(written):
    table = pd.read_parquet(written / "export/new_road.parquet")
    (result,) = [r for r in results()["held_out"] if r.estimator == "reader"]
    mine = table[table["estimator"] == "reader"]
    runs = runs_of(result)
    assert len(mine) == sum(map(len, runs.values()))
    (condition, drive, *_), scores = list(runs.items())[-1]
    at = mine[(mine["drive"] == drive) & (mine["condition"] == condition)]
    assert dict(zip(at["score"], at["value"], strict=True)) == scores


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
