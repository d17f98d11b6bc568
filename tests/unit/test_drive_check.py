"""Other readings of a drive: a wrong one is noticed, and no doubt is raised where all is right."""

from dataclasses import replace

import numpy as np
import pytest
from vehicle_fixtures import DEFENDER

from estimators.wiener import drive_check
from estimators.wiener.drive_check import _without_obstacles, check_notes, side_notes
from estimators.wiener.tuning import TUNING
from leaderboard.drive_report import drive_estimates
from leaderboard.drive_report.drive_estimates import with_doubts
from road_envs.core import config
from road_envs.drives.logger_tables.description import DriveDescription
from road_envs.drives.measured_record import MeasuredRecord
from road_envs.drives.reading import DriveFile
from road_envs.drives.recording import read_record, simulate_record
from road_envs.records.record import Record
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.struts import MODES


def drive(road, speed, mode, grade="S0", seed=5, length=80.0):
    record, _ = simulate_record(
        road, speed_kmh=speed, mode=mode, seed=seed, grade=grade, length=length
    )
    return record


def told(record, mode):
    stiff, high = MODES[mode]
    return replace(
        record,
        spring_stiff=np.full_like(record.spring_stiff, stiff),
        damper_high=np.full_like(record.damper_high, high),
    )


@pytest.mark.parametrize(
    ("road", "speed", "mode", "grade"),
    [
        ("iso_b", 50, "handling", "S0"),
        pytest.param("iso_d", 15, "handling", "S1", marks=pytest.mark.slow),
        pytest.param("iso_b", 15, "ride", "S1", marks=pytest.mark.slow),
    ],
)
@pytest.mark.costly
def test_a_wrong_mode_is_noticed_and_the_right_one_is_not_doubted(road, speed, mode, grade):
    record = drive(road, speed, mode, grade)
    assert check_notes(record, DEFENDER, "paper") == ()
    wrong = "handling" if mode == "ride" else "ride"
    (note,) = check_notes(told(record, wrong), DEFENDER, "paper")
    assert f"{wrong} is described (--mode)" in note


@pytest.mark.parametrize(
    ("road", "speed", "mode"),
    [("iso_b", 15, "ride"), ("iso_d", 50, "handling")],
)
@pytest.mark.slow
def test_a_vehicle_far_from_its_description_raises_no_doubt(road, speed, mode):
    assert check_notes(drive(road, speed, mode, "S2"), DEFENDER, "paper") == ()


def test_samples_about_obstacles_are_left_out_unless_most_are():
    t = np.arange(2000) / 200.0
    off = np.zeros((t.size, 4), dtype=bool)
    a = np.random.default_rng(1).standard_normal((3, t.size)) / 3.0
    a[1, [600, 1400]] = 9.0
    record = Record(t, a, np.full(t.size, 10.0), 10.0 * t, off, off, 100.0)
    lost = np.isnan(_without_obstacles(record).a)
    assert (lost == lost[0]).all()
    assert list(np.flatnonzero(np.diff(lost[0].astype(int)))) == [519, 680, 1319, 1480]
    a[1, ::150] = 9.0
    np.testing.assert_array_equal(_without_obstacles(record).a, a)


@pytest.mark.slow
def test_obstacles_raise_no_doubt():
    """Wheels that lift off behind a hump are no sign of another mode."""
    hump = {"shape": "half_sine", "at": 35.0, "length": 3.7, "height": 0.075}
    bump = {"shape": "half_sine", "at": 60.0, "length": 0.9, "height": 0.03}
    defects = {"kind": "defects", "length": 80.0, "defects": [hump, bump]}
    ground = {"kind": "iso8608", "road_class": "C", "length": 80.0}
    road = {"kind": "superposed", "roads": [ground, defects]}
    record = drive(road, 50, "handling", "S2", seed=2, length=None)
    assert check_notes(record, DEFENDER, "paper") == ()


def test_a_drive_that_changes_its_state_is_not_checked():
    record = told(drive("iso_b", 50, "ride"), "handling")
    record.damper_high[:50] = False
    assert check_notes(record, DEFENDER, "paper") == ()


