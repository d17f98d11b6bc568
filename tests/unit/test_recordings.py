"""Recordings of phones and loggers are read as they come; mounts and tilts are found."""

import io
import re
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from phone_recordings import EPOCH, FOLDER, SAMPLES, _zip, gpx, phone, phyphox_members, sample
from phone_recordings import sensor_logger as write_sensor_logger
from phone_recordings import table as write_table
from scipy.spatial.transform import Rotation

from road_envs.core.config import ConfigError
from road_envs.drives.mount import level
from road_envs.drives.reading import read_drive, read_drives
from road_envs.drives.recordings.recording import Recording, Series

CAR = {"vehicle": "bmw_320i"}
DRIVES = [name for name in SAMPLES if name != "drive.gpx"]
TILT = Rotation.from_euler("zxy", [20.0, 35.0, 10.0], degrees=True)


def recording(one, **changes):
    track = Series(one.fix_t, np.column_stack([one.lat, one.lon, one.v, np.nan * one.v]))
    made = Recording(name="x", acceleration=Series(one.t, one.axes), track=track)
    return replace(made, **changes)


def error_of(found, one):
    """RMS error of the vertical acceleration over the RMS of the truth, where it was found."""
    known = np.isfinite(found.vertical)
    assert known.mean() > 0.8
    return np.std((found.vertical - one.vertical)[known]) / np.std(one.vertical)


@pytest.mark.parametrize("name", DRIVES)
def test_a_recording_is_read_without_options(name):
    """The samples are one drive in each format: the vertical acceleration is that of the drive."""
    one, drive = sample(), read_drive(FOLDER / name, **CAR)
    record = drive.measured.record
    assert record.channels == ("PHONE",) and drive.sensors == "phone"
    a = np.interp(one.t, record.t, np.nan_to_num(record.a[0]))
    inside = (one.t > 0.5) & (one.t < one.t[-1] - 0.5)
    assert np.corrcoef(a[inside], one.vertical[inside])[0, 1] > 0.98
    assert np.std(a[inside]) == pytest.approx(np.std(one.vertical[inside]), rel=0.05)
    assert record.s[-1] - record.s[0] == pytest.approx(np.trapezoid(
        12.0 + 4.0 * np.sin(2 * np.pi * one.t / 23.0), one.t), rel=0.03)  # fmt: skip
    assert any("degrees from the vertical" in note for note in drive.measured.notes)
    assert drive.measured.position == pytest.approx(
        np.array([np.interp(record.t, one.fix_t, x) for x in (one.lat, one.lon)]), abs=2e-4
    )


def _split(text):
    """The words between the numbers of a text, and the numbers."""
    pattern = r"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?"
    return re.split(pattern, text), np.array(re.findall(pattern, text), dtype=float)


@pytest.mark.parametrize("name", SAMPLES)
def test_the_samples_are_those_of_their_generators(name):
    kept, made = (FOLDER / name).read_bytes(), SAMPLES[name](sample())
    assert len(kept) == pytest.approx(len(made), rel=0.05)
    if not name.endswith((".zip", ".parquet")):  # compressed differently by other versions
        # the texts are the same and the numbers to rounding, which depends on the processor
        texts, numbers = zip(
            *(_split(x.decode(errors="replace")) for x in (kept, made)), strict=True
        )
        assert texts[0] == texts[1]
        np.testing.assert_allclose(numbers[0], numbers[1], rtol=1e-9, atol=1e-12)


def test_the_two_parts_of_an_acceleration_are_added_and_a_folder_is_read_as_its_archive(tmp_path):
    one = phone(TILT, duration=20.0)
    (tmp_path / "a.zip").write_bytes(write_sensor_logger(one, total=False))
    shutil.unpack_archive(tmp_path / "a.zip", tmp_path / "b")
    first, second = (read_drive(tmp_path / name, **CAR).measured for name in ("a.zip", "b"))
    np.testing.assert_array_equal(first.record.a, second.record.a)
    assert np.std(first.record.a) == pytest.approx(np.std(one.vertical), rel=0.05)


