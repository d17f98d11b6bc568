"""Tables of results: scores, ranks, slopes over grades, notes and warnings."""

import dataclasses
import io
import json

import numpy as np
import pytest
import yaml
from fake_estimators import Learner, Picky, Reader
from fake_results import (
    ENTRIES,
    board,
    result_of,
    results_by_fakes,
    run_scores,
    runs_of,
    with_runs,
)
from fakes import fake_drives, task
from rich.console import Console

from leaderboard.evaluation.evaluate import run_task
from leaderboard.evaluation.tasks import load_task
from leaderboard.metrics.bootstrap import interquartile_mean, iqm_interval
from leaderboard.metrics.registry import SCORES
from leaderboard.report.board_definitions import board_columns
from leaderboard.report.charts import _counted_runs
from leaderboard.report.export import as_json, write_exports
from leaderboard.report.notes import (
    FOUND_SEEDS,
    PUBLIC_ROADS,
    REVEALED_ROADS,
    SEALED_ROADS,
    _protocol_notes,
    _version_notes,
    sanity_warnings,
)
from leaderboard.report.overview import ranking_chart
from leaderboard.report.sentences import build_report, headline
from leaderboard.report.site import _drive_counts, _table, _task
from leaderboard.report.tables import Row, board_views, level_runs, train_seconds
from leaderboard.report.terminal import print_tables
from leaderboard.running.board import Board
from road_envs.core import config


def test_every_condition_has_its_own_score_interval_and_rank():
    (view,) = board_views(board())
    (section,) = view.sections
    assert section.groups == {"condition": tuple(c.label for c in task().conditions)}
    line = next(line for line in section.rows if line.name == "learner")
    for k, label in enumerate(section.groups["condition"]):
        values = run_scores(result_of("learner"), "nrmse")[:, k : k + 1]
        group = line.groups[label]
        assert group["nrmse"] == pytest.approx(interquartile_mean(values.ravel()))
        assert (group["low"], group["high"]) == pytest.approx(iqm_interval(values)[1:])
        assert group["rank"] in (1, 2)


def test_each_road_family_has_its_own_scores():
    test = {**FAMILIES, "families": ["level", "rough"]}
    t = task(test=test)
    (result,) = run_task(t, {"reader": Reader()}, (1,), simulate=fake_drives)
    (view,) = board_views(Board((t,), {"small": [result]}))
    line, _ = view.sections[0].rows
    rough = run_scores(result, "level_error")[[1, 3]]
    assert line.groups["rough"]["level_error"] == pytest.approx(interquartile_mean(rough.ravel()))
    assert view.sections[0].groups["family"] == ("level", "rough")


def test_a_drive_over_a_level_road_takes_no_rank_from_anybody():
    """Nobody has a score there; who has none where others have one has no rank."""
    results = results_by_fakes()

    def on_level(result):
        runs = runs_of(result)
        last = next(reversed(runs))[:2]
        changed = {k: x | {"nrmse": None} if k[:2] == last else x for k, x in runs.items()}
        return with_runs(result, changed)

    level = [r if r.failure else on_level(r) for r in results]
    (view,) = board_views(Board((task(),), {"small": level}))
    (section,) = view.sections
    ranks = {row.name: row.values["rank"] for row in section.rows if row.state == "scored"}
    assert ranks == {"reader": 1, "learner": 2}
    assert section.notes[1] == "On 1 drive nobody has a score, as on a level road."
    scored = [r for r in level if not r.failure]
    on_level = level_runs(scored, view.definition)
    assert not any(np.isinf(_counted_runs(r, "nrmse", on_level)).any() for r in scored)
    mixed = [new if new.estimator == "reader" else old
             for new, old in zip(level, results, strict=True)]  # fmt: skip
    (view,) = board_views(Board((task(),), {"small": mixed}))
    rows = {row.name: row.values for row in view.sections[0].rows}
    assert rows["reader"]["low"] is None and rows["learner"]["rank"] == 1
    assert "nobody has a score" not in str(view.sections[0].notes)


