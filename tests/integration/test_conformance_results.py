"""Estimator cards: identity, storage and display; stale rows after a change of an estimator."""

import dataclasses
import io

import numpy as np
import pytest
from fake_estimators import Reader
from fake_results import runs_of, with_runs
from fakes import fake_drives, task
from in_process import InProcessExecutor
from rich.console import Console

import estimators
from estimators import pretrained_weights
from leaderboard.conformance import results as conformance_results
from leaderboard.conformance.probes import PROBES, count_passed
from leaderboard.conformance.results import (
    CARD,
    EstimatorCard,
    card_identity,
    find_card,
    probe_entries,
)
from leaderboard.entries.entries import (
    entry_refit_per_case,
    make_entry,
    registered_entry,
    resolve_entries,
)
from leaderboard.entries.entry import Entry
from leaderboard.evaluation.evaluate import run_task
from leaderboard.evaluation.tasks import load_task
from leaderboard.report.sentences import build_report
from leaderboard.report.site import _render_pages
from leaderboard.report.terminal import print_tables
from leaderboard.running import board as board_module
from leaderboard.running.board import Board, RunRequest, load_board, run_board
from leaderboard.sandbox import bubblewrap
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits
from road_envs.core.artifacts import NewerFormatError

pytestmark = pytest.mark.skipif(
    bubblewrap.obstacle() is not None, reason=f"needs isolation: {bubblewrap.obstacle()}"
)

LIMITS = Limits(seconds=20.0, memory=1.0)
ENTRIES = {"Valid": 5, "NonDeterministic": 4, "Broken": None}


@pytest.fixture(scope="module")
def probed(tmp_path_factory):
    """A folder with the cards of a valid, a non-deterministic and a failing estimator."""
    out = tmp_path_factory.mktemp("cards")
    with SandboxClient(LIMITS) as sandbox:
        entries = {
            name: resolve_entries([f"bad_estimators:{name}"], sandbox.describe)[0]
            for name in ENTRIES
        }
    lost = Entry(name="lost", reference="nowhere:Lost", failure="cannot be constructed")
    messages = []
    requested = [*entries.values(), make_entry("truth_plus_noise", None), lost]
    assert probe_entries(requested, out, LIMITS, messages.append) == 3
    assert messages == [f"probing {name}" for name in ENTRIES]
    return out, entries


def card_of(probed, name):
    out, entries = probed
    return find_card(out, card_identity(entries[name]))


@pytest.mark.costly
def test_every_entry_gets_one_card(probed):
    out, entries = probed
    valid, random, broken = (card_of(probed, name) for name in ENTRIES)
    assert [p.name for p in valid.probes] == list(PROBES)
    counts = [count_passed(card.probes) for card in (valid, random, broken)]
    assert counts == ["5/5", "4/5", ""]
    assert [p.name for p in random.probes if p.passed is False] == ["repeat"]
    assert broken.failure.endswith("RuntimeError: out of order") and not broken.probes
    assert "60 m of class D" in valid.drive
    assert probe_entries(entries.values(), out, LIMITS) == 1  # the broken one is tried again
    assert len(list((out / "cards").iterdir())) == 3


def test_a_card_is_valid_only_for_its_code_settings_and_probe_version(probed, monkeypatch):
    out, entries = probed

    def found(**changes):
        changed = dataclasses.replace(entries["Valid"], **changes)
        return find_card(out, card_identity(changed)) is not None

    assert not found(code=entries["Valid"].code + "x")
    assert not found(settings={"gain": 2})
    assert not found(name="Dicey")
    with monkeypatch.context() as other_version:
        other_version.setattr(conformance_results, "package_code", lambda: "other weights")
        assert not found()
    assert found()
    monkeypatch.setattr(conformance_results, "CARD", dataclasses.replace(CARD, modules=()))
    assert not found()


