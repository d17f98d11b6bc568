"""Stored drives are run again: on this machine to rounding, on other kernels within a tolerance."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
import threading
import time

import pandas as pd
import pytest
from board_runs import ESTIMATORS, NAMES, copy_of_run, make_request, run
from fake_estimators import Picky
from fake_results import runs_of, with_last_run, with_runs
from fakes import SHORT_TASK, baselines, fake_drives

from leaderboard.commands.options import LimitOptions
from leaderboard.commands.results import verified_output
from leaderboard.commands.results import verify as verify_command
from leaderboard.entries.entries import make_entry
from leaderboard.entries.entry import EntryError
from leaderboard.evaluation import evaluate, store
from leaderboard.evaluation.comparison import OTHER_KERNELS, SAME_KERNELS
from leaderboard.evaluation.provenance import describe_environment
from leaderboard.evaluation.results import content_digest
from leaderboard.evaluation.tasks import load_task
from leaderboard.metrics.baselines import BASELINES
from leaderboard.report.notes import _kernel_notes, _verified_for
from leaderboard.running import verification
from leaderboard.running.board import load_board
from leaderboard.running.verification import (
    _VERIFICATION,
    Verified,
    _load_definitions,
    _other_claim,
    _without_runs,
    kernels_of,
    load_verified,
    save_definition,
    save_verified,
    verify_folder,
)
from leaderboard.sandbox.client import ONE_TRAINING
from leaderboard.sandbox.guest import MachineError
from leaderboard.sandbox.retest import LOOKS_AHEAD, NOT_RETESTED
from road_envs.core.config import ConfigError


def chosen_fakes(task, drives, condition, chosen):
    for drive in fake_drives(task, drives, condition):
        if drives is task.training or drive.index in chosen:
            yield drive


def run_here(entry, data, seeds):
    estimators = ESTIMATORS | baselines()
    yield from evaluate.in_process(estimators[entry.name])(entry, data, seeds)


def verify(out, entries=None, **options):
    if entries is None:
        entries = [make_entry(name, estimator) for name, estimator in ESTIMATORS.items()]
    found = verify_folder(out, run_here, entries, simulate=chosen_fakes, seed=1, **options)
    return {row.estimator: row for row in found}


def alter(out, name, **changes):
    """Store a row with other fields, or with other scores of its last drive."""
    row = store.load(store.row_path(out, "small", name))
    altered = changes.pop("scores", {})
    row = with_last_run(row, lambda scores: scores | altered)
    store.save(dataclasses.replace(row, **changes), out)


@pytest.mark.costly
def test_a_tenth_of_the_drives_of_an_unaltered_folder_agrees_to_rounding(tmp_path):
    copy_of_run(tmp_path)
    found = verify(tmp_path)
    assert found.keys() == NAMES
    for row in found.values():
        assert row.agrees and row.distance <= SAME_KERNELS == row.tolerance, row
    # one of six drives, with both training seeds of what is trained
    assert found["reader"].runs == 1 and found["learner"].runs == 2
    whole = verify(tmp_path, share=1.0)
    assert whole["reader"].runs == 6 and whole["learner"].runs == 12


@pytest.mark.costly
def test_a_row_whose_training_depends_on_the_seed_under_one_condition_agrees(tmp_path):
    """It has runs of both seeds there, and of the first one under the other condition."""
    made = {"picky": Picky()}
    run(tmp_path, made)

    def run_it(entry, data, seeds):
        return evaluate.in_process((made | baselines())[entry.name])(entry, data, seeds)

    entries = [make_entry("picky", Picky())]
    found = verify_folder(tmp_path, run_it, entries, simulate=chosen_fakes, share=1.0)
    picky = next(row for row in found if row.estimator == "picky")
    assert picky.agrees and picky.runs == 9, picky
    # as on a board, a condition weighs one, however many trainings it has: 9.5 % off half of them
    row = store.load(store.row_path(tmp_path, "small", "picky"))
    runs, elsewhere = runs_of(row), describe_environment() | {"blas": "openblas Z80"}
    labels = [run[0] for run in runs]
    once = min(labels, key=labels.count)
    lower = {k: x | {"nrmse": (0.905 if k[0] == once else 1) * x["nrmse"]} for k, x in runs.items()}
    store.save(dataclasses.replace(with_runs(row, lower), environment=elsewhere), tmp_path)
    found = verify_folder(tmp_path, run_it, entries, simulate=chosen_fakes, share=1.0)
    picky = next(row for row in found if row.estimator == "picky")
    assert not picky.agrees and picky.distance < OTHER_KERNELS and picky.typical == 0.0, picky


@pytest.mark.costly
def test_a_training_that_changes_nothing_of_the_drives_that_are_run_again_agrees(tmp_path):
    """Its seed changes others, so that the row has runs of both and no note."""
    made = {"picky": Picky()}
    run(tmp_path, made)
    assert not store.load(store.row_path(tmp_path, "small", "picky")).notes

    def run_it(entry, data, seeds):
        runs = [*evaluate.in_process((made | baselines())[entry.name])(entry, data, seeds)]
        equal = entry.name == "picky" and len(runs) == 1
        return [dataclasses.replace(runs[0], notes=(ONE_TRAINING,))] if equal else runs

    entries = [make_entry("picky", Picky())]
    found = verify_folder(tmp_path, run_it, entries, simulate=chosen_fakes, share=1.0)
    picky = next(row for row in found if row.estimator == "picky")
    assert picky.agrees and picky.runs == 9, picky


@pytest.mark.costly
def test_an_altered_score_is_found_by_its_distance(tmp_path):
    copy_of_run(tmp_path)
    row = store.load(store.row_path(tmp_path, "small", "reader"))
    score = list(runs_of(row).values())[-1]["nrmse"]
    alter(tmp_path, "reader", scores={"nrmse": 1.01 * score})
    found = verify(tmp_path, share=1.0)
    assert [name for name, row in found.items() if not row.agrees] == ["reader"]
    assert found["reader"].score == "nrmse"
    assert found["reader"].distance == pytest.approx(0.01 * score / max(1.01 * score, 0.1))


def test_a_score_that_a_row_lacks_is_as_far_as_can_be_and_kept_so(tmp_path):
    copy_of_run(tmp_path)
    row = store.load(store.row_path(tmp_path, "small", "reader"))
    bare = with_last_run(row, lambda own: {n: x for n, x in own.items() if n != "nrmse"})
    store.save(bare, tmp_path)
    found = verify(tmp_path, share=1.0)
    assert found["reader"].distance == 2.0 and not found["reader"].agrees
    save_verified(found.values(), tmp_path)
    assert load_verified(tmp_path)[content_digest(bare)] == [found["reader"]]


@pytest.mark.costly
def test_of_a_row_of_other_kernels_the_ranking_score_is_compared_at_a_wider_tolerance(tmp_path):
    copy_of_run(tmp_path)
    row = store.load(store.row_path(tmp_path, "small", "reader"))
    scores = list(runs_of(row).values())[-1]
    elsewhere = describe_environment() | {"blas": "openblas Z80"}
    for share, agrees in ((0.9, True), (1.1, False)):  # one of six drives
        moved = {"nrmse": scores["nrmse"] / (1.0 - share * OTHER_KERNELS), "r": 0.0}
        alter(tmp_path, "reader", scores=moved, environment=elsewhere)
        found = verify(tmp_path, share=1.0)["reader"]
        assert found.agrees == agrees and found.tolerance == OTHER_KERNELS
        assert found.score == "nrmse"
        assert found.distance == pytest.approx(share * OTHER_KERNELS)


@pytest.mark.costly
@pytest.mark.parametrize("factors", [(0.95, 0.95), (0.95, 1.05)])
def test_a_row_of_other_kernels_that_is_another_on_most_drives_does_not_agree(tmp_path, factors):
    copy_of_run(tmp_path)
    elsewhere = describe_environment() | {"blas": "openblas Z80"}
    row = store.load(store.row_path(tmp_path, "small", "reader"))
    for moved, agrees in ((3, True), (4, False)):  # of six drives
        runs = {
            run: scores | ({"nrmse": factors[k % 2] * scores["nrmse"]} if k < moved else {})
            for k, (run, scores) in enumerate(runs_of(row).items())
        }
        altered = dataclasses.replace(with_runs(row, runs), environment=elsewhere)
        store.save(altered, tmp_path)
        found = verify(tmp_path, share=1.0)["reader"]
        assert found.agrees == agrees and found.distance == pytest.approx(0.05)
    assert found.is_far.startswith("half of its runs by ")


@pytest.mark.costly
def test_a_row_of_another_machine_by_its_own_word_is_moved_no_farther_than_by_one_run(tmp_path):
    copy_of_run(tmp_path)
    elsewhere = describe_environment() | {"processor": "Z80, 2 cores"}
    row = store.load(store.row_path(tmp_path, "small", "reader"))
    for share, agrees in ((0.2, True), (0.95, False)):  # of the tolerance, three of six runs
        low = sorted(runs_of(row), key=lambda x: runs_of(row)[x]["nrmse"])[1:4]
        runs = {
            name: scores
            | ({"nrmse": (1.0 - share * OTHER_KERNELS) * scores["nrmse"]} if name in low else {})
            for name, scores in runs_of(row).items()
        }
        store.save(dataclasses.replace(with_runs(row, runs), environment=elsewhere), tmp_path)
        found = verify(tmp_path, share=1.0)["reader"]
        assert found.runs == 6 and found.typical == 0.0 and found.distance <= OTHER_KERNELS
        assert found.agrees == agrees and 0.5 * share < found.shift / OTHER_KERNELS < share
    assert found.is_far.startswith("its mean by ")


@pytest.mark.costly
def test_a_row_of_chosen_drives_or_of_repeated_ones_is_not_that_of_its_task(tmp_path):
    copy_of_run(tmp_path)
    row = store.load(store.row_path(tmp_path, "small", "learner"))
    runs, table = runs_of(row), row.scores
    lowest = dict([min(runs.items(), key=lambda x: x[1]["nrmse"])])
    best = with_runs(row, lowest).scores
    fewer = with_runs(row, dict(list(runs.items())[:-1])).scores
    reason = "its drives are not those of its task, once with each training seed"
    for scores in (best, fewer, pd.concat([table, best])):
        store.save(dataclasses.replace(row, scores=scores), tmp_path)
        found = verify(tmp_path)["learner"]
        assert found.reason == reason and not found.agrees
    store.save(dataclasses.replace(row, scores=table[table["seed"] == 1]), tmp_path)
    found = verify(tmp_path)["learner"]  # the other seed is run, and not in the row
    assert found.distance == 2.0 and not found.agrees


@pytest.mark.costly
def test_a_row_that_says_something_else_of_its_entry_does_not_agree(tmp_path):
    copy_of_run(tmp_path)
    row = store.load(store.row_path(tmp_path, "small", "reader"))
    for field, value in (("causal", not row.causal), ("lag", 5.0), ("role", "baseline")):
        store.save(dataclasses.replace(row, **{field: value}), tmp_path)
        found = verify(tmp_path)["reader"]
        expected = f"its {field} is {getattr(row, field)}, the row says {value}"
        assert found.reason == expected and not found.agrees and found.is_false


@pytest.mark.parametrize(
    "told", [{"causal": True}, {"lag": 5.0}, {"seeds": (2, 1)}, {"task_digest": "0" * 64}]
)
@pytest.mark.costly
def test_who_lies_of_two_things_is_not_called_one_that_cannot_be_run(tmp_path, told):
    """Nor is a row of another task left out without a word."""
    copy_of_run(tmp_path)
    alter(tmp_path, "reader", scores={"nrmse": 0.01}, **told)
    found = verify(tmp_path)
    output = verified_output(list(found.values()))
    is_other = "task_digest" in told
    assert found["reader"].is_false != is_other and found["reader"].reason
    assert output.status == int(not is_other)
    assert output.shows[1].endswith(f"; {int(is_other)} could not be run again")


def test_a_row_may_say_by_chance_that_its_entry_looks_ahead(tmp_path):
    copy_of_run(tmp_path)
    row = store.load(store.row_path(tmp_path, "small", "reader"))
    made = dataclasses.replace(row, causal=True)
    for note in (LOOKS_AHEAD, f"{NOT_RETESTED}: ended"):
        less = dataclasses.replace(row, causal=False, notes=(f"reader: {note}",))
        assert _other_claim(less, made) is None
        found = dataclasses.replace(row, causal=False, notes=(f"reader: {LOOKS_AHEAD}",))
        assert _other_claim(made, found) == "its causal is False, the row says True"
    assert _other_claim(row, made) == "its causal is True, the row says False"
    busy = dataclasses.replace(made, causal=False, notes=(f"reader: {NOT_RETESTED}: x",))
    assert _other_claim(made, busy) is None  # it was here that it could not be asked again
    for changes in ({"estimator": "learner"}, {"role": "baseline"}):  # nor is a note of these
        assert _other_claim(dataclasses.replace(less, **changes), made)


@pytest.mark.costly
def test_a_note_is_a_whole_sentence_of_the_judge(tmp_path):
    """What follows it could be said of a rival."""
    copy_of_run(tmp_path)
    row = store.load(store.row_path(tmp_path, "small", "reader"))
    for note in (
        f"{ONE_TRAINING}; rival: {LOOKS_AHEAD}",
        f"{NOT_RETESTED}: x; rival: {LOOKS_AHEAD}",
    ):
        store.save(dataclasses.replace(row, notes=(f"reader: {note}",)), tmp_path)
        assert verify(tmp_path, share=1.0)["reader"].is_false


def test_what_could_not_be_asked_again_is_compared_all_the_same(tmp_path):
    copy_of_run(tmp_path)

    def busy(entry, data, seeds):
        for one in run_here(entry, data, seeds):
            yield dataclasses.replace(one, notes=(f"{NOT_RETESTED}: busy",), looks_ahead=True)

    entries = [make_entry(name, estimator) for name, estimator in ESTIMATORS.items()]
    for factor, reason in ((1.0, f"reader: {NOT_RETESTED}: busy"), (0.5, "")):
        row = store.load(store.row_path(tmp_path, "small", "reader"))
        lower = {k: x | {"nrmse": factor * x["nrmse"]} for k, x in runs_of(row).items()}
        store.save(with_runs(row, lower), tmp_path)
        found = verify_folder(tmp_path, busy, entries, simulate=chosen_fakes, seed=1)
        reader = next(row for row in found if row.estimator == "reader")
        assert reader.reason == reason and not reader.agrees and reader.runs


@pytest.mark.parametrize("share", [0.1, 1.0])
def test_a_row_that_has_failed_is_run_again(tmp_path, share):
    """On a part of the drives that an entry runs it may all the same have failed on others."""
    copy_of_run(tmp_path)
    for name in ("reader", "learner"):
        alter(tmp_path, name, failure="no number")

    def fails(entry, data, seeds):
        if entry.name == "learner":
            raise EntryError("no number here, either")
        yield from run_here(entry, data, seeds)

    entries = [make_entry(name, estimator) for name, estimator in ESTIMATORS.items()]
    options = {"simulate": chosen_fakes, "seed": 1, "share": share}
    found = verify_folder(tmp_path, fails, entries, **options)
    reasons = {row.estimator: row.reason for row in found if row.reason}
    assert reasons == {
        "reader": "it does not fail on these drives; its row says: no number",
        "learner": "failed: no number",
    }
    output = verified_output(found)
    assert output.status == (share == 1.0)
    assert f"{2 - (share == 1.0)} could not be run again" in output.shows[1]


def test_a_row_of_which_no_drive_was_run_again_does_not_agree(tmp_path):
    copy_of_run(tmp_path)
    assert not any(row.agrees for row in verify(tmp_path, share=0.0).values())


def test_what_differed_once_stands_against_a_part_of_the_drives_that_agrees(tmp_path):
    """Else a row would be clean again by another choice of drives."""
    copy_of_run(tmp_path)
    alter(tmp_path, "reader", scores={"nrmse": 0.01})
    (whole,) = save_verified([verify(tmp_path, share=1.0)["reader"]], tmp_path)
    assert whole.runs == 6 and not whole.agrees
    part = dataclasses.replace(whole, runs=1, distance=0.0, typical=0.0, shift=0.0)
    assert part.agrees and save_verified([part], tmp_path) == [whole]
    assert load_verified(tmp_path) == {whole.content: [whole]}
    assert verified_output(save_verified([part], tmp_path)).status == 1
    worse = dataclasses.replace(whole, distance=1.5)
    assert save_verified([worse], tmp_path) == [worse] == load_verified(tmp_path)[whole.content]
    false = dataclasses.replace(whole, runs=0, reason="its lag is 1", is_false=True)
    other = dataclasses.replace(false, content="of another row")
    assert save_verified([other], tmp_path) == [other] == load_verified(tmp_path)[other.content]
    agrees = dataclasses.replace(part, content=other.content)  # it was false by chance
    assert other.share == agrees.share == 1.0
    fewer = dataclasses.replace(agrees, share=0.1)
    assert save_verified([fewer], tmp_path) == [other] == load_verified(tmp_path)[other.content]
    assert save_verified([agrees], tmp_path) == [agrees] == load_verified(tmp_path)[other.content]


@pytest.mark.costly
def test_a_row_that_was_found_false_is_noted_on_its_board(tmp_path):
    board, _ = run(tmp_path)
    (reader,) = (r for r in board.results["small"] if r.estimator == "reader")
    found = dataclasses.replace(verify(tmp_path)["reader"], reason="its lag is 1", is_false=True)
    save_verified([found], tmp_path)
    (note,) = _kernel_notes([reader], load_verified(tmp_path))
    assert note == "reader is not what was found when it was run again: its lag is 1."


@pytest.mark.costly
def test_what_agrees_in_another_score_than_the_board_ranks_by_counts_for_nothing(tmp_path):
    """The board of a stored definition is no part of its digest."""
    board, _ = run(tmp_path)
    (t,), rows = board.tasks, verify(tmp_path)
    own = rows["reader"]
    assert own.ranks_by == t.board_definition.ranks_by == "nrmse"
    elsewhere = dataclasses.replace(own, tolerance=OTHER_KERNELS, ranks_by="dsd_distance_db")
    apart = dataclasses.replace(elsewhere, distance=0.9)
    counted = [own, dataclasses.replace(elsewhere, ranks_by="nrmse"), apart]
    verified = {own.content: [*counted, elsewhere]}
    assert _verified_for(t, verified) == {own.content: counted}


def test_a_definition_that_cannot_be_read_ends_no_verification_of_other_tasks(tmp_path):
    copy_of_run(tmp_path)
    (tmp_path / "definitions" / "0.json").write_text("{}")
    (tmp_path / "results" / "gone").mkdir()
    shutil.copy(store.row_path(tmp_path, "small", "reader"), tmp_path / "results" / "gone")
    entries = [make_entry(name, estimator) for name, estimator in ESTIMATORS.items()]
    found = verify_folder(tmp_path, run_here, entries, simulate=chosen_fakes, seed=1)
    (gone,) = (row for row in found if row.task == "gone")
    assert "its task is not defined here, and " in gone.reason and "0.json" in gone.reason
    assert any(row.agrees for row in found)
    for path in (tmp_path / "definitions").glob("[!0]*.json"):
        path.unlink()
    with pytest.raises(ConfigError, match=r"0\.json"):
        verify(tmp_path)


def test_a_definition_of_another_task_than_the_shipped_one_of_its_name_is_named(tmp_path):
    copy_of_run(tmp_path)
    own = dataclasses.replace(load_task("class"), bumps=True)
    save_definition(own, tmp_path)
    for number in (2, None):
        save_definition(load_task("class").with_test_drives(number), tmp_path)
    tasks, unread = _load_definitions(tmp_path)
    assert [task.name for task in tasks] == ["class", "class", "small"]
    assert [str(x).partition(": ")[2] for x in unread] == ["its class is not that of this package"]


@pytest.mark.costly
def test_chosen_drives_of_a_shipped_task_are_named_or_refused(tmp_path):
    copy_of_run(tmp_path)
    row, shipped = store.load(store.row_path(tmp_path, "small", "reader")), load_task("new_road")
    cases = {
        "": shipped,
        "number 6, design not given": shipped.with_test_drives(6),
        "number not given, design not given": shipped.with_test_drives(None),
        "length 60.0": shipped.with_test_length(60.0),
    }
    for made in cases.values():
        save_definition(made, tmp_path)
    others = [shipped.with_test_drives(6), load_task("paper_1"), shipped]
    changes = [
        {"design": ((0, 1, 2, 3, 4, 5), *[(0,)] * (len(shipped.conditions) - 1))},
        {"length": 60.0},
        {"design": shipped.test.design[::-1]},
    ]
    for task, change in zip(others, changes, strict=True):
        test = dataclasses.replace(task.test, **change)
        save_definition(dataclasses.replace(task, test=test), tmp_path)
    tasks, unread = _load_definitions(tmp_path)
    assert len(unread) == 3 and all("is not that of this package" in str(x) for x in unread)
    found = {task.digest: _without_runs(task, row) for task in tasks if task.name == "new_road"}
    drives = {digest: verified.drives for digest, verified in found.items()}
    assert drives == {task.digest: words for words, task in cases.items()}
    table = verified_output(list(found.values())).shows[0]
    assert set(table.columns[1].cells) == {"new_road" + f": {x}" * bool(x) for x in cases}


def test_a_row_of_chosen_training_seeds_does_not_agree(tmp_path):
    copy_of_run(tmp_path)
    row = store.load(store.row_path(tmp_path, "small", "learner"))
    store.save(dataclasses.replace(row, seeds=(7, 2)), tmp_path)
    assert verify(tmp_path)["learner"].reason == "its training seeds are 7, 2, not 1 to 2"
    store.save(dataclasses.replace(row, seeds=()), tmp_path)
    assert verify(tmp_path)["learner"].reason == "it has no training seeds"


def test_a_note_that_a_row_lacks_is_found(tmp_path):
    copy_of_run(tmp_path)

    def noted(entry, data, seeds):
        for one in run_here(entry, data, seeds):
            yield dataclasses.replace(one, notes=("it remembers",))

    entries = [make_entry(name, estimator) for name, estimator in ESTIMATORS.items()]
    found = verify_folder(tmp_path, noted, entries, simulate=chosen_fakes, seed=1)
    reasons = {row.estimator: row.reason for row in found}
    assert reasons["reader"] == "it lacks the note: reader: it remembers"


@pytest.mark.costly
def test_given_tasks_are_verified_whatever_the_folder_defines(tmp_path):
    board, _ = run(tmp_path)
    for path in (tmp_path / "definitions").iterdir():
        path.unlink()
    alter(tmp_path, "reader", scores={"nrmse": 0.01})
    found = verify(tmp_path, share=1.0, tasks=board.tasks)
    assert [name for name, row in found.items() if not row.agrees] == ["reader"]


def test_a_scored_row_whose_entry_fails_here_does_not_agree(tmp_path):
    """By the status of the command: code that raises from some day on would hide false scores.
    One of this package lacks what is installed elsewhere, which says nothing of its row.
    """
    copy_of_run(tmp_path)

    def fails(entry, data, seeds):
        if entry.name in ("reader", "learner"):
            raise EntryError("not today")
        return run_here(entry, data, seeds)

    made = {name: make_entry(name, estimator) for name, estimator in ESTIMATORS.items()}
    for name, reference in [("reader", "elsewhere:Reader"), ("learner", "estimators.api:Learner")]:
        made[name] = dataclasses.replace(made[name], reference=reference)
    found = verify_folder(tmp_path, fails, made.values(), simulate=chosen_fakes, seed=1)
    rows = {row.estimator: row for row in found}
    assert all(rows[name].reason.endswith("not today") for name in ("reader", "learner"))
    assert rows["reader"].is_false and not rows["learner"].is_false
    assert verified_output(found).status == 1


@pytest.mark.parametrize(
    ("failures", "reason", "is_false"),
    [
        ([EntryError("ended")], "", False),
        ([EntryError("ended"), EntryError("and again")], "and again", True),
        ([MachineError("no space")], "no space", False),
        ([EntryError("ended"), MachineError("no space")], "no space", False),
    ],
)
def test_a_scored_row_is_false_only_if_its_entry_fails_twice_by_itself(
    tmp_path, failures, reason, is_false
):
    """Once may have been the machine, which was stopped or had no memory left."""
    copy_of_run(tmp_path)
    left = failures[::-1]

    def fails(entry, data, seeds):
        if entry.name == "reader" and left:
            raise left.pop()
        return run_here(entry, data, seeds)

    made = {name: make_entry(name, estimator) for name, estimator in ESTIMATORS.items()}
    made["reader"] = dataclasses.replace(made["reader"], reference="elsewhere:Reader")
    found = verify_folder(tmp_path, fails, made.values(), simulate=chosen_fakes, seed=1)
    (reader,) = (row for row in found if row.estimator == "reader")
    assert reader.reason.endswith(reason) and reader.agrees == (not reason)
    assert reader.is_false == is_false and not left


@pytest.mark.parametrize(
    ("limits", "is_false"),
    [((1.0, 4.0), False), ((1800.0, 1.0), False), ((1800.0, 4.0), True), ((3600.0, 8.0), True)],
)
def test_a_row_is_not_false_that_fails_within_narrower_limits_than_its_own(
    tmp_path, limits, is_false
):
    copy_of_run(tmp_path)
    alter(tmp_path, "reader", limits=(1800.0, 4.0))

    def fails(entry, data, seeds):
        if entry.name == "reader":
            raise EntryError("stopped after 1 s, the time limit")
        return run_here(entry, data, seeds)

    made = {name: make_entry(name, estimator) for name, estimator in ESTIMATORS.items()}
    made["reader"] = dataclasses.replace(made["reader"], reference="elsewhere:Reader")
    options = {"simulate": chosen_fakes, "seed": 1, "limits": limits}
    found = verify_folder(tmp_path, fails, made.values(), **options)
    (reader,) = (row for row in found if row.estimator == "reader")
    assert reader.is_false == is_false and not reader.agrees and not reader.runs
    its = "" if is_false else "; its row was made within 1800 s, 4 GiB"
    assert reader.reason.endswith(f"stopped after 1 s, the time limit{its}")
    assert verified_output(found).status == is_false


def test_rows_of_a_task_that_a_folder_does_not_define_are_named(tmp_path):
    copy_of_run(tmp_path)
    path = store.row_path(tmp_path, "small", "reader")
    other = path.parents[1] / "other" / path.name
    other.parent.mkdir()
    other.write_text(path.read_text())
    rows = [row for row in verify_folder(tmp_path, run_here, simulate=chosen_fakes, seed=1)]
    assert [(x.estimator, x.reason) for x in rows if x.task == "other"] == [
        ("reader", "its task is not defined here")
    ]


def test_a_row_that_cannot_be_run_again_says_why(tmp_path):
    copy_of_run(tmp_path)
    other = dataclasses.replace(ESTIMATORS["reader"], gain=0.1)
    found = verify(tmp_path, entries=[make_entry("reader", other)])
    assert found["learner"].reason == "not of this package: give it with --estimator"
    assert found["reader"].reason == "made with other settings"
    assert not found["reader"].agrees and all(found[name].agrees for name in BASELINES)
    alter(tmp_path, "reader", code="0" * 16)
    assert verify(tmp_path)["reader"].reason == "its code or its weights have changed"


def test_a_task_that_is_not_the_one_of_its_file_is_refused(tmp_path):
    copy_of_run(tmp_path)
    (path,) = (tmp_path / "definitions").iterdir()
    path.rename(path.with_stem("0" * 64))
    with pytest.raises(ConfigError, match="the task small, or a file that it names, is not the"):
        verify(tmp_path)
    path.with_stem("0" * 64).unlink()
    with pytest.raises(ConfigError, match="no results with the task that they were made with"):
        verify(tmp_path)


def made_on(blas, results):
    environment = describe_environment() | {"blas": blas}
    return [dataclasses.replace(r, environment=environment) for r in results]


@pytest.mark.costly
def test_rows_of_other_kernels_are_noted_unless_they_were_verified(tmp_path):
    board, _ = run(tmp_path)
    first, *others = (r for r in board.results["small"] if r.estimator != "reader")
    reader = next(r for r in board.results["small"] if r.estimator == "reader")
    (usual,) = {kernels_of(r.environment) for r in others}
    results = [*others, *made_on("openblas Z80", [first, reader])]
    (note,) = _kernel_notes(results, {})
    assert note.startswith(f"{first.estimator}, reader ran on ")
    assert "Z80" in note and usual in note and note.endswith("not verified there.")
    save_verified([dataclasses.replace(row, tolerance=OTHER_KERNELS) for row in
                   verify(tmp_path, share=1.0).values()], tmp_path)  # fmt: skip
    verified = load_verified(tmp_path)
    assert _kernel_notes(results, verified) == []
    own = content_digest(reader)
    apart = {own: [dataclasses.replace(verified[own][0], distance=0.3)]}
    (note,) = _kernel_notes(results, verified | apart)
    assert note.startswith("reader ran on ") and note.endswith("3.0e-01 apart there.")
    (note,) = _kernel_notes([*others, reader], verified | apart)  # whatever it says of its machine
    assert note == f"reader says that it ran on {usual}: 3.0e-01 apart there."
    assert _kernel_notes([*others, reader], verified) == _kernel_notes([], {}) == []
    elsewhere = {own: [dataclasses.replace(apart[own][0], kernels="Z80")]}
    (note,) = _kernel_notes([*others, reader], elsewhere)
    assert note == "reader was run again on Z80: 3.0e-01 apart."
    moved = with_last_run(made_on("openblas Z80", [reader])[0], lambda x: {"nrmse": 0.1})
    (note,) = _kernel_notes([*others, moved], verified)  # altered after it was verified
    assert note.endswith("not verified there.")


@pytest.mark.costly
def test_what_was_verified_is_kept_by_row_and_kernels_and_shown(tmp_path):
    board, _ = run(tmp_path)
    found = verify(tmp_path)["reader"]
    for kernels, distance in (("A", 0.3), ("B", 0.1), ("A", 0.2)):
        row = dataclasses.replace(found, kernels=kernels, distance=distance)
        save_verified([row, dataclasses.replace(found, reason="stale", content="x")], tmp_path)
    (rows,) = load_verified(tmp_path).values()
    assert {row.kernels: row.distance for row in rows} == {"A": 0.2, "B": 0.1}
    assert load_board(board.tasks, tmp_path, make_request().rows()).verified == {
        found.content: rows
    }


FALSE = Verified(task="small", estimator="rival", content="abc", is_false=True, share=1.0)


def spoilt(content, **changes):
    return dataclasses.replace(_VERIFICATION, **changes).to_text(content)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (
            spoilt({"rows": [dataclasses.asdict(FALSE)]}, format=99),
            "written in format 99 by a newer",
        ),
        (spoilt({"rows": [{"task": "small", "verdict": 1}]}), "verdict: unknown key"),
        (spoilt({"rows": None}), "not iterable"),
        (spoilt({}), "cannot be read, and is not overwritten: 'rows'"),
        ("{}", "it has no format"),
        ("", "cannot be read, and is not overwritten: .*damaged"),
        (spoilt({"rows": []}).replace("[]", "[1]"), "modified since it was written"),
    ],
)
def test_what_was_found_false_is_not_forgotten_with_a_file_that_cannot_be_read(tmp_path, text, why):
    assert load_verified(tmp_path) == {} and save_verified([FALSE], tmp_path) == [FALSE]
    path = tmp_path / "verified.json"
    assert load_verified(tmp_path) == {"abc": [FALSE]}
    path.write_text(text)
    with pytest.raises(ConfigError, match=why):
        load_verified(tmp_path)
    with pytest.raises(ConfigError, match=r"verified\.json"):
        save_verified([dataclasses.replace(FALSE, content="def")], tmp_path)
    with pytest.raises(ConfigError, match=r"verified\.json"):
        verify_command(tmp_path, limits=LimitOptions())
    assert path.read_text() == text


def test_the_command_tells_the_limits_within_which_it_runs_rows_again(tmp_path, monkeypatch):
    told = {}
    monkeypatch.setattr(
        "leaderboard.commands.results.verify_folder",
        lambda *_, **known: told.update(known) or [FALSE],
    )
    verify_command(tmp_path, limits=LimitOptions(time_limit=7.0, memory_limit=2.0))
    assert told["limits"] == (7.0, 2.0)


def test_what_two_commands_find_at_once_is_all_kept(tmp_path, monkeypatch):
    def slow(out):
        known = load_verified(out)
        time.sleep(0.3)
        return known

    monkeypatch.setattr(verification, "load_verified", slow)
    contents = ("abc", "def")
    found = [[dataclasses.replace(FALSE, content=content)] for content in contents]
    threads = [threading.Thread(target=save_verified, args=(rows, tmp_path)) for rows in found]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert load_verified(tmp_path).keys() == set(contents)


@pytest.mark.processes
def test_a_folder_made_with_one_blas_kernel_is_verified_with_another(tmp_path):
    (tmp_path / "short.yaml").write_text(SHORT_TASK)
    out = tmp_path / "out"

    def call(kernel, *arguments):
        return subprocess.run(
            [sys.executable, "-m", "leaderboard.cli", *arguments],
            env=os.environ | {"OPENBLAS_CORETYPE": kernel},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
        )

    made = call(
        "Haswell", "leaderboard", "--task", "short.yaml", "--estimator", "wiener", "--out", str(out)
    )
    assert made.returncode == 0, made.stderr
    verify_words = ("verify", str(out), "--share", "1.0", "--json")
    verified = call("Sandybridge", *verify_words)
    assert verified.returncode == 0, verified.stderr
    found = {row["estimator"]: row for row in json.loads(verified.stdout)}
    assert "wiener" in found and all(row["agrees"] for row in found.values())
    assert all(row["tolerance"] == OTHER_KERNELS for row in found.values())
    assert "Sandybridge" in found["wiener"]["kernels"] and found["wiener"]["runs"] == 1

    row = store.load(store.row_path(out, "short", "wiener"))
    factor = 1.0 - 1.2 * OTHER_KERNELS
    store.save(with_last_run(row, lambda own: own | {"nrmse": factor * own["nrmse"]}), out)
    verified = call("Sandybridge", *verify_words)
    assert verified.returncode == 1, verified.stderr
    found = {row["estimator"]: row for row in json.loads(verified.stdout)}
    assert [name for name, row in found.items() if not row["agrees"]] == ["wiener"]
    assert found["wiener"]["distance"] == pytest.approx(1.2 * OTHER_KERNELS, rel=0.05)