def board_with_a_level_road(exact):
    """A board ranked by a ratio of densities, undefined on a level road for those who are `exact`
    there alone; the NRMSE is for everybody.
    """
    results = results_by_fakes()
    (first, *_) = {run[:2] for run in runs_of(result_of("reader"))}

    def scored_by_distance(result):
        level = {"nrmse": None, "dsd_distance_db": None if result.estimator in exact else 60.0}
        runs = runs_of(result)
        return with_runs(
            result,
            {k: x | (level if k[:2] == first else {"dsd_distance_db": x["nrmse"]})
             for k, x in runs.items()},
        )  # fmt: skip

    level = [r if r.failure else scored_by_distance(r) for r in results]
    t = task(board={"title": "Mine", "ranks_by": "dsd_distance_db", "columns": ["interval"]})
    return Board((t,), {"small": level})


def test_who_is_exact_on_a_level_road_is_ranked_beside_who_is_not():
    made = board_with_a_level_road(exact=("reader", "truth_plus_noise"))
    (view,) = board_views(made)
    rows = {row.name: row.values for row in view.sections[0].rows if row.state == "scored"}
    assert {name: row["rank"] for name, row in rows.items()} == {"reader": 1, "learner": 2}
    assert rows["learner"]["dsd_distance_db"] < 10.0
    scored = made.scored(made.tasks[0])
    on_level = level_runs(scored, view.definition)
    assert all(
        np.isnan(_counted_runs(r, "dsd_distance_db", on_level)[on_level]).all() for r in scored
    )


def test_a_drive_that_the_table_counts_for_nobody_is_not_in_the_chart_of_runs():
    """A baseline, which is not drawn, tells that its road is level."""
    made = board_with_a_level_road(exact=("truth_plus_noise",))
    (view,) = board_views(made)
    chart = _task(made, view, view.sections[0])["charts"]["runs"]
    lines = [line for line in chart["figures"][""]["data"] if "mode" in line]
    assert {line["name"]: line["y"][-1] for line in lines} == {"reader": 100.0, "learner": 100.0}


def test_who_lacks_the_ranking_score_on_some_drives_has_no_error_to_be_ordered_by():
    """A mean of the drives on which an entry has found something would be that of others."""
    results = results_by_fakes()
    runs = runs_of(result_of("reader"))
    (first, *_) = runs
    some = with_runs(result_of("reader"), runs | {first: runs[first] | {"nrmse": None}})
    made = [some if r.estimator == "reader" else r for r in results]
    (view,) = board_views(Board((task(),), {"small": made}))
    (section,) = view.sections
    names = [row.name for row in section.rows if row.state == "scored"]
    assert names == ["learner", "reader"] and section.rows[1].values["nrmse"] is None
    groups = section.rows[1].groups.values()
    label = SCORES["nrmse"].label
    assert section.notes[1] == f"No {label} on some drives, and so no rank: reader."
    assert not any("rank" in values for values in (section.rows[1].values, *groups))
    ranks = {entry["name"]: entry.get("rank") for entry in as_json([view])[0]["entries"]}
    assert (ranks["learner"], ranks["reader"]) == (1, None)
    assert not any("nobody has a score" in note for note in section.notes)


def test_roads_that_can_be_drawn_again_are_noted_on_boards_with_entries_of_others():
    """Whose seeds are found by trial, or stand in a file that nobody has sealed."""

    def noted(name, *seeds, note=""):
        t = task(test={"roads": ["iso_d"], "seeds": seeds, "length": 40.0}, note=note)
        made = run_task(t, {"reader": Reader()}, (1,), simulate=fake_drives)
        made = [dataclasses.replace(x, estimator=name) for x in made]
        (view,) = board_views(Board((t,), {t.name: made}))
        assert view.sections[0].rows[0].state == "scored"
        return [x for x in (FOUND_SEEDS, REVEALED_ROADS) if x in view.sections[0].notes]

    large = (2**60 + 3, 2**61)
    assert noted("reader", 11, 2**61) == [FOUND_SEEDS] and noted("reader", *large) == [
        REVEALED_ROADS
    ]
    assert noted("wiener", 11, 2**61) == noted("wiener", *large) == []
    for note in (f"Of a season. {SEALED_ROADS}", f"Their own. {PUBLIC_ROADS}"):
        assert noted("reader", *large, note=note) == []