@pytest.mark.parametrize("seed", range(20))
def test_twenty_mounts_and_tilts_give_the_vertical_acceleration(seed):
    """Any rotation of the phone: an error of 5 % of the acceleration is less of the IRI."""
    one = phone(Rotation.random(random_state=seed), seed=seed)
    found = level(recording(one))
    assert error_of(found, one) < 0.05
    (mount,) = found.mounts
    true_up = one.rotation.apply([0.0, 0.0, 1.0])
    angle = np.arccos(np.clip(mount.up @ true_up, -1.0, 1.0))
    assert angle < max(4.0 * mount.tilt_std, np.radians(1.5))


@pytest.mark.parametrize("seed", range(5))
def test_without_a_track_the_mount_is_found_from_the_mean(seed):
    one = phone(Rotation.random(random_state=seed), seed=seed)
    found = level(recording(one, track=None))
    assert error_of(found, one) < 0.1


def test_a_phone_that_moves_in_its_mount_is_noticed_and_each_part_is_turned_upright():
    one = phone(TILT)
    other = Rotation.from_euler("x", 25.0, degrees=True) * TILT
    late = one.t > 33.0
    axes = np.where(late[:, None], other.apply(TILT.inv().apply(one.axes)), one.axes)
    found = level(recording(one, acceleration=Series(one.t, axes)))
    assert "moved in its mount at 3" in found.notes[0] and len(found.mounts) == 2
    assert error_of(found, one) < 0.05


def test_a_phone_that_lies_still_has_not_moved():
    notes = [level(recording(phone(TILT, seed=seed))).notes for seed in range(10)]
    assert not any("moved" in note for one in notes for note in one)


def test_a_loose_phone_is_refused():
    one = phone(TILT, duration=120.0)
    angles = 30.0 * np.sign(np.sin(2 * np.pi * one.t / 33.0))
    swing = Rotation.from_euler("x", angles[:, None], degrees=True)
    with pytest.raises(ConfigError, match="turned in its mount 5 times or more: it is loose"):
        level(recording(one, acceleration=Series(one.t, swing.apply(one.axes))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a / 9.80665, "magnitude of 1.00?., where gravity is"),
        (lambda a: 1.3 * a, "where gravity is 9.81 m/s² or 1 g: check their unit"),
        (lambda a: a - a.mean(axis=0), "they are without gravity"),
    ],
)  # fmt: skip
def test_accelerations_without_plausible_gravity_are_refused(change, message):
    one = phone(TILT)
    with pytest.raises(ConfigError, match=message):
        level(recording(one, acceleration=Series(one.t, change(one.axes))))


def test_a_unit_that_is_not_named_follows_from_gravity(tmp_path):
    one = phone(TILT, duration=20.0)
    (tmp_path / "g.csv").write_bytes(write_table(replace(one, axes=one.axes / 9.80665)))
    drive = read_drive(tmp_path / "g.csv", **CAR)
    assert np.std(drive.measured.record.a) == pytest.approx(np.std(one.vertical), rel=0.05)
    assert any("are read as g" in note for note in drive.measured.notes)


def test_axes_of_linear_acceleration_come_after_those_with_gravity_in_either_order(tmp_path):
    one = phone(TILT, duration=20.0)
    frame = pd.read_csv(io.BytesIO(write_table(one)))
    up = TILT.apply([0.0, 0.0, 9.80665])
    for name, part in zip("XYZ", up, strict=True):
        frame.insert(1, f"LINEAR ACCELERATION {name} (m/s²)", frame[f"acc_{name.lower()}"] - part)
    frame.columns = [c.replace("acc_", "ACCELEROMETER ") for c in frame.columns]
    for k, columns in enumerate((list(frame), list(frame)[::-1])):
        frame[columns].to_csv(tmp_path / f"{k}.csv", index=False)
        found = read_drive(tmp_path / f"{k}.csv", **CAR).measured
        assert np.std(found.record.a) == pytest.approx(np.std(one.vertical), rel=0.05)


def test_pauses_part_a_recording_into_named_drives(tmp_path):
    one = phone(TILT, duration=60.0)
    (tmp_path / "d.zip").write_bytes(_zip(phyphox_members(one, pauses=(25.0,))))
    drives = read_drives(tmp_path / "d.zip", **CAR)
    assert [drive.name for drive in drives] == ["d_1", "d_2"]
    spans = [drive.measured.record.t[-1] for drive in drives]
    assert spans == pytest.approx([25.0, 35.0], abs=0.1)
    assert all("split at its pauses into 2 drives" in d.measured.notes[1] for d in drives)
    with pytest.raises(ConfigError, match="holds 2 drives"):
        read_drive(tmp_path / "d.zip", **CAR)


