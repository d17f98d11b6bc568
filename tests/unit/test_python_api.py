"""The Python interface: simulate, estimate, score, plot and run a task in a few lines."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from fake_estimators import Broken, Reader
from fake_results import run_scores
from fakes import fake_drives, task

from estimators import create, estimate, make_estimator
from leaderboard import load_task, plot, run_task, score, score_arrays
from leaderboard.evaluation import evaluate
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.bootstrap import interquartile_mean
from leaderboard.metrics.registry import PRINTED_SCORES, SCORES, compute_scores
from road_envs import simulate_record
from road_envs.core.config import ConfigError
from road_envs.records.record import Estimate


@pytest.fixture(scope="module")
def drive():
    return simulate_record("iso_d", speed_kmh=36.0, mode="handling", seed=1, length=40.0)


def test_a_drive_is_simulated_and_scored_in_three_lines(drive):
    record, truth = drive
    result = estimate("fir_ridge", record)
    table = score(result, truth)
    expected = compute_scores(ScoredEstimate(truth, result, float(np.median(record.v)), bumps=True))
    np.testing.assert_equal(table.values, expected)
    assert table["nrmse"] < 0.6 and result.speed == pytest.approx(10.0, rel=0.01)
    lines = str(table).splitlines()
    assert 5 < len(lines) <= len(PRINTED_SCORES) and "in-band NRMSE" in lines[0]


def test_the_same_seed_gives_the_same_drive_and_another_seed_another_road(drive):
    record, truth = drive
    again, _ = simulate_record("iso_d", speed_kmh=36.0, mode="handling", seed=1, length=40.0)
    _, other = simulate_record("iso_d", speed_kmh=36.0, mode="handling", seed=2, length=40.0)
    np.testing.assert_array_equal(again.a, record.a)
    assert np.abs(other.z - truth.z).max() > 0.001


def test_the_table_of_scores_converts_to_pandas_in_printed_units(drive):
    record, truth = drive
    table = score(estimate("flat", record), truth)
    frame = table.to_pandas()
    assert list(frame.columns) == ["label", "value", "unit"] and frame.index.is_unique
    assert frame.loc["nrmse", "value"] == pytest.approx(1.0)
    assert frame.loc["level_error", "value"] == pytest.approx(100.0)  # [%]
    assert frame.loc["level_error", "unit"] == "%"


def test_an_estimate_without_speed_or_on_other_stations_is_refused(drive):
    _, truth = drive
    bare = Estimate(truth.s, truth.z)
    with pytest.raises(ConfigError, match="give the speed of its drive as speed_kmh"):
        score(bare, truth)
    assert score(bare, truth, speed_kmh=36.0)["nrmse"] == 0.0
    short = Estimate(truth.s[:-5], truth.z[:, :-5], speed=10.0)
    with pytest.raises(ConfigError, match="both must be on the same ones"):
        score(short, truth)
    with pytest.raises(ConfigError, match="both must be on the same ones"):
        plot(short, truth)


def test_a_plot_is_a_figure_with_both_paths_raw_and_in_band(drive):
    record, truth = drive
    figure = plot(estimate("fir_ridge", record), truth)
    assert [axes.get_ylabel() for axes in figure.axes] == [
        f"{side}{band} [mm]" for side in ("left", "right") for band in ("", ", in band")
    ]
    (truth_line, _) = figure.axes[0].lines[:2]
    np.testing.assert_allclose(truth_line.get_ydata(), 1000.0 * truth.z[0])


def test_settings_belong_to_names_and_not_to_objects_or_files(drive):
    record, _ = drive
    with pytest.raises(ConfigError, match="need an estimator by name"):
        estimate(create("flat"), record, reach=3.0)
    with pytest.raises(ConfigError, match="no module 'nowhere' in this folder or installed"):
        make_estimator("nowhere:Mine")
    with pytest.raises(ConfigError, match=r"the module estimators\.api has no Mine"):
        make_estimator("estimators.api:Mine")
    with pytest.raises(ConfigError, match="takes no others"):
        make_estimator("model.npz", reach=3.0)
    assert type(make_estimator("fake_estimators:Reader", gain=0.5)) is Reader


def test_a_task_gives_a_row_for_each_drive_and_one_for_a_failure():
    short = task(test={"roads": ["iso_d"], "seeds": [11, 12], "length": 40.0})
    steps = []
    table = run_task(
        short, {"zero": "flat", "mine": Reader(gain=0.0), "bad": Broken(how="nan")}, roads=1,
        report=steps.append,
    )  # fmt: skip
    drives = table[table.estimator != "bad"]
    assert list(drives.estimator) == ["zero"] * 2 + ["mine"] * 2
    assert drives.nrmse.tolist() == pytest.approx([1.0] * 4)
    assert set(drives.condition) == {c.label for c in short.conditions}
    (failed,) = table[table.estimator == "bad"].failure
    assert "must be finite" in failed and len(steps) == 8
    assert set(SCORES) & set(table.columns) and table.attrs["labels"]["nrmse"] == "in-band NRMSE"
    with pytest.raises(ConfigError, match="number of drives must be 1 to 2, got 3"):
        run_task(short, ["flat"], roads=3)


@pytest.mark.costly
def test_a_registered_name_is_trained_on_the_test_road_as_on_a_board():
    short = task(trains_on_test_road=True, test={"roads": ["iso_d"], "seeds": [11], "length": 40.0})
    entries = {"board": "fir_ridge", "refit": create("fir_ridge", shipped=False)}
    table = run_task(short, entries | {"as it is": create("fir_ridge")})
    found = {name: rows.nrmse.tolist() for name, rows in table.groupby("estimator")}
    assert found["board"] == found["refit"] != found["as it is"]
    elsewhere = run_task(dataclasses.replace(short, trains_on_test_road=False), ["fir_ridge"])
    assert elsewhere.nrmse.tolist() == found["as it is"]


def test_no_name_of_a_class_makes_its_estimates_from_the_truth():
    builtin = type("builtin", (Reader,), {})
    short = task(test={"roads": ["iso_d"], "seeds": [11], "length": 40.0})
    assert run_task(short, {"own": builtin(gain=0.0)}).nrmse.tolist() == pytest.approx([1.0] * 2)


def test_importing_the_packages_loads_neither_kernels_nor_plots():
    code = (
        "import sys, road_envs, leaderboard\n"
        "print([m for m in ('numba', 'torch', 'matplotlib', 'pandas') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        (lambda record, truth: estimate(record, "wiener"), "the second argument is a str"),
        (lambda record, truth: estimate(None, record), "this is a NoneType"),
        (lambda record, truth: score(truth, estimate("flat", record)), "given: Profile, Estimate"),
        (lambda record, truth: plot(truth, truth), "given: Profile, Profile"),
    ],
)
def test_arguments_of_another_kind_are_named(drive, call, reason):
    with pytest.raises(TypeError, match=reason):
        call(*drive)


@pytest.fixture(scope="module")
def plain():
    return load_task(task(), simulate=fake_drives)


def test_a_task_is_scored_in_three_lines_without_our_classes(plain):
    """The first two "accelerations" of the fake drives are the heights of the wheel paths."""
    heights = [
        [0.7 * np.interp(drive["stations"], drive["s"], path) for path in drive["a"][:2]]
        for drive in plain.test
    ]
    row = score_arrays(plain, heights)
    results = evaluate.run_task(task(), {"reader": Reader(gain=0.7)}, (1,), simulate=fake_drives)
    for name in ("nrmse", "r", "level_error", "iri_error"):
        expected = interquartile_mean(run_scores(results[0], name).ravel())
        assert row[name] == pytest.approx(expected, rel=1e-9), name
    assert 0.25 < row["nrmse"] < 0.35 and np.isnan(row["coverage_90"])
    std = [np.full_like(z, 0.01) for z in heights]
    assert np.isfinite(score_arrays(plain, heights, std)["coverage_90"])


def test_the_arrays_of_a_task_hold_the_truth_of_training_and_none_of_the_tests(plain):
    assert {drive["condition"] for drive in plain.test} == {c.label for c in task().conditions}
    assert len(plain.training) == 4 and len(plain.test) == 10
    for drive in (*plain.training, *plain.test):
        assert drive["a"].shape == (3, drive["t"].size) and drive["spring_stiff"].shape[1] == 4
        assert all(not isinstance(x, Estimate) for x in drive.values())
    assert all(drive["z"].shape == (2, drive["stations"].size) for drive in plain.training)
    assert all("z" not in drive for drive in plain.test)
    assert plain.vehicle["name"] and "_data" not in repr(plain)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda z: z[:-1], "has 10 test drives, got 9 heights"),
        (lambda z: [*z[:-1], z[-1][:1]], r"test drive 10 needs finite heights of the shape \(2, "),
        (lambda z: [z[0] * np.nan, *z[1:]], "test drive 1 needs finite heights"),
    ],
)
def test_arrays_of_another_number_or_shape_are_refused(plain, change, sentence):
    heights = [np.zeros((2, drive["stations"].size)) for drive in plain.test]
    with pytest.raises(ConfigError, match=sentence):
        score_arrays(plain, change(heights))
