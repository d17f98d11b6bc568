"""Messages of ROS 2 as a recording: an inertial unit, a satellite receiver, and a speed.

Messages are serialised by CDR (OMG "DDS Interoperability Wire Protocol" 2.2, clause 10, as
`rosidl_typesupport_fastrtps` writes it): four bytes that name the byte order, then the fields, each
aligned to its own size behind these four. The fields are those of docs.ros.org: `sensor_msgs/Imu`,
whose `linear_acceleration` includes gravity, `sensor_msgs/NavSatFix`, and
`geometry_msgs/TwistStamped` (of which the magnitude of the velocity is used).
"""

import struct
from collections import defaultdict
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.drives.recordings.recording import Recording, Series

IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
TWIST = "geometry_msgs/msg/TwistStamped"
KINDS = (IMU, FIX, TWIST)
"""Types of messages that are read."""

MOST_MESSAGES = 20_000_000
"""Most messages of a recording: 14 hours at 400 Hz."""

NO_FIX = -1
"""Status of a fix that is none."""


class RosMessage(NamedTuple):
    """One serialised message of a type `kind` of KINDS, on a `topic`."""

    topic: str
    kind: str
    data: bytes


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


def _imu(data: bytes) -> tuple[float, ...]:
    """Return time [s] and linear acceleration [m/s²]; three 3 x 3 covariances lie between."""
    fields = _Fields(data)
    t = fields.header()
    fields.numbers("d", 4 + 9 + 3 + 9)  # orientation and angular velocity, with covariances
    return t, *fields.numbers("d", 3)


def _fix(data: bytes) -> tuple[float, ...]:
    """Return time [s], latitude and longitude [°], NaN without a fix."""
    fields = _Fields(data)
    t = fields.header()
    (status,), _ = fields.numbers("b"), fields.numbers("H")
    lat, lon = fields.numbers("d", 2)
    return (t, np.nan, np.nan) if status <= NO_FIX else (t, lat, lon)


def _twist(data: bytes) -> tuple[float, ...]:
    """Return time [s] and the magnitude of the linear velocity [m/s]."""
    fields = _Fields(data)
    return fields.header(), float(np.linalg.norm(fields.numbers("d", 3)))


DECODERS = {IMU: _imu, FIX: _fix, TWIST: _twist}


def to_recording(name: str, app: str, messages: Iterable[RosMessage]) -> Recording:
    """Return the recording in messages; of several inertial units that with most of them.

    Raises ConfigError.
    """
    rows: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(list)
    for k, message in enumerate(messages):
        if k >= MOST_MESSAGES:
            raise ConfigError(f"more than {MOST_MESSAGES} messages: cut the recording")
        rows[message.kind, message.topic].append(DECODERS[message.kind](message.data))
    units = {topic: values for (kind, topic), values in rows.items() if kind == IMU}
    if not units:
        others = ", ".join(sorted({kind for kind, _ in rows})) or "none that is read"
        raise ConfigError(
            f"no message of {IMU}, which holds accelerations of three axes (its messages: {others})"
        )
    chosen = max(units, key=lambda topic: len(units[topic]))
    notes: tuple[str, ...] = ()
    if len(units) > 1:
        left = ", ".join(sorted(set(units) - {chosen}))
        notes = (f"the accelerations are those of the topic {chosen}; left out: {left}",)
    a = _in_order(units[chosen])
    zero = float(a[0, 0])
    parts = [_track(values, kind, zero) for (kind, _), values in rows.items() if kind != IMU]
    track = _merged(np.concatenate(parts)) if parts else None
    return Recording(
        name=name, app=app, acceleration=Series(a[:, 0] - zero, a[:, 1:]), track=track,
        epoch=zero, notes=notes,
    )  # fmt: skip


def _merged(x: np.ndarray) -> Series:
    """Return rows (N, 5) of several topics as one track; those of the same time are one row."""
    t, row = np.unique(np.round(x[:, 0], 6), return_inverse=True)
    found = np.full((t.size, x.shape[1] - 1), np.nan)
    for k, values in enumerate(x[:, 1:].T):
        known = np.isfinite(values)
        found[row[known], k] = values[known]
    return Series(t, found)


def _in_order(rows: list[tuple[float, ...]]) -> np.ndarray:
    """Return rows (N, K) by their time: messages are stored in the order of their arrival."""
    x = np.array(rows)
    return x[np.argsort(x[:, 0], kind="stable")]


def _track(rows: list[tuple[float, ...]], kind: str, zero: float) -> np.ndarray:
    """Return time, latitude, longitude, speed and odometer (N, 5), NaN where not known."""
    x = _in_order(rows)
    found = np.full((len(x), 5), np.nan)
    found[:, 0] = x[:, 0] - zero
    found[:, (1, 2) if kind == FIX else (3,)] = x[:, 1:]
    return found
