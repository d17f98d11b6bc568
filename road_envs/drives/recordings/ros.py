"""Recordings of ROS 2: an inertial unit, a satellite receiver, and a speed, in MCAP files and bags.

Messages are serialised by CDR (OMG "DDS Interoperability Wire Protocol" 2.2, clause 10, as
`rosidl_typesupport_fastrtps` writes it): four bytes that name the byte order, then the fields, each
aligned to its own size behind these four. The fields are those of docs.ros.org: `sensor_msgs/Imu`,
whose `linear_acceleration` includes gravity, `sensor_msgs/NavSatFix`, and
`geometry_msgs/TwistStamped` (of which the magnitude of the velocity is used).

An MCAP file (https://mcap.dev/spec) has the messages in chunks, each unpacked alone; those of
ROS 1, JSON and Protobuf are not read. A bag is a folder with `metadata.yaml` and files of SQLite or
MCAP, or one of these files. After the "rosbag2 storage" documents of
https://github.com/ros2/rosbag2 a file of SQLite has the tables `topics` (id, name, type,
serialization_format) and `messages` (topic_id, timestamp, data).
"""

import itertools
import sqlite3
import struct
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import
from road_envs.drives.recordings.recording import Recording, Series

IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
TWIST = "geometry_msgs/msg/TwistStamped"
MOST_MESSAGES = 20_000_000  # most messages of a recording: 14 hours at 400 Hz
NO_FIX = -1  # status of a fix that is none
MCAP_MAGIC, SQLITE_MAGIC = b"\x89MCAP0\r\n", b"SQLite format 3\x00"  # first bytes of the files
MAX_CHUNK = 2**28  # most bytes of a chunk when unpacked; writers make chunks of 1 to 8 MiB
MAX_MESSAGE = 2**16  # most bytes of a message that is read; one of an inertial unit has some 350

_Message = tuple[str, str, bytes]  # topic, type (one of DECODERS) and serialised fields


class _Fields:
    """Fields of a message in their order."""

    def __init__(self, data: bytes):
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise ConfigError("a message that is not serialised by plain CDR")
        self._data, self._at, self._order = data, 4, "<>"[data[1] == 0]

    def numbers(self, kind: str, count: int = 1) -> tuple:
        """Return `count` numbers of a format of `struct`."""
        size = struct.calcsize(f"={kind}")
        self._at += -(self._at - 4) % size
        try:
            values = struct.unpack_from(f"{self._order}{count}{kind}", self._data, self._at)
        except struct.error:
            raise ConfigError("a message that ends before its fields do") from None
        self._at += size * count
        return values

    def header(self) -> float:
        """Return the time stamp [s] of a header, and skip the name of its frame."""
        (seconds,), (nanoseconds,) = self.numbers("i"), self.numbers("I")
        (length,) = self.numbers("I")
        self._at += length
        return seconds + 1e-9 * nanoseconds


def _imu(fields: _Fields) -> tuple[float, ...]:
    """Return the linear acceleration [m/s²] behind the header."""
    fields.numbers("d", 4 + 9 + 3 + 9)  # orientation and angular velocity, with covariances
    return fields.numbers("d", 3)


def _fix(fields: _Fields) -> tuple[float, ...]:
    """Return the row of a track behind the header: latitude and longitude [°], NaN without fix."""
    (status,), _ = fields.numbers("b"), fields.numbers("H")
    lat, lon = (np.nan, np.nan) if status <= NO_FIX else fields.numbers("d", 2)
    return lat, lon, np.nan, np.nan


def _twist(fields: _Fields) -> tuple[float, ...]:
    """Return the row of a track behind the header: the magnitude of the velocity [m/s]."""
    return np.nan, np.nan, float(np.linalg.norm(fields.numbers("d", 3))), np.nan


DECODERS = {IMU: _imu, FIX: _fix, TWIST: _twist}  # types of messages that are read


def _to_recording(name: str, messages: Iterable[_Message]) -> Recording:
    """Return the recording in messages; of several inertial units that with most of them."""
    rows: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(list)
    for k, (topic, kind, data) in enumerate(messages):
        if k >= MOST_MESSAGES:
            raise ConfigError(f"more than {MOST_MESSAGES} messages: cut the recording")
        fields = _Fields(data)
        rows[kind, topic].append((fields.header(), *DECODERS[kind](fields)))
    units = {topic: values for (kind, topic), values in rows.items() if kind == IMU}
    if not units:
        others = ", ".join(sorted({kind for kind, _ in rows})) or "none that is read"
        raise ConfigError(
            f"no message of {IMU}, which holds accelerations of three axes (its messages: {others})"
        )
    chosen = max(units, key=lambda topic: len(units[topic]))
    left = ", ".join(sorted(set(units) - {chosen}))
    note = f"the accelerations are those of the topic {chosen}; left out: {left}"
    a = _in_order(units[chosen])
    zero = float(a[0, 0])
    parts = [_in_order(values) for (kind, _), values in rows.items() if kind != IMU]
    track = _merged(np.concatenate(parts), zero) if parts else None
    return Recording(
        name=name, acceleration=Series(a[:, 0] - zero, a[:, 1:]), track=track,
        epoch=zero, notes=(note,) if left else (),
    )  # fmt: skip


