"""The verdict beforehand: an honest estimator gets through, each vice is named in one sentence."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.commands.check import summarize
from leaderboard.conformance import checks
from leaderboard.conformance.checks import UNINTENDED_ERRORS, check_drives, check_entry
from leaderboard.conformance.probes import PROBES, CheckResult
from leaderboard.evaluation.entries import resolve_entries
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits

LIMITS = Limits(seconds=20.0, memory=1.0)
DAMAGED = ("gaps", "clipped", "field", "short", "mode")
NAMES = ("contract", "runs", *DAMAGED, *PROBES, "time", "memory")


@pytest.fixture(scope="module")
def sandbox():
    with SandboxClient(LIMITS) as sandbox:
        yield sandbox


def verdicts(sandbox, name):
    (entry,) = resolve_entries(
        [name if ":" in name or name.islower() else f"bad_estimators:{name}"], sandbox
    )
    return {one.name: one for one in check_entry(entry, sandbox, LIMITS)}


def failed(found):
    return {name for name, one in found.items() if one.passed is False}


def test_an_honest_estimator_is_ready_and_every_check_says_a_sentence(sandbox):
    found = verdicts(sandbox, "Valid")
    assert tuple(found) == NAMES and not failed(found)
    assert found["future"].passed is None  # it claims nothing
    for one in found.values():
        assert one.message and "\n" not in one.message


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("NotCausal", {"future"}),
        ("NonDeterministic", {"repeat"}),
        ("PassesMissingSamples", {"gaps", "field"}),
    ],
)
def test_each_vice_fails_its_check_and_no_other(sandbox, name, wanted):
    assert failed(verdicts(sandbox, name)) == wanted


def test_a_refusal_in_a_sentence_is_noted_and_an_accident_is_a_failure(sandbox):
    found = verdicts(sandbox, "RefusesSome")
    assert failed(found) == {"short"} and "IndexError" in UNINTENDED_ERRORS
    assert found["mode"].passed is None
    assert found["mode"].message.endswith(
        "refused: ValueError: struts of this kind were never seen"
    )
    assert "failed: IndexError: index" in found["short"].message
    assert found["gaps"].passed  # the others are judged one by one


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("NotFrozen", "its settings must not change: @dataclass(frozen=True)"),
        (
            "IncompleteTrainable",
            "it has fit, but no weights and no with_weights: it would never be trained",
        ),
        ("WrongSignature", "it cannot be called as estimate(record, car)"),
        ("NegativeLag", "its lag must be metres behind the front axle, got -1.0"),
        ("Nowhere", "AttributeError: module 'bad_estimators' has no attribute 'Nowhere'"),
        ("no.such.module:Thing", "ModuleNotFoundError: No module named 'no'"),
    ],
)
def test_what_cannot_be_made_fails_its_contract_and_is_asked_nothing(sandbox, name, sentence):
    found = verdicts(sandbox, name)
    assert list(found) == ["contract"] and found["contract"].passed is False
    assert sentence in found["contract"].message


def test_what_does_not_run_is_asked_no_more(sandbox):
    found = verdicts(sandbox, "Broken")
    assert list(found) == ["contract", "runs"]
    assert found["runs"].message.endswith("seed 1: RuntimeError: out of order")


def test_time_is_reckoned_for_a_whole_condition_of_the_board(sandbox):
    """0.1 s for 60 m are 30 s for the 18 km of a condition."""
    found = verdicts(sandbox, "Slow")
    assert failed(found) == {"time"}  # 20 s are allowed here
    reckoned = float(found["time"].message.split("about ")[1].split(" s ")[0])
    assert 30.0 < reckoned < 60.0


def test_the_samples_records_are_what_they_are_called():
    given = check_drives()
    lost = np.isnan(given.damaged["gaps"].a).mean(axis=1)
    assert ((0.01 < lost) & (lost < 0.03)).all()
    clipped = given.damaged["clipped"].a
    assert np.abs(clipped).max() == pytest.approx(0.5 * np.abs(given.record.a).max())
    assert np.isnan(given.damaged["field"].a).any()
    assert given.damaged["short"].length == checks.SHORT
    assert not np.array_equal(given.damaged["mode"].damper_high[0], given.record.damper_high[0])
    assert given.training[0][0].length == given.record.length == 60.0


def test_a_record_of_the_field_car_can_be_probed(sandbox):
    """It has samples that are lost, which are no numbers."""
    asked = checks.perturbed_records(
        check_drives().damaged["field"], checks.load_instruments("paper")
    )
    late = asked["future"]
    assert np.isfinite(late.a).mean() > 0.9 and not np.array_equal(late.a, asked["asked"].a)


def test_the_command_ends_with_1_on_a_failure_and_tells_it_to_programs(monkeypatch, tmp_path):
    (tmp_path / "mine_here.py").write_text(
        "from bad_estimators import Valid\n\nclass Mine(Valid):\n    pass\n"
    )
    monkeypatch.chdir(tmp_path)
    good = CliRunner().invoke(app, ["check-estimator", "mine_here:Mine"])
    assert good.exit_code == 0 and "Mine: ready for a board" in good.stdout, good.output
    bad = CliRunner().invoke(app, ["check-estimator", "bad_estimators:NotCausal", "--json"])
    told = json.loads(bad.stdout)
    assert bad.exit_code == 1 and told["passed"] is False and told["estimator"] == "NotCausal"
    assert [one["name"] for one in told["checks"] if one["passed"] is False] == ["future"]
    lost = CliRunner().invoke(app, ["check-estimator", "flatt"])
    assert "unknown estimator 'flatt'" in str(lost.exception)


def test_a_failed_probe_keeps_nobody_off_the_board_and_another_failure_does():
    good, probe, gaps = (
        CheckResult(name=name, passed=passed, message="so")
        for name, passed in (("runs", True), ("sign", False), ("gaps", False))
    )
    assert summarize([good]) == "ready for a board"
    assert summarize([good, probe]).endswith("where its mark will say that it failed sign")
    assert summarize([good, probe, gaps]) == "not ready for a board: sign and gaps"
