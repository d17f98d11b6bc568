"""Bags of ROS 2: a folder with `metadata.yaml` and files of SQLite or MCAP, or one of these files.

After the "rosbag2 storage" documents of https://github.com/ros2/rosbag2: a file of SQLite has the
tables `topics` (id, name, type, serialization_format) and `messages` (topic_id, timestamp, data).
"""

import itertools
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from road_envs.core.config import ConfigError
from road_envs.drives.recordings.mcap import mcap_messages
from road_envs.drives.recordings.recording import Recording
from road_envs.drives.recordings.ros_messages import KINDS, RosMessage, to_recording

MAGIC = b"SQLite format 3\x00"
MAX_MESSAGE = 2**16
"""Most bytes of a message that is read; one of an inertial unit has some 350."""


def is_sqlite(head: bytes) -> bool:
    """Whether a file begins as a file of SQLite does."""
    return head.startswith(MAGIC)


def is_bag(folder: Path) -> bool:
    """Whether a folder is a bag of ROS 2."""
    return (folder / "metadata.yaml").is_file() and bool(_files(folder) or _packed(folder))


def read_rosbag(path: Path) -> Recording:
    """Return the recording in a bag, or in one of its files. Raises ConfigError."""
    if path.is_dir() and _packed(path):
        raise ConfigError(
            f"{_packed(path)[0].name} is compressed as a whole: unpack it (zstd -d), or write the "
            "bag anew with ros2 bag convert"
        )
    files = _files(path) if path.is_dir() else [path]
    name = path.name if path.is_dir() else path.stem
    messages = (_of_sqlite(p) if p.suffix != ".mcap" else mcap_messages(p) for p in files)
    return to_recording(name, "ROS 2 bag", itertools.chain.from_iterable(messages))


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix in (".db3", ".mcap"))


def _packed(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.db3.zstd")) + sorted(folder.glob("*.mcap.zstd"))


def _of_sqlite(path: Path) -> Iterator[RosMessage]:
    kinds = ", ".join(f"'{kind}'" for kind in KINDS)
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
                yield RosMessage(str(topic), str(kind), bytes(data))
    except sqlite3.Error as error:
        raise ConfigError(f"no readable bag of ROS 2: {error}") from None
