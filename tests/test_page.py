"""The page holds what was stored, needs nothing from elsewhere, and a browser takes it."""

import dataclasses
import os
import re
import shutil
import subprocess
from functools import cache
from html.parser import HTMLParser

import numpy as np
import pytest
from fakes import Broken, Learner, Reader, fake_drives, task

from leaderboard import figures
from leaderboard.board import Board, load_board, sentinels
from leaderboard.evaluate import run_task
from leaderboard.findings import findings, unrelated_levels
from leaderboard.page import claims, interval_bar, render, write_page
from leaderboard.store import path_of, save
from leaderboard.view import Line
from road_envs.files import write_text

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
VOID = {"meta", "link", "br", "hr", "img", "input"}


def tasks():
    return [
        task("held_out"),
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
    ]


@cache
def results():
    """One estimator of each fate on each task; the learner stands in for the network."""
    entries = {"static_lm": Learner(), "reader": Reader(), "broken": Broken(how="raises")}
    return {
        t.name: tuple(run_task(t, {**entries, **sentinels()}, (1, 2, 3), drive=fake_drives))
        for t in tasks()
    }


@cache
def page():
    return render(Board(tuple(tasks()), results()))


def text_of(html):
    return " ".join(re.sub(r"<style.*?</style>|<[^>]*>", " ", html, flags=re.S).split())