def test_boards_whose_roads_are_not_public_come_first():
    shipped, own = load_task("new_road"), task(board="class")
    assert shipped.board_definition.order < own.board_definition.order
    board = Board((shipped, own), {"small": [], "new_road": []})
    assert [view.board for view in board_views(board)] == ["class", "new_road"]
    # a task of a results repository that is not sealed is as public as a shipped one
    open_to_all = task(name="mini", board="new_road", note=f"Its own. {PUBLIC_ROADS}")
    board = Board((open_to_all, own), {"small": [], "mini": []})
    assert [view.board for view in board_views(board)] == ["class", "new_road"]


@pytest.mark.costly
def test_the_only_entry_has_won_nothing():
    only = [r for r in results_by_fakes() if r.estimator in ("reader", "truth_plus_noise")]
    text = str(build_report(Board((task(),), {"small": only})).findings)
    assert "It is the only entry." in text and "first place" not in text


FAMILIES = {"roads": ["iso_b", "iso_e"], "seeds": [11, 12], "length": 40.0}


def test_an_entry_cannot_choose_how_much_a_condition_weighs_by_the_number_of_its_trainings():
    """One whose training depends on the seed where its error is low had three runs there."""
    picky, steady = run_task(task(), {"picky": Picky(), "steady": Picky(seeds=())},
                             (1, 2, 3), simulate=fake_drives)  # fmt: skip
    assert len(runs_of(picky)) == 20 and len(runs_of(steady)) == 10
    scores = picky.scores.sort_values("seed", ascending=False)  # the order is its author's
    picky = dataclasses.replace(picky, scores=scores)
    (view,) = board_views(Board((task(),), {"small": [picky, steady]}))
    error = {line.name: line.values["nrmse"] for line in view.sections[0].rows}
    assert error["picky"] == pytest.approx(error["steady"], abs=1e-6)


def test_the_slope_of_the_error_over_grades_is_shown():
    cars = [{"mode": "ride", "speed_kmh": 30.0, "grade": grade} for grade in ("S0", "S1", "S2")]
    t = task(board="field", conditions=cars)
    (result,) = run_task(t, {"reader": Reader()}, (1,), simulate=fake_drives)
    error = {c.label: 0.1 * (1 + k) for k, c in enumerate(t.conditions)}
    runs = {
        run: scores | {"nrmse": error[run[0]] + 0.01 * run[1]}
        for run, scores in runs_of(result).items()
    }
    (view,) = board_views(Board((t,), {"small": [with_runs(result, runs)]}))
    line, _ = view.sections[0].rows
    assert [line.values[f"grade_S{k}"] for k in range(3)] == pytest.approx([0.12, 0.22, 0.32])
    assert line.values["slope"] == pytest.approx(0.1)
    # the slope is the same on every road and roads are paired, so the interval has zero width
    assert (line.values["slope_low"], line.values["slope_high"]) == pytest.approx((0.1, 0.1))
    assert line.cells["slope"] == "+0.100" and line.cells["grade_S1"] == "0.220"
    assert view.sections[0].groups["car"] == ("car S0", "car S1", "car S2")


