"""MCAP files, bags of ROS 2, MDF files with groups, and folders are read as they come."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from phone_recordings import gpx, phone, sample
from phone_recordings import table as write_table
from ros_recordings import IMU, messages, opened, vertical_error, write_bag, write_mcap
from scipy.spatial.transform import Rotation

from road_envs.core.config import ConfigError
from road_envs.drives.reading import read_drive, read_drives, read_passes
from road_envs.drives.recordings.ros import MCAP_MAGIC

CAR = {"vehicle": "bmw_320i"}
ONE = phone(Rotation.from_euler("zxy", [20.0, 35.0, 10.0], degrees=True), duration=20.0)


def check(drive, one=ONE):
    record = drive.measured.record
    assert vertical_error(record.t, record.a[0], one) < 0.06
    assert record.s[-1] - record.s[0] == pytest.approx(
        np.trapezoid(np.interp(one.t, one.fix_t, one.v), one.t), rel=0.03
    )
    assert drive.measured.position is not None


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_bag_of_ros_2_is_read_and_so_is_its_file(tmp_path, order):
    folder = write_bag(tmp_path / "bag", ONE, order)
    first = read_drive(folder, **CAR)
    check(first)
    second = read_drive(folder / "bag_0.db3", **CAR)
    np.testing.assert_array_equal(first.measured.record.a, second.measured.record.a)


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_an_mcap_file_is_read(tmp_path, compression):
    pytest.importorskip("mcap"), pytest.importorskip("lz4"), pytest.importorskip("zstandard")
    check(read_drive(write_mcap(tmp_path / "d.mcap", ONE, compression), **CAR))


def test_other_readers_find_the_same_in_the_samples(tmp_path):
    rosbags = pytest.importorskip("rosbags.highlevel")
    rosbags_types = pytest.importorskip("rosbags.typesys")
    pytest.importorskip("mcap_ros2")
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found = []
    types = rosbags_types.get_typestore(rosbags_types.Stores.ROS2_HUMBLE)
    bag = write_bag(tmp_path / "bag", ONE)
    with rosbags.AnyReader([bag], default_typestore=types) as reader:
        for connection, _, data in reader.messages():
            if connection.msgtype == IMU:
                a = reader.deserialize(data, IMU).linear_acceleration
                found.append((a.x, a.y, a.z))
    np.testing.assert_array_equal(np.array(found), ONE.axes)
    with write_mcap(tmp_path / "d.mcap", ONE).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = reader.iter_decoded_messages(topics=["/imu/data"])
        told = [message.linear_acceleration for *_, message in decoded]
    np.testing.assert_array_equal([(a.x, a.y, a.z) for a in told], ONE.axes)


def test_the_inertial_unit_with_most_messages_is_taken_and_a_note_says_so(tmp_path):
    folder = write_bag(tmp_path / "bag", ONE)
    with opened(folder / "bag_0.db3") as base:
        base.execute(f"INSERT INTO topics VALUES (9, '/other', '{IMU}', 'cdr', '')")
        data = messages(ONE)[0][3]
        base.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (9, 1, ?)", (data,))
    drive = read_drive(folder, **CAR)
    assert any("/imu/data; left out: /other" in note for note in drive.measured.notes)
    check(drive)


def _sql(path, *statements):
    with opened(path) as base:
        for statement in statements:
            base.execute(statement)


LOOP = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x FROM c) SELECT x FROM c"


@pytest.mark.parametrize(
    ("statements", "message"),
    [
        (["CREATE TABLE a(b)"], "a file of SQLite that is no bag of ROS 2: it has a tables"),
        ([f"CREATE VIEW messages AS {LOOP}", f"CREATE VIEW topics AS {LOOP}"], "has no tables"),
        (["CREATE TABLE topics(id)", "CREATE TABLE messages(id)"], "no such column"),
    ],
)
def test_a_file_of_sqlite_that_is_no_bag_is_refused(tmp_path, statements, message):
    _sql(tmp_path / "d.db3", *statements)
    with pytest.raises(ConfigError, match=message):
        read_drives(tmp_path / "d.db3", **CAR)


@pytest.mark.parametrize(
    ("cut", "message"),
    [(lambda x: x[:200], "ends before its fields do"), (lambda x: b"\1" + x, "plain CDR"),
     (lambda x: x[:12] + struct.pack("<I", 2**31) + x[16:], "ends before its fields do")],
)  # fmt: skip
def test_a_damaged_message_is_refused(tmp_path, cut, message):
    folder = write_bag(tmp_path / "bag", ONE)
    with opened(folder / "bag_0.db3") as base:
        query = "SELECT id, data FROM messages WHERE length(data) > 300"
        number, data = base.execute(query).fetchone()
        base.execute("UPDATE messages SET data = ? WHERE id = ?", (cut(data), number))
    with pytest.raises(ConfigError, match=message):
        read_drives(folder, **CAR)


def test_a_damaged_mcap_file_is_refused_in_one_sentence(tmp_path):
    pytest.importorskip("mcap"), pytest.importorskip("zstandard")
    whole = write_mcap(tmp_path / "d.mcap", ONE).read_bytes()
    rng = np.random.default_rng(1)
    for k in range(40):
        data = bytearray(whole[: int(rng.integers(8, len(whole)))] if k % 2 else whole)
        for at in rng.integers(8, len(data), 20):
            data[at] = int(rng.integers(256))
        (tmp_path / "e.mcap").write_bytes(bytes(data))
        try:
            read_drives(tmp_path / "e.mcap", **CAR)
        except ConfigError as error:
            assert "e.mcap" in str(error) and "\n" not in str(error)
    bomb = MCAP_MAGIC + b"\x06" + struct.pack("<Q", 60) + struct.pack("<QQQI", 0, 1, 2**40, 0)
    (tmp_path / "e.mcap").write_bytes(bomb + struct.pack("<I", 4) + b"zstd" + b"\0" * 30)
    with pytest.raises(ConfigError, match="a chunk of 1048576 MiB"):
        read_drives(tmp_path / "e.mcap", **CAR)


def test_a_folder_of_a_table_and_a_track_is_one_drive(tmp_path):
    folder = tmp_path / "drive"
    folder.mkdir()
    x, y, z = ONE.axes.T
    samples = zip(ONE.t, x, y, z, strict=True)
    rows = "\n".join(f"{t:.4f},{a:.6f},{b:.6f},{c:.6f}" for t, a, b, c in samples)
    (folder / "acc.csv").write_text(f"time,acc_x [m/s2],acc_y [m/s2],acc_z [m/s2]\n{rows}\n")
    fixes = zip(ONE.fix_t, ONE.lat, ONE.lon, ONE.v, strict=True)
    rows = "\n".join(",".join(f"{q:.8f}" for q in row) for row in fixes)
    (folder / "gps.csv").write_text(f"time,lat,lon,speed [m/s]\n{rows}\n")
    (folder / "device.csv").write_text("property,value\nversion,1\n")
    check(read_drive(folder, **CAR))
    assert [d.name for d in read_passes([folder], **CAR)] == ["drive"]


def test_a_folder_of_drives_is_read_drive_by_drive(tmp_path):
    for name, seed in (("a", 1), ("b", 2)):
        one = phone(Rotation.identity(), duration=20.0, seed=seed)
        (tmp_path / f"{name}.csv").write_bytes(write_table(one))
    (tmp_path / "notes.md").write_text("none of it")
    assert [d.name for d in read_passes([tmp_path], **CAR)] == ["a", "b"]


def test_an_mdf_file_with_groups_of_three_rates_is_read(tmp_path):
    mdf = pytest.importorskip("asammdf")
    with mdf.MDF(version="4.10") as file:
        axes = zip("xyz", ONE.axes.T, strict=True)
        file.append([mdf.Signal(a, ONE.t, name=f"acc_{k}", unit="m/s²") for k, a in axes])
        fine = np.arange(0.0, ONE.fix_t[-1], 0.1)
        v = 3.6 * np.interp(fine, ONE.fix_t, ONE.v)
        file.append(mdf.Signal(v, fine + 0.003, name="speed", unit="km/h"))
        file.append([mdf.Signal(x, ONE.fix_t + 0.007, name=k)
                     for k, x in (("lat", ONE.lat), ("lon", ONE.lon))])  # fmt: skip
        file.save(tmp_path / "d.mf4")
    check(read_drive(tmp_path / "d.mf4", **CAR))


def test_a_bag_without_accelerations_says_what_it_has(tmp_path):
    folder = write_bag(tmp_path / "bag", replace(ONE, t=ONE.t[:0], axes=ONE.axes[:0]))
    with pytest.raises(ConfigError, match="no message of sensor_msgs/msg/Imu"):
        read_drives(folder, **CAR)
    (tmp_path / "x.gpx").write_bytes(gpx(sample()))