class Nesting(HTMLParser):
    """Fails at a tag that is closed by another; collects ids and addresses."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.addresses = [], [], []

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.ids += [given["id"]] if "id" in given else []
        self.addresses += [given[k] for k in ("href", "src", "xlink:href") if k in given]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_well_formed_and_needs_nothing_from_elsewhere():
    parser = Nesting()
    parser.feed(page())
    assert parser.open == []
    assert len(set(parser.ids)) == len(parser.ids)
    inside = {"#" + name for name in parser.ids}
    for address in parser.addresses:
        assert address in inside or address.startswith("data:"), address
    assert "@import" not in page() and "<script" not in page()
    assert len(page()) < 5e6


def test_the_page_shows_every_entry_with_its_numbers_and_every_failure_with_its_reason():
    text = text_of(page())
    for name in ("static_lm", "reader", "flat", "mean", "unrelated_road", "truth_plus_noise"):
        assert name in text
    assert text.count("estimating test drive 1 of") == 2
    assert "RuntimeError: no idea" in text
    assert "Paving &amp; &lt;cobbles&gt;" in text
    reader = next(r for r in results()["held_out"] if r.estimator == "reader")
    assert f"{np.median(reader.values('nrmse')):.2f}" in text
    assert reader.package_version in text and reader.task_digest[:12] in text


def test_claims_stand_beside_measurements():
    found = claims(Board(tuple(tasks()), results()))
    ((name, title, cells),) = found.rows
    assert (name, title, cells[0]) == ("paving", "Paving & <cobbles>", "10.2")
    assert found.names[0] == "static_lm" and len(cells) == 1 + 3 * len(found.names)
    assert claims(Board(tuple(tasks()[:1]), results())) is None


def test_each_drawing_has_the_truth_solid_the_estimate_dashed_and_equation_12_on_top():
    trace = next(r for r in results()["paving"] if r.estimator == "reader").traces[0]
    errors = {"level_error_left": 0.123, "level_error_right": 0.456, "level_error": 0.3}
    trace = dataclasses.replace(trace, scores=errors)
    assert "Right wheel path, eq. 12: 45.6 %" in figures.overlay(trace, side=1)
    svg = figures.overlay(trace, side=0)
    assert "Left wheel path, eq. 12: 12.3 %" in svg
    lines = re.findall(r'<path d="[^"]*" clip-path[^>]*style="([^"]*)"', svg)
    assert ["stroke-dasharray" in style for style in lines] == [False, True]
    assert "currentColor" in lines[0] and "var(--series-1)" in lines[1]


def test_densities_are_drawn_over_all_classes():
    traces = {r.estimator: r.traces[0] for r in results()["paving"] if r.traces}
    svg = figures.spectra({name: traces[name] for name in ("static_lm", "reader")})
    letters = re.findall(r">([A-H])</text>", svg)
    assert letters == list("ABCDEFGH")
    assert ">truth</text>" in svg and ">reader</text>" in svg
    assert not re.search("#0[1-3]{5}|#1a000", svg)


def test_a_flat_estimate_can_be_drawn():
    trace = next(r for r in results()["paving"] if r.estimator == "flat").traces[0]
    assert figures.overlay(trace, 1).startswith("<svg")
    assert figures.spectra({"flat": trace}).startswith("<svg")


def test_drawings_do_not_change_from_one_run_to_the_next():
    trace = results()["paving"][0].traces[0]
    assert figures.overlay(trace, 0) == figures.overlay(trace, 0)


def test_an_interval_that_leaves_the_axis_ends_with_it():
    line = Line("x", "scored", values={"low": 1.0, "nrmse": 3.0, "high": 9.0})
    assert interval_bar(line) == {"low": 50.0, "mean": 100.0, "width": 50.0, "one": 50.0}
    assert interval_bar(Line("x", "failed")) is None


def test_the_findings_are_made_from_the_numbers():
    unrelated, trained, memory, new, best = findings(Board(tuple(tasks()), results()))
    levels, r = unrelated_levels()
    assert f"{100.0 * np.median(levels):.0f}\u00a0% in the median" in unrelated
    assert np.median(levels) == pytest.approx(0.09, abs=0.02) and abs(r.mean()) < 0.02
    assert "altered copy of the test road" in trained and "of 3 trainings" in trained
    assert "measures nothing" in memory
    assert "better than a flat road" in new  # the stand-in reads the truth
    assert best.startswith("The best there is ")


def test_findings_without_measurements_are_left_out():
    assert len(findings(Board(tuple(tasks()), {"held_out": (), "paving": ()}))) == 1


def test_a_board_of_failures_still_makes_a_page():
    failed = {
        name: [r for r in found if r.estimator == "broken"] for name, found in results().items()
    }
    assert text_of(render(Board(tuple(tasks()), failed))).count("RuntimeError: no idea") == 2


def test_the_page_is_built_from_what_is_stored(tmp_path):
    for found in results().values():
        for result in found:
            save(result, tmp_path)
    path = write_page(load_board(tasks(), tmp_path), tmp_path)
    assert path == tmp_path / "index.html" and text_of(path.read_text()) == text_of(page())


def test_a_damaged_result_is_a_row_that_says_so_beside_the_others(tmp_path):
    for result in results()["paving"]:
        save(result, tmp_path)
    path_of(tmp_path, "paving", "reader").write_text("{")
    text = text_of(write_page(load_board(tasks(), tmp_path), tmp_path).read_text())
    assert "its result cannot be read: " in text and "reader.json: damaged" in text
    assert "static_lm" in text


def test_stale_results_are_shown_as_such():
    changed = tuple(dataclasses.replace(t, version=2) for t in tasks())
    text = text_of(render(Board(changed, results())))
    assert text.count("stale: the task has changed") == sum(map(len, results().values()))


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
@pytest.mark.parametrize("width", [1280, 400])
def test_a_browser_renders_the_page_without_complaint(tmp_path, width):
    write_text(tmp_path / "index.html", page())
    picture = tmp_path / "page.png"
    done = subprocess.run(
        [
            CHROMIUM,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-logging=stderr",
            f"--user-data-dir={tmp_path / 'profile'}",
            f"--screenshot={picture}",
            f"--window-size={width},1600",
            (tmp_path / "index.html").as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=60,
        env={**os.environ, "HOME": str(tmp_path)},
    )
    assert done.returncode == 0, done.stderr
    assert "CONSOLE" not in done.stderr, done.stderr
    from matplotlib.image import imread

    pixels = imread(picture)
    assert pixels.shape[1] == width and pixels[..., :3].std() > 0.05