@pytest.mark.parametrize(
    ("score", "unit", "worst", "graded", "slope"),
    [("iri_error_relative", "%", "32", "22", "+10"), ("nrmse", "", "0.32", "0.220", "+0.100"),
     ("crps", "mm", "320.00", "220.00", "+100.00")],
)  # fmt: skip
def test_worst_drive_grades_and_slope_are_shown_in_the_unit_of_the_score_that_ranks(
    score, unit, worst, graded, slope, tmp_path
):
    cars = [{"mode": "ride", "speed_kmh": 30.0, "grade": grade} for grade in ("S0", "S1", "S2")]
    columns = [score, "worst", "grade_S1", "slope"]
    t = task(board={"title": "Mine", "ranks_by": score, "columns": columns}, conditions=cars)
    (result,) = run_task(t, {"reader": Reader()}, (1,), simulate=fake_drives)
    error = {c.label: 0.12 + 0.1 * k for k, c in enumerate(t.conditions)}
    runs = {run: scores | {score: error[run[0]]} for run, scores in runs_of(result).items()}
    made = Board((t,), {"small": [with_runs(result, runs)]})
    report = build_report(made)
    (view,) = report.views
    expected, units = (worst, graded, slope), (unit, unit, f"{unit} per grade".strip())
    row = view.sections[0].rows[0]
    assert tuple(row.cells[key] for key in columns[1:]) == expected
    forms = {column.key: column for column in board_columns("small", view.definition)}
    assert tuple(forms[key].unit for key in columns[1:]) == units
    assert f" On its worst drive it is {f'{worst} {unit}'.strip()}." in str(report.findings)
    cells = _table(view, view.sections[0])["data"]["rows"][0]["groups"][""]
    assert tuple(cells[key][1] for key in columns[1:]) == expected
    write_exports(made, report.views, tmp_path)
    assert all(text in (tmp_path / "export" / "small.tex").read_text() for text in expected)


def test_grades_that_are_driven_on_some_of_the_roads_have_a_slope():
    cars = [{"mode": "ride", "speed_kmh": 30.0, "grade": grade} for grade in ("S0", "S1")]
    test = FAMILIES | {"seeds": [*range(11, 15)], "families": ["level", "rough"]}
    t = task(board="field", conditions=cars, test=test | {"design": [[*range(6)], [*range(2, 8)]]})
    assert len(t.test.strata) == 2
    (result,) = run_task(t, {"reader": Reader()}, (1,), simulate=fake_drives)
    (view,) = board_views(Board((t,), {"small": [result]}))
    values = view.sections[0].rows[0].values
    assert values["slope"] == pytest.approx(values["grade_S1"] - values["grade_S0"])


def test_who_gives_deviations_on_some_drives_alone_has_no_scores_of_them():
    """They would be given where they fit; obstacles and others may be missing on a road."""
    result, names = result_of("reader"), ("coverage_90", "crps", "bump_recall")
    runs = {run: scores | dict.fromkeys(names, 0.9) for run, scores in runs_of(result).items()}
    for missing, expected in ((False, [0.9] * 3), (True, [None, None, 0.9])):
        runs[min(runs)] |= dict.fromkeys(names, np.nan) if missing else {}
        (view,) = board_views(Board((task(),), {"small": [with_runs(result, runs)]}))
        line = next(line for line in view.sections[0].rows if line.name == "reader")
        assert [line.values[name] for name in names] == pytest.approx(expected)


def test_causal_entries_also_have_a_rank_among_causal_entries():
    online = dataclasses.replace(result_of("learner"), causal=True)
    (view,) = board_views(Board((task(),), {"small": [result_of("reader"), online]}))
    ranks = {
        x.name: (x.values.get("rank"), x.values.get("rank_causal")) for x in view.sections[0].rows
    }
    assert ranks["learner"][1] == 1 and ranks["reader"][1] is None
    assert ranks["learner"][0] is not None