def test_a_gap_of_the_clock_parts_a_recording_too(tmp_path):
    one = phone(TILT, duration=40.0)
    t = one.t + 100.0 * (one.t > 15.0)
    late = replace(one, t=t, fix_t=one.fix_t + 100.0 * (one.fix_t > 15.0))
    (tmp_path / "d.csv").write_bytes(write_table(late))
    assert len(read_drives(tmp_path / "d.csv", **CAR)) == 2


def test_standing_before_the_drive_is_left_out(tmp_path):
    one = phone(TILT, duration=40.0)
    still = replace(one, v=np.where(one.fix_t < 14.0, 0.0, one.v))
    (tmp_path / "d.csv").write_bytes(write_table(still))
    drive = read_drive(tmp_path / "d.csv", **CAR)
    assert drive.measured.record.t[-1] == pytest.approx(28.0, abs=1.1)
    assert any("12 s of standing" in note for note in drive.measured.notes)


def test_a_late_first_fix_is_not_taken_for_standing(tmp_path):
    one = phone(TILT, duration=40.0)
    fixes = {
        key: np.where(one.fix_t < 6.0, np.nan, getattr(one, key)) for key in ("lat", "lon", "v")
    }
    (tmp_path / "d.csv").write_bytes(write_table(replace(one, **fixes)))
    notes = read_drive(tmp_path / "d.csv", **CAR).measured.notes
    assert any("no speed is known in the first 4.5 s" in note for note in notes)
    assert not any("standing" in note for note in notes)


def test_units_and_columns_of_a_table_with_axes_are_applied_once(tmp_path):
    one, path = phone(TILT, duration=20.0, speed=15.0), tmp_path / "d.csv"
    axes = {f"a{axis}": x / 9.80665 for axis, x in zip("xyz", one.axes.T, strict=True)}
    v = np.full(one.t.size, 54.0)
    pd.DataFrame({"Zeit": 1e3 * one.t, **axes, "Geschw": v}).to_csv(path, index=False)
    given = {"t": "ms", "v": "km/h", "a_phone": "g"}
    drive = read_drive(path, columns={"t": "Zeit", "v": "Geschw"}, units=given, **CAR)
    record = drive.measured.record
    assert record.v == pytest.approx(15.0) and record.t[-1] == pytest.approx(20.0, abs=0.02)
    assert np.std(record.a) == pytest.approx(np.std(one.vertical), rel=0.05)
    pd.DataFrame({"Zeit": 1e3 * one.t, **axes}).to_csv(path, index=False)
    pd.DataFrame({"Zeit": 1e3 * one.t, "Geschw": v}).to_csv(tmp_path / "v.csv", index=False)
    named = {"columns": {"t": "Zeit", "v": "Geschw"}, "units": given}
    with pytest.raises(ConfigError, match="there is no column 'Geschw' for v"):
        read_drive(path, **named, **CAR)
    (tmp_path / "d.zip").write_bytes(_zip(phyphox_members(one)))
    with pytest.raises(ConfigError, match="names its columns and units itself"):
        read_drive(tmp_path / "d.zip", units={"v": "km/h"}, **CAR)
    pd.DataFrame({"t": one.t, **axes}).to_csv(path, index=False)
    pd.DataFrame({"t": one.t, "speed": v}).to_csv(tmp_path / "v.csv", index=False)
    drive = read_drive(path, track=tmp_path / "v.csv", units={"v": "km/h"}, **CAR)
    assert drive.measured.record.v == pytest.approx(15.0)
    pd.DataFrame({"t": one.t, "speed": v / 3.6}).to_csv(tmp_path / "v.csv", index=False)
    drive = read_drive(path, track=tmp_path / "v.csv", **CAR)
    assert any("speed has no unit" in note for note in drive.measured.notes)


