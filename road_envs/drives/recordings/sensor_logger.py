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
from road_envs.drives.recordings import archive
from road_envs.drives.recordings.recording import Recording, Series

TOTAL, LINEAR, GRAVITY = "TotalAcceleration.csv", "Accelerometer.csv", "Gravity.csv"


def is_sensor_logger(members: Mapping[str, bytes]) -> bool:
    name = archive.find_member(members, TOTAL, LINEAR)
    return name is not None and b"seconds_elapsed" in members[name][:200]


def read_sensor_logger(name: str, members: Mapping[str, bytes]) -> Recording:
    total, gravity = (archive.find_member(members, file) for file in (TOTAL, GRAVITY))
    a, epoch = _axes(total or archive.find_member(members, LINEAR) or LINEAR, members)
    if gravity is not None and total is None:
        g, _ = _axes(gravity, members)
        at = [np.interp(a.t, g.t, x) for x in g.x.T]
        a = Series(a.t, a.x + np.column_stack(at))
    return Recording(
        name=name, acceleration=a, track=_track(members, epoch),
        lacks_gravity=total is None and gravity is None, epoch=epoch, unit_named=False,
    )  # fmt: skip


def _times(table: Mapping, file: str) -> tuple[np.ndarray, float | None]:
    """Return the elapsed times (N,) [s], and the time since 1970 [s] at their zero if known."""
    elapsed = archive.number_column(table, "seconds_elapsed", "time", file)
    since = archive.number_column(table, "time", "time", file)
    if elapsed is None:
        raise ConfigError(f"{file} lacks the column seconds_elapsed; it has {', '.join(table)}")
    if since is None or not since.size or not np.isfinite(since[0] - elapsed[0]):
        return elapsed, None
    return elapsed, float(1e-9 * since[0] - elapsed[0])


def _axes(file: str, members: Mapping[str, bytes]) -> tuple[Series, float | None]:
    table = archive.parse_member(file, members[file])
    t, epoch = _times(table, file)
    if (found := archive.axis_columns(table, "xyz", file)) is None:
        raise ConfigError(f"{file} lacks the columns x, y and z; it has {', '.join(table)}")
    return Series(t, found), epoch


def _track(members: Mapping[str, bytes], zero: float | None) -> Series | None:
    if (file := archive.find_member(members, "Location.csv", "LocationGps.csv")) is None:
        return None
    table = archive.parse_member(file, members[file])
    t, epoch = _times(table, file)
    if zero is not None and epoch is not None:
        t = t + (epoch - zero)
    track = archive.track_columns(table, t, "speed", file)[np.argsort(t, kind="stable")]
    track.x[track.x[:, 2] < 0.0, 2] = np.nan
    return track
