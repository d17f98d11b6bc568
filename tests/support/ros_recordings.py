"""Bags of ROS 2 and MCAP files, generated after their public specifications.

The specifications are named in `road_envs/drives/recordings`; messages are serialised here, so that
other readers (rosbags, mcap-ros2-support) can be asked what they hold.
"""

import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
from phone_recordings import EPOCH, Phone

IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
TWIST = "geometry_msgs/msg/TwistStamped"

HEADER = "std_msgs/Header header\n"
STAMP = "builtin_interfaces/Time stamp\nstring frame_id\n"
RULE = "=" * 80 + "\n"
TIME = f"{RULE}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
COMMON = f"{RULE}MSG: std_msgs/Header\n{STAMP}{TIME}"
VECTOR = f"{RULE}MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
DEFINITIONS = {
    IMU: HEADER + "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
    + COMMON + VECTOR
    + f"{RULE}MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    FIX: HEADER + "sensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\n"
    "float64 altitude\nfloat64[9] position_covariance\nuint8 position_covariance_type\n"
    + COMMON + f"{RULE}MSG: sensor_msgs/NavSatStatus\nint8 status\nuint16 service\n",
    TWIST: HEADER + "geometry_msgs/Twist twist\n" + COMMON + VECTOR
    + f"{RULE}MSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\n"
    "geometry_msgs/Vector3 angular\n",
}  # fmt: skip


class _Cdr:
    """A message in CDR, in either byte order."""

    def __init__(self, order: str):
        self.order, self.data = order, b""

    def put(self, kind: str, *values: float) -> None:
        size = struct.calcsize(f"={kind}")
        self.data += b"\0" * (-len(self.data) % size)
        self.data += struct.pack(f"{self.order}{len(values)}{kind}", *values)

    def header(self, t: float, frame: str) -> None:
        self.put("i", int(t)), self.put("I", round(1e9 * (t % 1.0)) % 10**9)
        self.put("I", len(frame) + 1)
        self.data += frame.encode() + b"\0"

    def bytes(self) -> bytes:
        return (b"\0\1\0\0" if self.order == "<" else b"\0\0\0\0") + self.data


def messages(one: Phone, order: str = "<", frame: str = "imu") -> list[tuple[str, str, int, bytes]]:
    """Return topic, type, time [ns] and bytes of all messages of a drive."""
    found = []
    for t, (x, y, z) in zip(one.t, one.axes, strict=True):
        made = _Cdr(order)
        made.header(EPOCH + t, frame)
        made.put(
            "d", 0.0, 0.0, 0.0, 1.0, *[0.0] * 9, 0.1, 0.2, 0.3, *[0.0] * 9, x, y, z, *[0.0] * 9
        )
        found.append(("/imu/data", IMU, EPOCH + t, made.bytes()))
    for t, lat, lon, v in zip(one.fix_t, one.lat, one.lon, one.v, strict=True):
        made = _Cdr(order)
        made.header(EPOCH + t, "gps")
        made.put("b", 0), made.put("H", 1), made.put("d", lat, lon, 520.0, *[0.0] * 9)
        made.put("B", 0)
        found.append(("/fix", FIX, EPOCH + t + 0.01, made.bytes()))
        made = _Cdr(order)
        made.header(EPOCH + t, "gps")
        made.put("d", 0.6 * v, 0.8 * v, 0.0, 0.0, 0.0, 0.0)
        found.append(("/vel", TWIST, EPOCH + t + 0.02, made.bytes()))
    return [(topic, kind, round(1e9 * t), data) for topic, kind, t, data in found]


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """A file of SQLite whose changes are kept, and which is closed."""
    with closing(sqlite3.connect(path)) as base, base:
        yield base


def write_bag(folder: Path, one: Phone, order: str = "<") -> Path:
    """Write a bag with a file of SQLite; return its folder."""
    folder.mkdir()
    rows = messages(one, order)
    topics = sorted({(topic, kind) for topic, kind, *_ in rows})
    with opened(folder / f"{folder.name}_0.db3") as base:
        base.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT "
            "NULL, serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, "
                     "timestamp INTEGER NOT NULL, data BLOB NOT NULL)")  # fmt: skip
        for k, (topic, kind) in enumerate(topics, 1):
            base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (k, topic, kind))
        number = {topic: k for k, (topic, _) in enumerate(topics, 1)}
        rows.sort(key=lambda row: row[2])
        base.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)",
                         [(number[topic], t, data) for topic, _, t, data in rows])  # fmt: skip
    (folder / "metadata.yaml").write_text(_metadata(folder.name, rows, topics))
    return folder


def _metadata(name: str, rows: list, topics: list) -> str:
    first, last = rows[0][2], rows[-1][2]
    told = "".join(
        f"    - topic_metadata: {{name: {topic}, type: {kind}, serialization_format: cdr, "
        f"offered_qos_profiles: ''}}\n      message_count: {sum(r[0] == topic for r in rows)}\n"
        for topic, kind in topics
    )
    return (
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n"
        f"  duration: {{nanoseconds: {last - first}}}\n"
        f"  starting_time: {{nanoseconds_since_epoch: {first}}}\n"
        f"  message_count: {len(rows)}\n  topics_with_message_count:\n{told}"
        "  compression_format: ''\n  compression_mode: ''\n"
        f"  relative_file_paths: [{name}_0.db3]\n"
        f"  files:\n    - path: {name}_0.db3\n"
        f"      starting_time: {{nanoseconds_since_epoch: {first}}}\n"
        f"      duration: {{nanoseconds: {last - first}}}\n      message_count: {len(rows)}\n"
    )


def write_mcap(path: Path, one: Phone, compression: str = "ZSTD") -> Path:
    """Write an MCAP file with the package mcap."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, chunk_size=50_000, compression=CompressionType[compression])
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, kind, t, data in sorted(messages(one), key=lambda row: row[2]):
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", DEFINITIONS[kind].encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], t, data, t)
        writer.finish()
    return path


def vertical_error(record_t: np.ndarray, a: np.ndarray, one: Phone) -> float:
    """Return the RMS error of a vertical acceleration over the RMS of the truth."""
    inside = (one.t > 0.5) & (one.t < one.t[-1] - 0.5)
    found = np.interp(one.t, record_t, np.nan_to_num(a))
    return float(np.std((found - one.vertical)[inside]) / np.std(one.vertical))
