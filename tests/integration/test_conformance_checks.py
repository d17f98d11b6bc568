"""Conformance checks: a valid estimator passes, each defect fails its own check."""

import json
import re
import shutil

import bad_estimators
import numpy as np
import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.commands.check import _checks_output
from leaderboard.conformance import checks
from leaderboard.conformance.checks import UNINTENDED_ERRORS, check_drives, check_entry
from leaderboard.conformance.probes import PROBES, CheckResult
from leaderboard.entries.entries import resolve_entries
from leaderboard.sandbox import bubblewrap
from leaderboard.sandbox.client import SandboxClient
from leaderboard.sandbox.limits import Limits

pytestmark = pytest.mark.skipif(
    bubblewrap.obstacle() is not None, reason=f"needs isolation: {bubblewrap.obstacle()}"
)

LIMITS = Limits(seconds=20.0, memory=1.0)
DAMAGED = ("gaps", "clipped", "field", "short", "mode")
NAMES = ("contract", "runs", *DAMAGED, *PROBES, "time", "memory")


@pytest.fixture(scope="module")
def sandbox():
    with SandboxClient(LIMITS) as sandbox:
        yield sandbox


def check_results(sandbox, name):
    (entry,) = resolve_entries(
        [name if ":" in name or name.islower() else f"bad_estimators:{name}"], sandbox.describe
    )
    return {result.name: result for result in check_entry(entry, sandbox, LIMITS)}


def failed(results):
    return {name for name, result in results.items() if result.passed is False}


@pytest.mark.costly
def test_a_valid_estimator_passes_and_every_check_has_one_sentence(sandbox):
    results = check_results(sandbox, "Valid")
    assert tuple(results) == NAMES and not failed(results)
    assert results["future"].passed is None  # it does not claim causality
    for result in results.values():
        assert result.message and "\n" not in result.message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("NotCausal", {"future"}),
        ("NonDeterministic", {"repeat"}),
        ("PassesMissingSamples", {"gaps", "field"}),
    ],
)
def test_each_defect_fails_only_its_own_checks(sandbox, name, expected):
    assert failed(check_results(sandbox, name)) == expected


@pytest.mark.processes
def test_heights_in_millimetres_are_refused_with_a_hint(sandbox):
    results = check_results(sandbox, "InMillimetres")
    assert failed(results) == {"runs"} and tuple(results) == NAMES
    assert results["runs"].message.endswith(
        ", a flat estimate has 1; heights must be in metres, upwards: are these in millimetres?"
    )


@pytest.mark.processes
def test_a_deliberate_refusal_is_accepted_and_an_unintended_error_fails(sandbox):
    results = check_results(sandbox, "RefusesSome")
    assert failed(results) == {"short"} and "IndexError" in UNINTENDED_ERRORS
    assert results["mode"].passed is None
    assert results["mode"].message.endswith(
        "refused: ValueError: struts of this kind were never seen"
    )
    assert "failed: IndexError: index" in results["short"].message
    assert results["gaps"].passed  # the records are then run one by one


@pytest.mark.costly
@pytest.mark.parametrize(
    ("name", "passed", "sentence"),
    [
        ("BreaksWhenCalibrated", False, "failed: calibrating to the vehicle of .*: KeyError: 'd"),
        ("RefusesCalibration", None, "refused: calibrating .*Error: 60 m of road are too .*True"),
    ],
)
def test_what_can_be_calibrated_is_calibrated_once(sandbox, name, passed, sentence):
    results = check_results(sandbox, name)
    assert results["field"].passed is passed and re.search(sentence, results["field"].message)
    assert failed(results) == ({"field"} if passed is False else set())


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("NotFrozen", "its settings are mutable: use @dataclass(frozen=True)"),
        (
            "IncompleteTrainable",
            "it has fit but no weights and no with_weights: a trainable needs both",
        ),
        ("WrongSignature", "it cannot be called as estimate(record, car)"),
        (
            "NegativeLag",
            "its lag must be a distance >= 0 in metres behind the front axle, got -1.0",
        ),
        (
            "ArraySetting",
            "JSON turns its setting taps from array([1., 1., 1.]) into '[1. 1. 1.]': annotate",
        ),
        ("InfiniteSetting", "Out of range float values are not JSON compliant"),
        ("TabSetting", "a text in its settings is not one printable line of up to 300"),
        ("Nowhere", "AttributeError: module 'bad_estimators' has no attribute 'Nowhere'"),
        ("no.such.module:Thing", "cannot be constructed: there is no module 'no'"),
    ],
)
def test_an_estimator_that_cannot_be_constructed_fails_only_the_contract(sandbox, name, sentence):
    results = check_results(sandbox, name)
    assert list(results) == ["contract"] and results["contract"].passed is False
    assert sentence in results["contract"].message