def test_a_speed_without_a_unit_or_of_0_is_told(tmp_path):
    one, path = phone(TILT, duration=20.0, speed=15.0), tmp_path / "d.csv"
    axes = {f"a{axis}": x for axis, x in zip("xyz", one.axes.T, strict=True)}
    for speed, is_told in (("speed", True), ("speed [m/s]", False), ("v", False)):
        pd.DataFrame({"t": one.t, **axes, speed: 15.0 + 0.0 * one.t}).to_csv(path, index=False)
        notes = read_drive(path, **CAR).measured.notes
        assert any("has no unit: it is read as m/s" in note for note in notes) == is_told
    pd.DataFrame({"t": one.t, **axes, "v": 0.0 * one.t}).to_csv(path, index=False)
    with pytest.raises(ConfigError, match="the speed is 0 in all rows"):
        read_drive(path, **CAR)


def test_a_track_of_another_file_is_joined_by_time(tmp_path):
    one = phone(TILT, duration=30.0)
    members = {k: x for k, x in phyphox_members(one).items() if k != "Location.csv"}
    (tmp_path / "d.zip").write_bytes(_zip(members))
    with pytest.raises(ConfigError, match=r"--track FILE\.gpx"):
        read_drive(tmp_path / "d.zip", **CAR)
    (tmp_path / "t.gpx").write_bytes(gpx(one))
    drive = read_drive(tmp_path / "d.zip", track=tmp_path / "t.gpx", **CAR)
    assert any("t.gpx, joined by the time since 1970" in x for x in drive.measured.notes)
    truth = one.lat[10] + 0.5 * (one.lat[11] - one.lat[10])
    record = drive.measured.record
    begin = one.t[-1] - record.t[-1]
    found = np.interp(10.5 - begin, record.t, drive.measured.position[0])
    assert abs(found - truth) < 3e-5 or begin > 0.0
    later = gpx(replace(one, fix_t=one.fix_t + 3600.0))
    (tmp_path / "t.gpx").write_bytes(later)
    with pytest.raises(ConfigError, match="overlap by 0 s"):
        read_drive(tmp_path / "d.zip", track=tmp_path / "t.gpx", **CAR)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("d.zip", _zip({"../../etc/x.csv": "a"}), "a path that leaves its folder"),
        ("d.zip", _zip({"x.csv": "0" * 40_000_000}), "times as large when unpacked"),
        ("d.zip", _zip({"inner.zip": "PK"}), "archives inside an archive are not opened"),
        ("d.zip", _zip({"notes.csv": "a,b\n1,2\n"}), "an archive of no app that is known"),
        ("d.zip", _zip({f"{k}.csv": "" for k in range(2001)}), "at most 2000 are read"),
        ("d.zip", b"PK\x03\x04" + b"\x00" * 60, "a damaged zip file"),
        ("d.gpx", gpx(sample()), "a track without accelerations"),
        ("d.vbo", b"[header]\n[column names]\ntime lat\n[data]\n1 2 3\n", "has 3 values for 2"),
        ("d.jsonl", b'{"a": 1}\n[2]\n', "line 2 is no JSON object"),
        ("d.jsonl", b'{"a": 1}\n{"a"', "no readable JSON lines"),
    ],
)  # fmt: skip
def test_a_hostile_recording_is_refused_in_one_sentence(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=message) as error:
        read_drives(path, **CAR)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t": "jump"}, "jumps back by 4.99 s after sample 1201"),
        ({"lat": np.nan}, "no value for|speed is missing"),
    ],
)
def test_clocks_that_jump_and_coordinates_that_are_nan(tmp_path, change, message):
    one = phone(TILT, duration=30.0)
    if change.get("t"):
        one = replace(one, t=one.t - 5.0 * (one.t > 12.0))
    else:
        one = replace(one, lat=one.lat * np.nan, lon=one.lon * np.nan, v=one.v * np.nan)
    (tmp_path / "d.zip").write_bytes(_zip(phyphox_members(one)))
    with pytest.raises(ConfigError, match=message):
        read_drives(tmp_path / "d.zip", **CAR)


def test_a_vehicle_and_a_known_place_are_asked_for():
    with pytest.raises(ConfigError, match="say which vehicle was driven: --vehicle"):
        read_drive(FOLDER / "phyphox.zip")
    with pytest.raises(ConfigError, match="none of dashboard, floor, seat, trunk, bumper"):
        read_drive(FOLDER / "phyphox.zip", at="roof", **CAR)
    drive = read_drive(FOLDER / "phyphox.zip", at="-0.4,0.3", **CAR)
    assert drive.measured.record.sensors["PHONE"].y == 0.3
    assert EPOCH > 0 and drive.description.at == "-0.4,0.3"
