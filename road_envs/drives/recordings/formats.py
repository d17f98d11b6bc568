"""Choice of the reader of a file: recognised by its content, without options.

| file | reader |
|---|---|
| zip file or folder of phyphox | `phyphox.py` |
| zip file or folder of Sensor Logger | `sensor_logger.py` |
| zip file or folder of one table with three axes and one with the track | `formats.py` |
| VBOX (`.vbo`) | `vbox.py` |
| MCAP; bag of ROS 2, a folder or its file of SQLite | `ros.py` |
| GPX, as a track beside another file | `gpx.py` |
| JSON lines | `json_lines.py` |
| text, Parquet, MDF4 | `road_envs/drives/logger_tables/table.py` |
"""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from road_envs.core.config import ConfigError
from road_envs.core.reading import parsing
from road_envs.drives.logger_tables.channels import Channels
from road_envs.drives.logger_tables.clock import read_clock
from road_envs.drives.logger_tables.description import QUANTITIES, DriveDescription
from road_envs.drives.logger_tables.table import Table, read_table, read_text
from road_envs.drives.recordings import archive, axes, gpx, json_lines, phyphox, ros, sensor_logger
from road_envs.drives.recordings.recording import Recording, Track, make_track
from road_envs.drives.recordings.vbox import is_vbo, parse_vbo
from road_envs.records.units import split_header

READ = (
    "zip files and folders of phyphox and Sensor Logger, or of a table with three axes and one "
    "with the track; tables (CSV and other text, Parquet, MDF4, JSON lines), VBOX (.vbo), MCAP and "
    "bags of ROS 2, and GPX as --track"
)

# ends of the names of files in a folder of several drives
SUFFIXES = ".csv .txt .zip .parquet .mf4 .mdf .vbo .json .jsonl .mcap .db3".split()
HEAD = 20_000  # bytes by which a file is recognised


def read_source(path: Path, description: DriveDescription) -> Recording | Table:
    """Return the recording in a file or folder, or a table without axes. Raises ConfigError."""
    with parsing(path, ConfigError, "no readable recording"):
        if path.is_dir() and ros.is_bag(path):
            return ros.read_ros(path)
        if path.is_dir() or archive.is_zip(path):
            return _of_members(path, description)
        with path.open("rb") as file:
            head = file.read(HEAD)
        if head.startswith((ros.MCAP_MAGIC, ros.SQLITE_MAGIC)):
            return ros.read_ros(path)
        if gpx.is_gpx(head):
            raise ConfigError(
                "a GPX file has a track without accelerations: give it beside those "
                "(--track FILE.gpx)"
            )
        table = _table(path, head)
    if (found := axes.find_axes(table, description)) is None:
        return table
    with parsing(path, ConfigError, "no readable recording"):
        return axes.to_recording(path.stem, table, found, description)


def drives_in(path: Path) -> list[Path]:
    """Return the files and folders of drives that a folder holds; a path that is one drive, alone.

    One are a folder of an app, a bag of ROS 2, and a table with its track. Raises ConfigError.
    """
    if not path.is_dir() or ros.is_bag(path):
        return [path]
    inside = sorted(p for p in path.iterdir() if not p.name.startswith("."))
    if any(map(_is_app_folder, inside)):
        return [p for p in inside if _is_app_folder(p) or p.suffix.lower() in SUFFIXES]
    with parsing(path, ConfigError, "no readable folder"):
        members = archive.read_members(path)
        if _is_app(members) or _table_and_track(path.name, members, DriveDescription()):
            return [path]
    return [p for p in inside if p.is_file() and p.suffix.lower() in SUFFIXES] or [path]


def _is_app_folder(folder: Path) -> bool:
    """Whether a folder is the export of an app, or a bag of ROS 2."""
    if not folder.is_dir():
        return False
    with parsing(folder, ConfigError, "no readable folder"):
        return ros.is_bag(folder) or _is_app(archive.read_members(folder))


def _is_app(members: Mapping[str, bytes]) -> bool:
    return phyphox.is_phyphox(members) or sensor_logger.is_sensor_logger(members)


def _of_members(path: Path, description: DriveDescription) -> Recording:
    members = archive.read_members(path)
    if phyphox.is_phyphox(members):
        return phyphox.read_phyphox(path.stem, members)
    if sensor_logger.is_sensor_logger(members):
        return sensor_logger.read_sensor_logger(path.stem, members)
    if found := _table_and_track(path.stem, members, description):
        return found
    kind = "a folder" if path.is_dir() else "an archive"
    shown = ", ".join(list(members)[:6]) + (", ..." if len(members) > 6 else "")
    raise ConfigError(f"{kind} of no app that is known ({shown or 'empty'}); read are {READ}")


def _table_and_track(
    name: str, members: Mapping[str, bytes], description: DriveDescription
) -> Recording | None:
    """Return the recording in one table with three axes, with the track of another if it has none.

    None if the members are others; tables that cannot be read are left out. Raises ConfigError.
    """
    tables: dict[str, Table] = {}
    for member, data in members.items():
        if member.lower().endswith((".csv", ".txt")):
            with suppress(ConfigError):
                tables[member] = archive.parse_member(member, data)
    with_axes = {m: found for m, x in tables.items() if (found := axes.find_axes(x, description))}
    if len(with_axes) != 1:
        return None
    ((member, found),) = with_axes.items()
    recording = axes.to_recording(name, tables.pop(member), found, description)
    for other, table in tables.items() if recording.track is None else ():
        if (track := _track_of(table, description)) is not None:
            return recording.with_track(track, other)
    return recording if recording.track is not None else None


def _table(path: Path, head: bytes) -> Table:
    if is_vbo(head):
        return parse_vbo(read_text(path))
    return json_lines.parse_json(read_text(path)) if json_lines.is_json(head) else read_table(path)


def read_track(path: Path, description: DriveDescription) -> Track:
    """Return the track in a GPX file or a table. Raises ConfigError."""
    with parsing(path, ConfigError, "no readable track"):
        if path.is_dir():
            raise ConfigError("a track is a GPX file or a table, not a folder")
        with path.open("rb") as file:
            head = file.read(HEAD)
        if gpx.is_gpx(head):
            return gpx.parse_gpx(read_text(path))
        table = _table(path, head)
        if (found := _track_of(table, description)) is None:
            raise ConfigError(
                f"a track without a time, positions or speed; the table has {', '.join(table)}"
            )
        return found


def _track_of(table: Table, description: DriveDescription) -> Track | None:
    """Return the track in a table; None if there is none.

    Of the columns that are described it has some; others are those of the accelerations.
    """
    headers = {h.lower() for h in table} | {split_header(h)[0].lower() for h in table}
    named = {q: x for q, x in description.columns.items() if x.strip().lower() in headers}
    named, known = (
        {q: x for q, x in given.items() if q in QUANTITIES} for given in (named, description.units)
    )
    channels = Channels(table, DriveDescription(columns=named, units=known))
    names = ("lat", "lon", "v", "s")
    if "t" not in channels or not any(name in channels for name in names):
        return None
    clock, columns = read_clock(channels), [channels.numbers(name) for name in names]
    channels.findings.raise_problems()
    assert clock is not None
    return Track(make_track(clock.t, *columns), clock.epoch, tuple(channels.findings.notes))
