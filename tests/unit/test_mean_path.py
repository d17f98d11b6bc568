"""Reports from sensors that tell no roll; known IRI; the order of notes; indices of a profile."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from phone_recordings import FOLDER

from estimators.common.misfit import misfit_note
from leaderboard.commands.report import report
from leaderboard.drive_report.analysis import KnownFactor, analyse
from leaderboard.drive_report.conditions import load_conditions
from leaderboard.drive_report.drive_estimates import make_drive_estimator
from leaderboard.drive_report.known_iri import known_factor, read_known_iri
from leaderboard.drive_report.mean_path import _path_ratio, path_level_ratio, tells_paths_apart
from leaderboard.drive_report.notes import in_order_of_weight, vehicle_in_words
from leaderboard.drive_report.passes import ReportedPass
from leaderboard.drive_report.report import _with_factor_told
from road_envs.core.config import ConfigError
from road_envs.drives.logger_tables.description import PLACES, DriveDescription
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.drives.reading import read_drive
from road_envs.records.accelerometers import Accelerometer
from road_envs.records.record import Estimate, Record, profile_stations
from road_envs.records.roughness import golden_car, iri, profile_indices
from road_envs.roads import realise_road, write_csv
from road_envs.sensing.instruments import load_instruments

HPMS = load_conditions("hpms")
ONE = {"PHONE": PLACES["dashboard"]}


def result(seed=1, layout=ONE, length=300.0, gap=None, **options):
    """The report of a perfect estimate of a road of class C, level where nothing was read."""
    surface = realise_road("iso_c", seed, length)
    s = profile_stations(length)
    t = np.arange(4001) / 200.0
    off = np.zeros((t.size, 4), dtype=bool)
    k = len(layout) if layout else 3
    a = np.random.default_rng(seed).standard_normal((k, t.size))
    record = Record(t, a, np.full(t.size, 15.0), 15.0 * t, off, off, length, layout)
    estimate = Estimate(s, surface.height(s), np.full((2, s.size), 1e-4))
    if gap is not None:
        a[:, (record.s > gap[0]) & (record.s < gap[1])] = np.nan
        slopes = np.where((s > gap[0]) & (s < gap[1]), 0.0, np.diff(estimate.z, prepend=0.0))
        estimate = replace(estimate, z=np.cumsum(slopes, axis=1))
    return surface, analyse("one", MeasuredRecord(record), estimate, HPMS, **options)


def test_the_ratio_of_iri_and_hri_is_that_of_random_roads():
    ratios = []
    for seed in range(20):
        surface = realise_road("iso_b", seed, 500.0)
        z = surface.height(0.05 * np.arange(9990))
        motion = np.abs(golden_car(np.stack([*z, z.mean(axis=0)]), 0.05)).mean(axis=1)
        ratios.append(motion[:2].mean() / motion[2])
    assert _path_ratio() == pytest.approx(np.mean(ratios), rel=0.02)
    assert 1.15 < _path_ratio(2.3, 1.3) < _path_ratio() < _path_ratio(1.8, 1.8) < 1.4
    assert path_level_ratio(0.01) == pytest.approx(1.0, abs=0.02)
    assert path_level_ratio(2.0) == pytest.approx(2.0, abs=0.02)


def test_one_sensor_gives_hri_and_an_iri_and_no_left_and_right():
    """The ratio of isotropic roads, as these are, is 2 % above the one that is expected."""
    errors, inside = [], []
    for seed in range(12):
        surface, found = result(seed)
        true = iri(surface.z, surface.ds, segment=100.0).mean(axis=0)
        for row, x in zip(found.segments, true, strict=False):
            assert "iri_left" not in row and row["hri_high"] < row["iri_mean_high"]
            errors.append(row["iri_mean"] / x - 1.0)
            inside.append(row["iri_mean_low"] <= x <= row["iri_mean_high"])
    assert -0.07 < np.mean(errors) < 0.02 and np.std(errors) < 0.1
    assert np.mean(inside) > 0.9
    assert found.is_mean_path and any("do not tell left from right" in n for n in found.notes)
    assert {o["wheel_path"] for o in found.obstacles} <= {"not told"}


@pytest.mark.costly
def test_where_nothing_was_read_the_road_is_taken_as_rough_as_elsewhere():
    errors, inside, width = [], [], []
    for seed in range(12):
        surface, found = result(seed, gap=(110.0, 170.0))
        true = iri(surface.z, surface.ds, segment=100.0).mean(axis=0)[1]
        row, other = found.segments[1], result(seed)[1].segments[1]
        errors.append(row["iri_mean"] / true - 1.0)
        inside.append(row["iri_mean_low"] <= true <= row["iri_mean_high"])
        width.append(np.log(row["iri_mean_high"] / row["iri_mean_low"]))
        width[-1] /= np.log(other["iri_mean_high"] / other["iri_mean_low"])
        assert row["class"] == other["class"]
    assert abs(np.mean(errors)) < 0.08 and np.mean(inside) > 0.9 and np.mean(width) > 1.05


def test_the_class_is_that_of_a_wheel_path_and_not_of_the_mean_path():
    letters = [row["class"] for seed in range(10) for row in result(seed)[1].segments]
    assert letters.count("C") > 0.9 * len(letters)


@pytest.mark.parametrize(
    ("layout", "apart"),
    [
        (None, True),
        (ONE, False),
        ({"A": PLACES["dashboard"], "B": PLACES["trunk"]}, False),
        ({"A": Accelerometer(y=0.3), "B": Accelerometer(y=-0.3)}, True),
        ({"A": Accelerometer(mounted="rear axle", y=0.3), "B": Accelerometer(y=-0.3)}, False),
        ({k: Accelerometer(mounted="rear axle", y=y) for k, y in (("A", 0.6), ("B", -0.6))}, True),
    ],
)
def test_sensors_beside_one_another_tell_the_paths_apart(layout, apart):
    assert tells_paths_apart(layout) == apart


def test_one_sensor_whose_record_is_not_reproduced_has_a_wider_interval():
    surface, found = result()
    z = np.full((2, profile_stations(300.0).size), 1e-4)
    s = profile_stations(300.0)
    noted = Estimate(s, surface.height(s), z, residual=4.0)
    wide = analyse("one", found.measured, noted, HPMS).segments[1]
    narrow = found.segments[1]
    width = [np.log(row["iri_mean_high"] / row["iri_mean_low"]) for row in (wide, narrow)]
    assert width[0] > 1.4 * width[1]


@pytest.mark.parametrize(("residual", "told"), [(6.0, True), (10.0, False)])
def test_an_iri_has_no_interval_where_the_model_is_far_from_the_record(residual, told):
    surface, found = result(layout=None)
    s = profile_stations(300.0)
    z = surface.height(s)
    draws = z + 1e-4 * np.random.default_rng(0).standard_normal((8, *z.shape))
    estimate = Estimate(s, z, None, draws=draws, residual=residual)
    doubted = analyse("one", found.measured, estimate, HPMS)
    assert np.isfinite(doubted.segments[1]["iri_mean_high"]) == told
    assert any("IRI has no interval" in note for note in doubted.notes[:2]) != told
    assert doubted.segments[1]["iri_mean"] == pytest.approx(found.segments[1]["iri_mean"], rel=0.1)


def test_with_sensors_on_both_sides_both_paths_are_told():
    surface, found = result(layout=None)
    true = iri(surface.z, surface.ds, segment=100.0)
    assert found.segments[1]["iri_left"] == pytest.approx(true[0, 1], rel=0.05)
    assert not found.is_mean_path and "hri" not in found.segments[0]


def test_obstacles_are_possible_where_the_model_does_not_reproduce_the_record():
    surface, found = result(layout=None)
    z = surface.height(profile_stations(300.0))
    z[:, 4000:4100] += 0.2
    bad = Estimate(profile_stations(300.0), z, residual=4.0)
    measured = found.measured
    doubted = analyse("one", measured, bad, HPMS).obstacles
    near = Estimate(bad.s, z, residual=1.7)
    certain = analyse("one", measured, near, HPMS).obstacles
    assert doubted and all(o["kind"].startswith("possible") for o in doubted)
    assert any(not o["kind"].startswith("possible") for o in certain)


def test_a_known_iri_gives_the_factor_of_car_and_mount(tmp_path):
    _, found = result()
    mean = found.facts["iri_mean"]
    known, note = known_factor(found, read_known_iri(f"{1.2 * mean}"))
    assert known.factor == pytest.approx(1.2, rel=1e-6) and "300 m of known IRI" in note
    corrected = result(known=known)[1]
    assert corrected.facts["iri_mean"] == pytest.approx(1.2 * mean, rel=0.03)
    (tmp_path / "k.csv").write_text(f"begin_m,end_m,iri\n100,200,{found.segments[1]['iri_mean']}\n")
    short, _ = known_factor(found, read_known_iri(str(tmp_path / "k.csv")))
    assert short.factor == pytest.approx(1.0) and short.std > known.std
    assert isinstance(short, KnownFactor)


def test_a_factor_of_the_description_is_told():
    each = ReportedPass("one", MeasuredRecord(record=None), None, None)
    for factor in (None, 0.55):
        drive = SimpleNamespace(description=DriveDescription(iri_factor=factor))
        notes = _with_factor_told(each, drive).measured.notes
        assert any("multiplied by 0.55" in note for note in notes) == (factor is not None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("-1", "must be an IRI of 0.1 to 30"),
        ("100", "must be an IRI of 0.1 to 30"),
        ("nan", "must be an IRI of 0.1 to 30"),
        ("missing.csv", "missing.csv: cannot be read"),
        ("29", "more than a car and a mount explain"),
    ],
)
def test_a_known_iri_that_cannot_be_is_refused(text, message):
    with pytest.raises(ConfigError, match=message):
        known_factor(result()[1], read_known_iri(text))


@pytest.mark.parametrize("text", ["100", "k.csv"])
def test_a_known_iri_is_read_before_the_estimate(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "k.csv").write_text("begin_m,end_m,iri\n0,100,3;2\n")
    with pytest.raises(ConfigError, match=r"must be an IRI of|k\.csv: neither an IRI nor a table"):
        report(drives=[tmp_path / "absent.csv"], known_iri=text, options=None)


def test_notes_stand_in_the_order_of_their_weight():
    notes = (
        "lat: values every 1 s are interpolated",
        "something else",
        "the device is mounted with its z axis 18 degrees from the vertical",
        misfit_note(33.8),
        "the record fits a speed of 10 km/h better",
        "lon: values every 1 s are interpolated",
        "lat: values every 1 s are interpolated",
    )
    slow = "lat, lon: values every 1 s are interpolated"
    assert in_order_of_weight(notes) == (notes[3], notes[4], notes[2], notes[1], slow)


def test_indices_of_a_profile_are_those_of_its_paths_and_of_their_mean():
    surface = realise_road("iso_c", 3, 250.0)
    rows = profile_indices(surface.z, surface.ds, 100.0)
    assert [(r["begin_m"], round(r["end_m"])) for r in rows] == [(0, 100), (100, 200), (200, 250)]
    expected = iri(surface.z, surface.ds, segment=100.0)
    assert [r["left"] for r in rows[:2]] == pytest.approx(list(expected[0]), rel=1e-6)
    assert [r["mean"] for r in rows[:2]] == pytest.approx(list(expected.mean(axis=0)), rel=1e-6)
    half = iri(surface.z.mean(axis=0), surface.ds, segment=100.0)
    assert [r["half_car"] for r in rows[:2]] == pytest.approx(list(half), rel=1e-6)
    (whole,) = profile_indices(surface.z, surface.ds, np.inf)
    assert whole["left"] == pytest.approx(float(iri(surface.z[0], surface.ds)), rel=1e-6)
    with pytest.raises(ValueError, match=r"at most 0\.3 m"):
        profile_indices(surface.z, 0.5, 100.0)


def test_the_command_iri_reads_a_profile(road_recon, tmp_path):
    surface = realise_road("iso_c", 3, 250.0)
    write_csv(surface, tmp_path / "road.csv")
    code, out, err = road_recon("iri", "road.csv", "--json")
    assert code == 0, err
    told = json.loads(out)
    (whole,) = profile_indices(surface.z, surface.ds, np.inf)
    assert told["whole"]["mean"] == pytest.approx(whole["mean"], rel=1e-3)
    assert len(told["segments"]) == 3
    code, out, _ = road_recon("iri", "road.csv", "--segment", "50")
    assert code == 0 and out.count("\n│") == 6
    code, _, err = road_recon("iri", "nowhere.csv")
    assert code == 2 and "no such file" in err


def test_an_obstacle_adds_as_much_to_the_iri_as_to_hri_in_one_path_or_in_both():
    """It is not expected to have a difference in proportion, as the waves of a smooth road have."""
    for share in (1.0, 0.0):  # in both paths, in the left one alone
        surface, found = result(3)
        s = profile_stations(300.0)
        bump = 0.05 * np.where(np.abs(s - 150.0) < 1.85, np.cos(np.pi * (s - 150.0) / 3.7), 0.0)
        z = 0.25 * surface.height(s) + np.stack([(2.0 - share) * bump, share * bump])
        ds = s[1] - s[0]
        motion = 1e3 * np.abs(golden_car(z, ds)).mean(axis=0)
        true = motion[(s[: motion.size] >= 100.0) & (s[: motion.size] < 200.0)].mean()
        row = analyse("one", found.measured, Estimate(s, z, None), HPMS).segments[1]
        assert row["iri_mean"] == pytest.approx(true, rel=0.05)
        assert row["iri_mean_low"] < true < row["iri_mean_high"]


def test_one_device_does_not_identify_its_vehicle():
    drive = read_drive(FOLDER / "phyphox.zip", vehicle="bmw_320i")
    assert not make_drive_estimator("map_smoother", drive, {}).adapt
    assert make_drive_estimator("map_smoother", drive, {"adapt": True}).adapt


def test_three_devices_identify_it_unless_the_report_shall_be_fast():
    drive = read_drive(FOLDER / "phyphox.zip", vehicle="bmw_320i")
    three = load_instruments("phone").accelerometers
    record = replace(drive.measured.record, a=np.zeros((3, 9)), sensors=three)
    drive = drive._replace(measured=drive.measured._replace(record=record))
    assert make_drive_estimator("map_smoother", drive, {}).adapt
    assert not make_drive_estimator("map_smoother", drive, {}, fast=True).adapt


def test_the_page_says_whether_the_vehicle_was_fitted_to_its_drive():
    """By the notes of `estimators`; their words are those that it writes."""
    _, found = result(3)
    assert found.facts["vehicle"] == "as described"
    bent, frame = "the body bends at 18 Hz, by a peak, and was adapted", "the frame was adapted"
    told = found.measured._replace(notes=(bent, frame))
    assert analyse("one", told, found.estimate, HPMS).facts["vehicle"] == "fitted to the drive"
    assert vehicle_in_words([bent]) == "as described, but for the bending of its body"
