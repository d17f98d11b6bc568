"""The site in a browser: numbers, filters, keyboard, contrast."""

import dataclasses
import json

import numpy as np
import pytest
from example_site import POLICIES, lines_of, results, site, tasks
from html_checker import HtmlChecker

from leaderboard.evaluation.boards import BoardDefinition
from leaderboard.metrics.registry import SCORES
from leaderboard.policies.page import _shown_policies, write_page
from leaderboard.report.figures import rounded
from leaderboard.report.sentences import build_report
from leaderboard.report.site import write_site
from leaderboard.running.board import Board
from road_envs.core.atomic_io import write_text

pytestmark = pytest.mark.costly

ROWS = """[...document.querySelectorAll('#task-%s tbody tr')].filter(r => !r.hidden)
.map(r => r.dataset.name)"""
CELL = 'document.querySelector(\'#task-%s tr[data-name="%s"] td[data-key="%s"]\').textContent'


def test_no_page_logs_errors_requests_resources_or_overflows(browser, written):
    for name in site():
        browser.open(written / name, 400)
        for width in (400, 1280):
            browser.resize(width)
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


def test_a_board_of_causal_entries_alone_orders_them_before_others(browser, tmp_path):
    board = {**vars(tasks()[0].board_definition), "divisions": ("causal",)}
    task = dataclasses.replace(tasks()[0], board=BoardDefinition(**board))
    for number in (5, 2):  # with ranks, and with too few roads
        driven = task.with_test_drives(number)
        rows = [
            dataclasses.replace(
                r, task_digest=driven.digest, scores=r.scores[r.scores["drive"] < k]
            )
            for r, k in ((r, number) for r in results()["held_out"] if r.failure is None)
        ]
        made = Board((driven,), {"held_out": rows})
        write_site(made, build_report(made), tmp_path)
        browser.open(tmp_path / "index.html")
        shown = browser.value(ROWS % "held_out")
        assert shown[:3] == ["online", "reader", "static_lm"]


def test_settings_without_a_field_on_the_page_change_nothing(browser, written):
    browser.open(written / "tasks/held_out.html", after="#find=read&baselines=off&division=causal")
    rows = "[...document.querySelectorAll('table[data-source] tbody tr')]"
    shown = browser.value(f"{rows}.filter(r => !r.hidden).map(r => r.dataset.name)")
    assert "online" in shown and "flat" in shown and "reader" not in shown


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


def test_the_page_of_the_policies_shows_the_kept_comparison(browser, tmp_path):
    kept = json.loads((POLICIES / "benchmark.json").read_text())
    page = write_page(kept, {}, tmp_path)
    parser = HtmlChecker()
    parser.feed(page.read_text())
    assert parser.open == []
    before = len(browser.errors)
    for width in (1280, 400):
        browser.open(page, width)
        assert browser.value("document.documentElement.scrollWidth - innerWidth") <= 0
    assert browser.errors[before:] == []
    drawn = browser.value(
        "document.querySelector('[data-chart=scores]').data.map(t => t.name + ' ' + t.y.length)"
    )
    number = len(kept["drives"])
    assert drawn == [f"{name} {number}" for name in _shown_policies(kept)]


def test_the_site_links_to_the_policies_once_they_are_compared(tmp_path):
    made = Board(tuple(tasks()[:1]), {"held_out": results()["held_out"]})
    report = build_report(made)
    assert "policies.html" not in write_site(made, report, tmp_path).read_text()
    write_text(tmp_path / "policies.html", "made meanwhile")
    index = write_site(made, build_report(made), tmp_path)
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