@pytest.mark.parametrize("roads", [5, 2])
def test_a_board_of_causal_entries_alone_gives_others_no_place(roads):
    """Neither a rank nor a place before causal entries, nor a sentence or a bar of the ranking."""
    seeds = [*range(11, 11 + roads)]
    test = {"roads": ["iso_d"], "seeds": seeds, "length": 40.0}
    t = task(board={"title": "Mine", "divisions": ["causal"]}, test=test)
    entries = {"offline": Reader(), "online": Reader(gain=0.7), "slow": Reader(gain=0.2)}
    made = [
        dataclasses.replace(r, causal=r.estimator != "offline")
        for r in run_task(t, entries, (1,), simulate=fake_drives)
    ]
    report = build_report(Board((t,), {"small": made}))
    ((section,),) = [view.sections for view in report.views]
    rows = {row.name: row for row in section.rows if row.state == "scored"}
    assert [*rows] == ["online", "slow", "offline"]
    assert rows["offline"].values["nrmse"] < rows["online"].values["nrmse"]
    ranks = [rows[name].values.get("rank_causal") for name in rows]
    assert ranks == ([1, 2, None] if roads == 5 else [None] * 3)
    (exported,) = as_json(report.views)
    assert not any("rank" in entry for entry in exported["entries"])
    first, _, last = headline(section)
    assert first.startswith("online is best of the causal entries: its error is") == (roads == 5)
    assert last.startswith(
        "The first place is decided: resampling the roads leaves slow, which is next, behind."
        if roads == 5
        else "Too few roads"
    )
    assert "offline" not in str(report.findings)
    bars = ranking_chart(section)
    assert "online" in str(bars) and "slow" in str(bars) and "offline" not in str(bars)
    alone = dataclasses.replace(section, rows=(rows["online"], rows["offline"]))
    assert headline(alone)[1] == "It is the only causal entry."


def printed(width):
    console = Console(width=width, file=io.StringIO())
    print_tables(build_report(board()), console)
    return console.file.getvalue()


@pytest.mark.parametrize("width", [80, 100])
def test_the_table_is_readable_on_a_narrow_terminal(width):
    text = printed(width)
    assert max(map(len, text.splitlines())) <= width
    for name in ENTRIES:
        assert any(line.startswith(name) for line in text.splitlines())
    assert "…" not in text
    assert "broken failed: ride, 14.5 km/h, estimating test drive 1 of 5" in " ".join(text.split())


def test_baselines_have_no_rank():
    (view,) = board_views(board())
    ranks = {line.name: line.values.get("rank") for line in view.sections[0].rows}
    assert {name for name, rank in ranks.items() if rank} == {"learner", "reader"}


def test_the_claimed_score_of_the_paper_is_a_row_of_its_own():
    t = task(board="paper", claimed_level_error=0.128)
    values = [dataclasses.replace(r, task_digest=t.digest) for r in results_by_fakes()]
    (view,) = board_views(Board((t,), {"small": values}))
    claim, *others = view.sections[0].rows
    assert (claim.state, claim.cells) == ("claim", {"level_error_raw": "12.8"})
    reader = next(line for line in others if line.name == "reader")
    assert float(reader.cells["level_error"]) == pytest.approx(10.0, abs=0.5)


def test_entries_better_than_truth_plus_noise_and_inconsistent_baselines_are_flagged():
    (view,) = board_views(board())
    assert view.sections[0].notes == (FOUND_SEEDS,)
    row = next(row for row in view.sections[0].rows if row.name == "reader")
    reader = result_of("reader")
    below = np.mean(run_scores(reader, "nrmse") < run_scores(reader, "bound_nrmse"))
    assert row.values["below_bound"] == pytest.approx(below) and 0.0 < below < 0.5
    (perfect,) = run_task(task(), {"perfect": Reader(gain=1.0)}, (1,), simulate=fake_drives)
    (note,) = flagged(perfect, result_of("truth_plus_noise"))
    assert note.startswith("perfect scores better than the truth with 2 % noise")
    better = run_task(task(), {"better": Reader(gain=0.96)}, (1,), simulate=fake_drives)
    (note,) = flagged(*better)
    shares = run_scores(better[0], "nrmse") < run_scores(better[0], "bound_nrmse")
    assert note == (
        "better is below the bound of a linear car without friction, from data below 25 Hz, on "
        f"{shares.mean():.0%} of its drives"
    )
    (note,) = flagged(dataclasses.replace(result_of("reader"), estimator="flat", role="baseline"))
    assert note.startswith("the evaluation is faulty: flat scores 0.1")