def _merged(x: np.ndarray, zero: float) -> Series:
    """Return rows (N, 5) of several topics as one track; those of the same time are one row."""
    t, row = np.unique(np.round(x[:, 0] - zero, 6), return_inverse=True)
    found = np.full((t.size, x.shape[1] - 1), np.nan)
    for k, values in enumerate(x[:, 1:].T):
        known = np.isfinite(values)
        found[row[known], k] = values[known]
    return Series(t, found)


def _in_order(rows: list[tuple[float, ...]]) -> np.ndarray:
    """Return rows (N, K) by their time: messages are stored in the order of their arrival."""
    x = np.array(rows)
    return x[np.argsort(x[:, 0], kind="stable")]


def _mcap_messages(path: Path) -> Iterator[_Message]:
    """Yield the messages of DECODERS in an MCAP file. Raises ConfigError."""
    with optional_import("an MCAP file"):
        from mcap.exceptions import McapError
        from mcap.records import Channel, Chunk, Message, Schema
        from mcap.stream_reader import StreamReader, breakup_chunk

    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    other, found = set[str](), False

    def records(file: Any) -> Iterator[Any]:
        for record in StreamReader(file, emit_chunks=True, record_size_limit=MAX_CHUNK).records:
            if isinstance(record, Chunk):
                record.data, record.compression = _unpacked(record), ""
                yield from breakup_chunk(record)
            else:
                yield record

    with path.open("rb") as file:
        try:
            for record in records(file):
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    kind = schemas.get(record.schema_id, "")
                    if record.message_encoding == "cdr" and kind in DECODERS:
                        channels[record.id] = (record.topic, kind)
                    else:
                        other.add(f"{kind or 'no type'} ({record.message_encoding})")
                elif isinstance(record, Message) and record.channel_id in channels:
                    found = True
                    yield *channels[record.channel_id], record.data
        except McapError as error:
            raise ConfigError(f"a damaged MCAP file: {error or type(error).__name__}") from None
    if not found:
        raise ConfigError(
            f"no message that is read ({', '.join(DECODERS)}, serialised by CDR); the file has "
            f"{', '.join(sorted(other)) or 'none'}"
        )


def _unpacked(chunk: Any) -> bytes:
    """Return the bytes of a chunk: those that it states, at most MAX_CHUNK. Raises ConfigError."""
    size = chunk.uncompressed_size
    if size > MAX_CHUNK:
        raise ConfigError(f"a chunk of {size / 2**20:.0f} MiB; at most {MAX_CHUNK >> 20} are read")
    if not chunk.compression:
        return chunk.data
    with optional_import("a compressed MCAP file"):
        import lz4.frame
        import zstandard

    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(chunk.data) as stream:
            data = stream.read(size)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size)
    else:
        raise ConfigError(f"a chunk that is compressed by {chunk.compression[:20]!r}")
    if len(data) != size:
        raise ConfigError(f"a chunk of {len(data)} bytes that states {size}")
    return data


def is_bag(folder: Path) -> bool:
    return (folder / "metadata.yaml").is_file() and bool(_files(folder) or _packed(folder))


def read_ros(path: Path) -> Recording:
    """Return the recording in an MCAP file, a bag, or a file of a bag. Raises ConfigError."""
    if not path.is_dir():
        return _to_recording(path.stem, _messages(path))
    if packed := _packed(path):
        raise ConfigError(
            f"{packed[0].name} is compressed as a whole: unpack it (zstd -d), or write the bag "
            "anew with ros2 bag convert"
        )
    return _to_recording(path.name, itertools.chain.from_iterable(map(_messages, _files(path))))


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix in (".db3", ".mcap"))


def _packed(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.db3.zstd")) + sorted(folder.glob("*.mcap.zstd"))


def _messages(path: Path) -> Iterator[_Message]:
    with path.open("rb") as file:
        is_mcap = path.suffix == ".mcap" or file.read(8) == MCAP_MAGIC
    return _mcap_messages(path) if is_mcap else _sqlite_messages(path)


def _sqlite_messages(path: Path) -> Iterator[_Message]:
    kinds = ", ".join(f"'{kind}'" for kind in DECODERS)
    query = (
        "SELECT topics.name, topics.type, messages.data FROM messages JOIN topics "
        f"ON messages.topic_id = topics.id WHERE topics.type IN ({kinds}) "
        f"AND topics.serialization_format = 'cdr' AND length(messages.data) < {MAX_MESSAGE}"
    )
    kind_of = "SELECT name FROM sqlite_master WHERE type = 'table'"  # a view could run forever
    uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as base:
            tables = {name for (name,) in base.execute(kind_of)}
            if not {"topics", "messages"} <= tables:
                raise ConfigError(
                    f"a file of SQLite that is no bag of ROS 2: it has {', '.join(tables) or 'no'} "
                    "tables, not topics and messages"
                )
            for topic, kind, data in base.execute(query):
                yield str(topic), str(kind), bytes(data)
    except sqlite3.Error as error:
        raise ConfigError(f"no readable bag of ROS 2: {error}") from None
