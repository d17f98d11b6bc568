"""Recordings of Sensor Logger (Kelvin Choi): a zip file or a folder of one CSV for each sensor.

After the app's public notes on its export (https://github.com/tszheichoi/awesome-sensor-logger):
columns `time` [ns since 1970], `seconds_elapsed` [s], then the axes in the order z, y, x.
`TotalAcceleration.csv` includes gravity; `Accelerometer.csv` does not, and its sum with
`Gravity.csv` is the same. `Location.csv` has `speed` [m/s], below 0 where it is not known,
`latitude` and `longitude` [°]. Phones of both makes differ in the sign of all three axes, which
does not matter here, as the direction of gravity is found from the recording.
"""

from collections.abc import Mapping

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.drives.recordings.archive import (
    axis_columns,
    find_member,
    number_column,
    parse_member,
    track_columns,
)
from road_envs.drives.recordings.recording import Recording, Series

TOTAL, LINEAR, GRAVITY = "TotalAcceleration.csv", "Accelerometer.csv", "Gravity.csv"


def is_sensor_logger(members: Mapping[str, bytes]) -> bool:
    name = find_member(members, TOTAL, LINEAR)
    return name is not None and b"seconds_elapsed" in members[name][:200]


def read_sensor_logger(name: str, members: Mapping[str, bytes]) -> Recording:
    lacks = False
    if file := find_member(members, TOTAL):
        a, epoch = _axes(file, members)
    else:
        a, epoch = _axes(find_member(members, LINEAR) or LINEAR, members)
        lacks = (file := find_member(members, GRAVITY)) is None
        if file is not None:
            gravity, _ = _axes(file, members)
            at = [np.interp(a.t, gravity.t, x) for x in gravity.x.T]
            a = Series(a.t, a.x + np.column_stack(at))
    track = _track(members, epoch)
    return Recording(
        name=name, acceleration=a, track=track, lacks_gravity=lacks,
        epoch=epoch, unit_named=False,
    )  # fmt: skip


def _times(table: Mapping, file: str) -> tuple[np.ndarray, float]:
    """Return the elapsed times (N,) [s], and the time since 1970 [s] at their zero."""
    elapsed = number_column(table, "seconds_elapsed", "time", file)
    since = number_column(table, "time", "time", file)
    if elapsed is None:
        raise ConfigError(f"{file} lacks the column seconds_elapsed; it has {', '.join(table)}")
    if since is None or not since.size or not np.isfinite(since[0] - elapsed[0]):
        return elapsed, np.nan
    return elapsed, float(1e-9 * since[0] - elapsed[0])


def _axes(file: str, members: Mapping[str, bytes]) -> tuple[Series, float | None]:
    table = parse_member(file, members[file])
    t, epoch = _times(table, file)
    if (found := axis_columns(table, "xyz", file)) is None:
        raise ConfigError(f"{file} lacks the columns x, y and z; it has {', '.join(table)}")
    return Series(t, found), None if np.isnan(epoch) else epoch


def _track(members: Mapping[str, bytes], zero: float | None) -> Series | None:
    if (file := find_member(members, "Location.csv", "LocationGps.csv")) is None:
        return None
    table = parse_member(file, members[file])
    t, epoch = _times(table, file)
    if zero is not None and np.isfinite(epoch):
        t = t + (epoch - zero)
    track = track_columns(table, t, "speed", file)[np.argsort(t, kind="stable")]
    track.x[track.x[:, 2] < 0.0, 2] = np.nan
    return track
