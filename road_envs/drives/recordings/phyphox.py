"""Recordings of phyphox: a zip file or a folder of one CSV file for each sensor.

After the export that the app's file format describes (https://phyphox.org/wiki, "Phyphox file
format", and the files `meta/time.csv` and `meta/device.csv`): `Accelerometer.csv` with "Time (s)"
and "X (m/s^2)" to "Z (m/s^2)", or `Raw Data.csv` with "Acceleration x (m/s^2)" and so on; "Linear"
accelerations are without gravity. `Location.csv` has "Latitude (°)", "Longitude (°)" and
"Velocity (m/s)". Times are those of the experiment, which stand still while it is paused;
`meta/time.csv` has a row START or PAUSE with the time of the experiment and the system's [s since
1970] for each.
"""

from collections.abc import Mapping

from road_envs.core.config import ConfigError
from road_envs.drives.recordings import archive
from road_envs.drives.recordings.recording import Recording, Series

AXES = ("", "Acceleration ", "Linear Acceleration ")  # names of columns before x, y and z
WITH_GRAVITY = ("Accelerometer.csv", "Acceleration.csv", "Raw Data.csv")
LINEAR = ("Linear Accelerometer.csv", "Linear Acceleration.csv")


def is_phyphox(members: Mapping[str, bytes]) -> bool:
    name = archive.find_member(members, *WITH_GRAVITY, *LINEAR)
    return name is not None and b"Time (s)" in members[name][:200]


def read_phyphox(name: str, members: Mapping[str, bytes]) -> Recording:
    file = archive.find_member(members, *WITH_GRAVITY) or archive.find_member(members, *LINEAR)
    assert file is not None
    table = archive.parse_member(file, members[file])
    t = archive.number_column(table, "Time", "time", file)
    for before in AXES:
        if (a := archive.axis_columns(table, [before + axis for axis in "xyz"], file)) is not None:
            break
    if t is None or a is None:
        raise ConfigError(f"{file} lacks the columns X, Y and Z; it has {', '.join(table)}")
    location = archive.find_member(members, "Location.csv", "GPS.csv")
    epoch, breaks = _events(members)
    return Recording(
        name=name,
        acceleration=Series(t, a),
        track=None if location is None else _track(location, members[location]),
        lacks_gravity="Linear" in before or file.rsplit("/", 1)[-1] in LINEAR,
        epoch=epoch,
        breaks=breaks,
    )


def _track(file: str, data: bytes) -> Series | None:
    table = archive.parse_member(file, data)
    t = archive.number_column(table, "Time", "time", file)
    return None if t is None else archive.track_columns(table, t, "Velocity", file)


def _events(members: Mapping[str, bytes]) -> tuple[float | None, tuple[float, ...]]:
    """Return the time since 1970 at the zero of the experiment, and its times of pauses [s]."""
    if (file := archive.find_member(members, "time.csv")) is None:
        return None, ()
    table = archive.parse_member(file, members[file])
    t = archive.number_column(table, "experiment time", "time", file)
    system = archive.number_column(table, "system time", "time", file)
    events = [str(x).strip().upper() for x in table.get("event", ())]
    if t is None or system is None or len(events) != t.size or not t.size:
        return None, ()
    pauses = tuple(float(x) for x, kind in zip(t[:-1], events[:-1], strict=True) if kind == "PAUSE")
    return float(system[0] - t[0]), pauses