@pytest.mark.parametrize("key", ["nrmse", "dsd_distance_db"])
def test_an_entry_is_flagged_by_the_score_that_ranks_and_by_the_nrmse(key):
    noisy = Row("truth_plus_noise", "baseline", values={"nrmse": 0.02, "dsd_distance_db": 0.01})
    mirror = {"nrmse": 2.0, "dsd_distance_db": 0.9} | {key: 0.0}
    (note,) = sanity_warnings([noisy, Row("mirror", "scored", values=mirror)], "dsd_distance_db")
    assert note.startswith("mirror scores better than the truth with 2 % noise")


def flagged(*results):
    (view,) = board_views(Board((task(),), {"small": results}))
    return [note for note in view.sections[0].notes if note != FOUND_SEEDS]


def test_the_json_output_has_the_rows_of_the_table():
    (section,) = json.loads(json.dumps(as_json(build_report(board()).views), allow_nan=False))
    entries = {entry["name"]: entry for entry in section["entries"]}
    assert section["task"] == "small" and set(entries) == {*ENTRIES, "bound"}
    assert 0.02 < entries["bound"]["nrmse"] < entries["reader"]["nrmse"] + 0.1
    assert entries["reader"]["nrmse"] == pytest.approx(0.1, abs=0.005)
    assert entries["broken"]["state"] == "failed" and "finite" in entries["broken"]["text"]


def test_a_board_none_of_whose_columns_has_a_value_is_exported(tmp_path):
    mine = {"title": "Mine", "ranks_by": "bump_wrong_side", "columns": ["bump_wrong_side"]}
    t = task(board=mine)
    made = Board((t,), {"small": [dataclasses.replace(r, task_digest=t.digest)
                                  for r in results_by_fakes()]})  # fmt: skip
    write_exports(made, board_views(made), tmp_path)
    text = (tmp_path / "export" / "small.tex").read_text()
    assert "reader" in text and "failed: ride" in text


def test_exports_of_a_board_that_is_no_longer_there_go_and_other_files_stay(tmp_path):
    made = board()
    views = board_views(made)
    write_exports(made, views, tmp_path)
    folder = tmp_path / "export"
    current = {path.name for path in folder.iterdir()}
    for suffix in ("parquet", "csv", "json", "tex"):
        (folder / f"gone.{suffix}").write_text("old numbers")
    (folder / "mine.csv").write_text("of the user")
    write_exports(made, views, tmp_path)
    assert {path.name for path in folder.iterdir()} == current | {"mine.csv"}


def test_notes_of_a_surface_are_printed():
    t = task(board="measured")
    tiled = "10 m tile mirrored 10 times"
    noted = [
        dataclasses.replace(r, task_digest=t.digest, notes=(tiled, f"{r.estimator}: remembers"))
        for r in results_by_fakes()
    ]
    (view,) = board_views(Board((t,), {"small": noted}))
    assert f"Surface: {tiled}." in view.sections[0].notes
    assert "reader: remembers." in view.sections[0].notes


def test_shipped_weights_are_noted_on_every_car_that_they_do_not_know():
    """Of all conditions, also where the car of the task is that of their training."""
    shipped, own = (
        dataclasses.replace(result_of("reader"), estimator=name, settings={"shipped": True})
        for name in ("tcn", "mine")  # a file of `train`, or one by others
    )
    cars = (None, "volkswagen_vanagon", "bmw_320i")
    driven = [{"mode": "passive", "speed_kmh": 50.0, "car": car} for car in cars]
    for conditions, others in ((driven[:1], ""), (driven, "volkswagen_vanagon, bmw_320i")):
        text = f"tcn: trained on drives of land_rover_defender_110, not of {others}."
        notes = _protocol_notes(task(conditions=conditions), [shipped, own])
        assert notes == ([text] if others else [])


