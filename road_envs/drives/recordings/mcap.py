"""MCAP files (https://mcap.dev/spec): messages of ROS 2 in chunks, of which each is unpacked alone.

Messages of ROS 1, JSON and Protobuf are not read. A chunk states its size when unpacked; no more
than that, and no more than MAX_CHUNK, is unpacked.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from road_envs.core.config import ConfigError
from road_envs.core.extras import optional_import
from road_envs.drives.recordings.recording import Recording
from road_envs.drives.recordings.ros_messages import KINDS, RosMessage, to_recording

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK = 2**28
"""Most bytes of a chunk when unpacked; writers make chunks of 1 to 8 MiB."""


def is_mcap(head: bytes) -> bool:
    """Whether a file begins as an MCAP file does."""
    return head.startswith(MAGIC)


def read_mcap(path: Path) -> Recording:
    """Return the recording in an MCAP file. Raises ConfigError."""
    return to_recording(path.stem, "MCAP", mcap_messages(path))


def mcap_messages(path: Path) -> Iterator[RosMessage]:
    """Yield the messages of KINDS in an MCAP file. Raises ConfigError."""
    with optional_import("an MCAP file"):
        from mcap.exceptions import McapError
        from mcap.records import Channel, Chunk, Message, Schema
        from mcap.stream_reader import StreamReader, breakup_chunk

    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    other: set[str] = set()

    def records(file: Any) -> Iterator[Any]:
        for record in StreamReader(file, emit_chunks=True, record_size_limit=MAX_CHUNK).records:
            if isinstance(record, Chunk):
                record.data, record.compression = _unpacked(record), ""
                yield from breakup_chunk(record)
            else:
                yield record

    found = False
    with path.open("rb") as file:
        try:
            for record in records(file):
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    kind = schemas.get(record.schema_id, "")
                    if record.message_encoding == "cdr" and kind in KINDS:
                        channels[record.id] = (record.topic, kind)
                    else:
                        other.add(f"{kind or 'no type'} ({record.message_encoding})")
                elif isinstance(record, Message) and record.channel_id in channels:
                    found = True
                    yield RosMessage(*channels[record.channel_id], record.data)
        except McapError as error:
            raise ConfigError(f"a damaged MCAP file: {error or type(error).__name__}") from None
    if not found:
        raise ConfigError(
            f"no message that is read ({', '.join(KINDS)}, serialised by CDR); the file has "
            f"{', '.join(sorted(other)) or 'none'}"
        )


def _unpacked(chunk: Any) -> bytes:
    """Return the bytes of a chunk, at most those that it states. Raises ConfigError."""
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