@pytest.mark.costly
def test_a_damaged_card_is_ignored_and_made_again(probed):
    out, entries = probed
    valid = entries["Valid"]
    mine = card_identity(valid)
    path = out / "cards" / f"{mine}.json"
    text = path.read_text()
    content, _ = CARD.read(path)
    identity = content.pop("identity")
    other = CARD.to_text({key: x for key, x in content.items() if key != "code"}, identity)
    damaged_texts = (text.replace('"passed": true', '"passed": null', 1), text[:200], "{}", "")
    for damaged in (*damaged_texts, other):
        path.write_text(damaged)
        assert find_card(out, mine) is None
    assert probe_entries([valid], out, LIMITS) == 1 and path.read_text() == text
    path.write_text(text.replace('"format": 1', '"format": 2'))
    with pytest.raises(NewerFormatError):
        CARD.read(path)
    assert find_card(out, mine) is None
    path.write_text(text)


# on the board


def board_of(tmp_path, **options):
    estimators_by_name = {"reader": Reader()}
    entries = [make_entry(name, estimator) for name, estimator in estimators_by_name.items()]
    request = RunRequest([task()], entries, seeds=(1,), **options)
    return run_board(
        request, tmp_path, InProcessExecutor(fake_drives, estimators_by_name)
    ), entries[0]


def with_card(board, probes, name="reader"):
    (result,) = [r for r in board.results["small"] if r.estimator == name]
    identity = card_identity(result)
    card = EstimatorCard(
        identity=identity, estimator=name, settings={}, code="", drive="a road", probes=probes
    )
    return dataclasses.replace(board, cards={identity: card})


@pytest.mark.costly
def test_table_and_pages_show_the_number_of_passed_probes(tmp_path, probed):
    board, _ = board_of(tmp_path)
    marked = with_card(board, card_of(probed, "NonDeterministic").probes)
    for one, mark in ((board, ""), (marked, "4/5")):
        found = build_report(one)
        lines = {line.name: line for line in found.views[0].sections[0].rows}
        assert lines["reader"].cells["probes"] == mark
        assert not lines["flat"].cells["probes"]  # not probed
        stream = io.StringIO()
        print_tables(found, Console(file=stream, width=80))
        assert ("reader 4/5" in stream.getvalue()) == bool(mark)
        texts = dict(_render_pages(one, found))
        assert ("4/5</span>" in texts["index.html"]) == bool(mark)
        assert (
            "<strong>failed</strong>: estimated twice" in texts["estimators/reader.html"]
        ) == bool(mark)


@pytest.mark.parametrize("kind", ["new_road", "field", "class", "paper", "measured"])
def test_every_board_fits_a_terminal_of_80_columns(kind, probed):
    """With the longest name, a probe count, and numbers of many digits."""
    grades = ("S0", "S1", "S2", "S3") if kind == "field" else ("S0",)
    one = task(
        board=kind,
        conditions=[{"mode": "ride", "speed_kmh": 14.5, "grade": grade} for grade in grades],
        trains_on_test_road=kind == "paper",
        bumps=True,
    )
    name = max(estimators.names(), key=len)
    found = run_task(one, {name: Reader(gain=-1.0)}, (1,), simulate=fake_drives)
    runs = {
        run: {k: 1.4 * x for k, x in scores.items()} | {"bump_f1": 1.0}
        for run, scores in runs_of(found[0]).items()
    }
    slow = dataclasses.replace(with_runs(found[0], runs), estimate_ms_per_100m=12345.6)
    board = with_card(
        Board((one,), {"small": (slow,)}), card_of(probed, "NonDeterministic").probes, name
    )
    stream = io.StringIO()
    print_tables(build_report(board), Console(file=stream, width=80))
    text = stream.getvalue()
    assert "…" not in text and max(map(len, text.splitlines())) <= 80
    assert f"{name} 4/5" in text


@pytest.mark.costly
def test_cards_are_made_only_on_request_and_loaded_if_they_exist(tmp_path, monkeypatch):
    requested = []

    def examine(entries, out, limits, report):
        requested.extend(entry.name for entry in entries)

    monkeypatch.setattr(board_module, "probe_entries", examine)
    board_of(tmp_path)
    assert not requested
    board, entry = board_of(tmp_path, probes=True)
    assert "reader" in requested and not board.cards
    identity = card_identity(entry)
    card = EstimatorCard(
        identity=identity,
        estimator="reader",
        settings=entry.settings,
        code=entry.code,
        drive="a road",
    )
    content = dataclasses.asdict(card)
    CARD.write(conformance_results._card_path(tmp_path, identity), content, content.pop("identity"))
    assert load_board([task()], tmp_path).cards == {identity: card}