@pytest.mark.costly
def test_no_further_check_runs_after_an_estimator_fails_to_run(sandbox):
    results = check_results(sandbox, "Broken")
    assert list(results) == ["contract", "runs"]
    assert results["runs"].message.endswith("seed 1: RuntimeError: out of order")


@pytest.mark.costly
def test_the_run_time_is_predicted_for_a_whole_condition_of_the_board(sandbox):
    """0.1 s for 60 m are 30 s for the 18 km of a condition."""
    results = check_results(sandbox, "Slow")
    assert failed(results) == {"time"}  # the limit is 20 s here
    predicted = float(results["time"].message.split("about ")[1].split(" s ")[0])
    assert 30.0 <= predicted < 60.0


@pytest.mark.costly
def test_all_trainings_of_what_learns_are_predicted(sandbox):
    results = check_results(sandbox, "SlowLearner")
    predicted = float(results["time"].message.split("about ")[1].split(" s ")[0])
    assert 90.0 <= predicted < 180.0


def test_the_damaged_records_have_the_named_damage():
    drives = check_drives()
    lost = np.isnan(drives.damaged["gaps"].a).mean(axis=1)
    assert ((0.01 < lost) & (lost < 0.03)).all()
    clipped = drives.damaged["clipped"].a
    assert np.abs(clipped).max() == pytest.approx(0.5 * np.abs(drives.record.a).max())
    assert np.isnan(drives.damaged["field"].a).any()
    assert drives.damaged["short"].length == checks.SHORT_LENGTH
    assert not np.array_equal(drives.damaged["mode"].damper_high[0], drives.record.damper_high[0])
    assert drives.training[0][0].length == drives.record.length == 60.0


def test_a_record_with_lost_samples_can_be_perturbed(sandbox):
    """Lost samples are NaN, and the added noise must not become NaN."""
    records = checks.perturbed_records(
        check_drives().damaged["field"], checks.load_instruments("paper")
    )
    late = records["future"]
    assert np.isfinite(late.a).mean() > 0.9
    assert not np.array_equal(late.a, records["original"].a)


@pytest.mark.costly
def test_check_estimator_exits_with_1_on_a_failure_and_prints_json(monkeypatch, tmp_path):
    shutil.copy(bad_estimators.__file__, tmp_path / "mine_here.py")
    monkeypatch.chdir(tmp_path)
    good = CliRunner().invoke(app, ["check-estimator", "mine_here:Valid"])
    assert good.exit_code == 0 and "Valid: ready for a board" in good.stdout, good.output
    bad = CliRunner().invoke(app, ["check-estimator", "bad_estimators:NotCausal", "--json"])
    output = json.loads(bad.stdout)
    assert bad.exit_code == 1 and output["passed"] is False and output["estimator"] == "NotCausal"
    failures = [check["name"] for check in output["checks"] if check["passed"] is False]
    assert failures == ["future"]
    lost = CliRunner().invoke(app, ["check-estimator", "flatt"])
    assert "unknown estimator 'flatt'" in str(lost.exception)


def test_a_failed_probe_does_not_exclude_an_estimator_but_a_failed_check_does():
    good, probe, gaps = (
        CheckResult(name=name, passed=passed, message="so")
        for name, passed in (("runs", True), ("sign", False), ("gaps", False))
    )

    def said(*results):
        output = _checks_output("estimator", "mine", results, "ready for a board")
        assert output.status == int(len(results) > 1)
        return output.shows[-1]

    assert said(good) == "mine: ready for a board"
    assert said(good, probe).endswith("which will show the failed probes sign")
    assert said(good, probe, gaps) == "mine: not ready for a board: sign, gaps"