def test_one_of_the_other_readings_is_the_right_one():
    """Whatever is wrong: the unit of the speed, a sign, or the order of two channels."""
    right = replace(drive("iso_b", 50, "ride"), a=np.arange(9.0).reshape(3, 3) + 1.0)
    wrong = [
        replace(right, v=right.v / 0.44704, s=right.s / 0.44704),
        replace(right, v=3.6 * right.v, s=3.6 * right.s),
        replace(right, a=right.a * np.array([[1.0], [-1.0], [1.0]])),
        replace(right, a=right.a[[0, 2, 1]]),
    ]
    for record in wrong:
        found = [other.record for other in drive_check._other_readings(record)]
        assert any(
            np.array_equal(one.a, right.a)
            and np.allclose(one.v, right.v)
            and np.allclose(np.diff(one.s), np.diff(right.s))
            for one in found
        )


@pytest.mark.parametrize("known", [False, True])
def test_a_known_speed_is_not_doubted(monkeypatch, known):
    """Each deviance takes some tenths of a second; here a slower drive would fit best."""
    record = drive("iso_b", 50, "ride")
    monkeypatch.setattr(
        drive_check, "_deviance", lambda r, *_: (np.median(r.v), 2.0 * TUNING.doubted_scale, 1)
    )
    notes = check_notes(record, DEFENDER, "paper", speed_known=known)
    assert any("--units v=km/h" in note for note in notes) == (not known)


def kept(stem):
    return read_record(config.folder() / "plants" / f"{stem}.parquet")[0]


@pytest.mark.parametrize("car", ["bmw_320i", "defender_110_coils"])
@pytest.mark.costly
def test_another_programs_side_motion_is_noticed_and_that_of_the_file_is_not(car):
    described = load_vehicle(car)
    (note,) = side_notes(kept(f"commonroad_{car}_iso8608_B_90_17101"), described, "paper")
    assert "sideways 2 times as stiffly" in note and "the mean of the wheel paths is not" in note
    record = kept(f"mujoco_{car}_iso8608_C_36_7101")
    assert side_notes(record, described, "paper") == ()
    front, rear = described.side.C_alpha
    stiff = replace(described, side=replace(described.side, C_alpha=(3.0 * front, 3.0 * rear)))
    assert "sideways 0.5 times as stiffly" in side_notes(record, stiff, "paper")[0]


@pytest.mark.parametrize(("behind", "sought"), [("body", 1), ("description", 2), ("", 2)])
def test_side_motion_that_a_body_hides_is_sought_with_the_described_one(
    behind, sought, monkeypatch
):
    names = []

    def noted(record, car, sensors):
        names.append("description" if car is DEFENDER else "body")
        return ("a note",) if names[-1] == behind else ()

    monkeypatch.setattr(drive_estimates, "with_twist", lambda record, car, sensors: car)
    monkeypatch.setattr(drive_estimates, "with_bending", lambda record, car, _: replace(car))
    monkeypatch.setattr(drive_estimates, "side_notes", noted)
    measured = MeasuredRecord(drive("iso_c", 54.0, "ride", length=20.0))
    file = DriveFile("d", "d", measured, "", DEFENDER, "paper", False, DriveDescription())
    assert with_doubts(file).measured.notes == (("a note",) if behind else ())
    assert len(names) == sought


@pytest.mark.parametrize(("grade", "is_noted"), [("S2", False), ("S4", True)])
@pytest.mark.costly
def test_a_switchable_vehicle_whose_tyres_hold_it_is_noticed(grade, is_noted):
    """Behind its frame and its bending body, which hide it from the described one."""
    record, _ = simulate_record(
        "iso_c", speed_kmh=54, mode={"front": "ride", "rear": "handling"}, seed=501, grade=grade,
        individual=601, length=150.0,
    )  # fmt: skip
    drive = DriveFile(
        "d", "d", MeasuredRecord(record), "", DEFENDER, "paper", False, DriveDescription()
    )
    assert side_notes(record, DEFENDER, "paper") == ()
    notes = " ".join(with_doubts(drive).measured.notes)
    assert ("tyres that hold the vehicle sideways" in notes) == is_noted
    assert ("up to a fifth too low" in notes) == is_noted