def test_who_was_made_for_other_sensors_than_those_of_the_task_is_noted(tmp_path):
    rows = {
        "tcn": {"shipped": True},
        "mine": {"shipped": True},
        "wiener": {"instruments": "paper"},
        "own": {},
    }
    results = [
        dataclasses.replace(result_of("reader"), estimator=name, settings=settings)
        for name, settings in rows.items()
    ]
    sheet = yaml.safe_load((config.folder() / "sensors/paper.yaml").read_text())
    places = sheet["accelerometers"] | {"RF": {"axle": "front", "ahead": 0.0, "y": -0.55}}
    changes = {"same": {}, "moved": {"accelerometers": places}, "slow": {"f_alias": 40.0}}
    for name, change in changes.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump({**sheet, **change, "name": name}))
        notes = _protocol_notes(task(instruments=str(tmp_path / f"{name}.yaml")), results)
        weights = [f"tcn: trained with the sensors of paper, not of {name}."]
        models = [f"wiener: with noise and filter of the sensors of paper, not of {name}."]
        assert notes == {"same": [], "moved": weights, "slow": weights + models}[name]


def test_rows_made_with_another_version_of_a_library_are_noted():
    results = results_by_fakes()
    usual = {"numpy": "2.4", "scipy": "1.17", "numba": "0.68", "torch": "2.9"}
    first, second, *others = (dataclasses.replace(r, environment=usual) for r in results)
    assert _version_notes([first, second, *others]) == []
    for name in usual:
        moved = [dataclasses.replace(r, environment=usual | {name: "0.1"}) for r in (first, second)]
        assert _version_notes([*moved, *others]) == [
            f"{first.estimator}, {second.estimator} ran with {name} 0.1, "
            f"the others with {usual[name]}."
        ]
    del usual["torch"]  # where it isn't installed, it has made no row
    assert _version_notes([dataclasses.replace(first, environment=usual), second, *others]) == []


def test_rows_made_under_another_python_are_noted_but_for_its_last_number():
    first, *others = (
        dataclasses.replace(r, environment={"python": "3.11.4"}) for r in results_by_fakes()
    )
    for version in ("3.11.9", "3.11.4 or 3.11.9"):
        same = dataclasses.replace(first, environment={"python": version})
        assert _version_notes([same, *others]) == []
    for version, name in (("3.12.4", "3.12"), ("3.11.4 or 3.12.4", "3.11 or 3.12")):
        moved = dataclasses.replace(first, environment={"python": version})
        text = f"{first.estimator} ran with python {name}, the others with 3.11."
        assert _version_notes([moved, *others]) == [text]


def test_rows_of_another_number_of_training_seeds_are_noted():
    def notes(*rows):
        (view,) = board_views(Board((task(),), {"small": rows}))
        return [note for note in view.sections[0].notes if "training seed" in note]

    steady = dataclasses.replace(result_of("learner"), estimator="steady")
    (lucky,) = run_task(task(), {"lucky": Learner()}, (1,), simulate=fake_drives)
    text = "lucky ran with 1 training seed, the others with 3 training seeds."
    assert notes(steady, lucky) == [text]
    made = Board((task(),), {"small": [steady, lucky]})
    assert text in as_json(board_views(made))[0]["notes"]
    assert "; trainings: 1 to 3" in _drive_counts(task(), [steady, lucky])
    assert _drive_counts(task(), [steady]).endswith("; trainings: 3")
    # without a training, or with one that ignores the seed, no number of seeds is another's
    (alone,) = run_task(task(), {"alone": Reader()}, (1,), simulate=fake_drives)
    same = dataclasses.replace(lucky, seeds=(1, 2))
    by_others = dataclasses.replace(lucky, settings={"shipped": True})
    shipped = dataclasses.replace(by_others, estimator="tcn")
    for other in (alone, same, shipped, result_of("reader")):
        assert notes(steady, other) == []
    assert notes(steady, by_others) == [text]
    assert _drive_counts(task(), [alone, result_of("reader")]).endswith("; trainings: 3")


def test_a_training_that_leaves_no_parameters_is_shown():
    trained = dataclasses.replace(result_of("reader"), parameters=None, train_seconds=(4.0, 5.0))
    assert train_seconds(trained) == 4.5
    assert train_seconds(dataclasses.replace(trained, train_seconds=(1e-3,))) is None
    assert train_seconds(dataclasses.replace(trained, train_seconds=())) is None