@pytest.mark.costly
def test_a_card_of_other_imports_is_shown_beside_no_row(tmp_path):
    """What an entry imports from beside it, or has installed, is a part of what was probed."""
    imports = ("numpy 2.0", "zz_helper 1.0 0123456789abcdef")
    mine = dataclasses.replace(make_entry("reader", Reader()), imports=imports)
    request = RunRequest([task()], [mine], seeds=(1,))
    run_board(request, tmp_path, InProcessExecutor(fake_drives, {"reader": Reader()}))

    def write_card(entry):
        identity = card_identity(entry)
        about = dict(estimator="reader", settings=entry.settings, code=entry.code, drive="a road")
        content = dataclasses.asdict(EstimatorCard(identity=identity, **about))
        path = conformance_results._card_path(tmp_path, identity)
        CARD.write(path, content, content.pop("identity"))
        board = load_board([task()], tmp_path)
        (row,) = (x for x in board.results["small"] if x.estimator == "reader")
        return board.card(row) is not None

    assert not write_card(dataclasses.replace(mine, imports=()))
    for k, other in enumerate(("numpy 2.1", "zz_helper 1.0 fedcba9876543210")):
        changed = [other if at == k else x for at, x in enumerate(imports)]
        assert not write_card(dataclasses.replace(mine, imports=tuple(changed)))
    assert write_card(mine)


# stale rows


@pytest.mark.costly
def test_a_row_of_other_code_weights_or_settings_is_stale(tmp_path):
    board, entry = board_of(tmp_path)
    (t,) = board.tasks
    assert not board.stale(t)
    at = "small", "reader"
    for now, why in (
        (dataclasses.replace(entry, code="other"), "its code or its weights have changed"),
        (
            dataclasses.replace(entry, settings={"gain": 0.1}),
            "made with other settings",
        ),
    ):
        changed = dataclasses.replace(board, entries={**board.entries, at: now})
        assert [(r.estimator, reason) for r, reason in changed.stale(t)] == [("reader", why)]
        assert "reader" not in [r.estimator for r in changed.scored(t)]
        state = dict(_render_pages(changed, build_report(changed)))["estimators/reader.html"]
        assert why in state
    assert not Board(board.tasks, board.results).stale(t)  # no current entries to compare with


@pytest.mark.costly
def test_a_row_is_stale_after_a_change_of_shipped_weights(tmp_path, monkeypatch):
    """Changing one weight of a shipped estimator makes its row stale."""
    row = registered_entry("fir_ridge", each_case=False)
    request = RunRequest([task()], [row], seeds=(1,))
    board = run_board(request, tmp_path, InProcessExecutor(fake_drives))
    assert "fir_ridge" in [r.estimator for r in board.scored(board.tasks[0])]
    (bank,) = pretrained_weights.load_pretrained("fir_ridge").values()
    changed = np.array(bank)
    changed.flat[0] += 1
    monkeypatch.setattr(pretrained_weights, "load_pretrained", lambda name: {"bank": changed})
    later = load_board([task()], tmp_path)
    assert {r.estimator: why for r, why in later.stale(task())} == {
        "fir_ridge": "its code or its weights have changed"
    }
    assert registered_entry("no_such", each_case=False) is None


def test_on_tasks_trained_per_case_a_quickly_fitted_estimator_drops_its_weights():
    fir, tcn, wiener = (
        registered_entry(name, each_case=True) for name in ("fir_ridge", "tcn", "wiener")
    )
    assert fir.settings["shipped"] is False and "+" not in fir.code  # no weights yet
    assert (
        tcn == registered_entry("tcn", each_case=False) and "+" in tcn.code
    )  # it takes half an hour
    assert wiener == registered_entry("wiener", each_case=False)
    plain = registered_entry("fir_ridge", each_case=False)
    assert plain.settings["shipped"] is True and "+" in plain.code
    paper, new = load_task("paper_5"), load_task("new_road")
    found = {row.task.name: row.entry for row in RunRequest([paper, new], [plain]).rows()[:]
             if row.entry.name == "fir_ridge"}  # fmt: skip
    assert found == {"paper_5": fir, "new_road": plain}
    failed = dataclasses.replace(plain, failure="cannot be constructed")
    assert entry_refit_per_case(failed) == failed
