"""Choice of the reader of a file: recognised by its content, without options.

| file | reader |
|---|---|
| zip file or folder of phyphox | `phyphox.py` |
| zip file or folder of Sensor Logger | `sensor_logger.py` |
| VBOX (`.vbo`) | `vbox.py` |
| GPX, as a track beside another file | `gpx.py` |
| JSON lines | `json_lines.py` |
| text, Parquet, MDF4 | `road_envs/drives/logger_tables/table.py` |
"""

from pathlib import Path

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.core.reading import parsing
from road_envs.drives.logger_tables.channels import Channels, Findings
from road_envs.drives.logger_tables.clock import read_clock
from road_envs.drives.logger_tables.description import DriveDescription
from road_envs.drives.logger_tables.table import MAX_BYTES, Table, read_table
from road_envs.drives.recordings import (
    archive,
    axes,
    gpx,
    json_lines,
    phyphox,
    sensor_logger,
    vbox,
)
from road_envs.drives.recordings.recording import Recording, Series

READ = (
    "zip files and folders of phyphox and Sensor Logger, tables (CSV and other text, Parquet, "
    "MDF4, JSON lines), VBOX (.vbo), and GPX as --track"
)
"""What is read, in words."""

HEAD = 20_000
"""Bytes by which a file is recognised."""


def read_source(path: Path, description: DriveDescription) -> Recording | Table:
    """Return the recording in a file or folder, or the table if it has no three axes.

    Raises ConfigError.
    """
    with parsing(path, ConfigError, "no readable recording"):
        if path.is_dir() or archive.is_zip(path):
            return _of_members(path)
        with path.open("rb") as file:
            head = file.read(HEAD)
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


def _of_members(path: Path) -> Recording:
    members = archive.read_members(path)
    if phyphox.is_phyphox(members):
        return phyphox.read_phyphox(path.stem, members)
    if sensor_logger.is_sensor_logger(members):
        return sensor_logger.read_sensor_logger(path.stem, members)
    kind = "a folder" if path.is_dir() else "an archive"
    shown = ", ".join(list(members)[:6]) + (", ..." if len(members) > 6 else "")
    raise ConfigError(f"{kind} of no app that is known ({shown or 'empty'}); read are {READ}")


def _table(path: Path, head: bytes) -> Table:
    is_vbo, is_json = vbox.is_vbo(head), json_lines.is_json(head)
    if not (is_vbo or is_json):
        try:
            return read_table(path)
        except ConfigError as error:
            raise ConfigError(str(error).removeprefix(f"{path}: ")) from None
    if (size := path.stat().st_size) > MAX_BYTES:
        raise ConfigError(f"{size / 2**20:.0f} MiB; at most {MAX_BYTES / 2**20:.0f} MiB are read")
    data = path.read_bytes()
    return vbox.parse_vbo(data) if is_vbo else json_lines.parse_json(data)


def read_track(path: Path) -> tuple[Series, float | None]:
    """Return the track (N, 4) of a GPX file or a table, and the epoch of its zero, if known.

    Raises ConfigError.
    """
    with parsing(path, ConfigError, "no readable track"):
        if path.is_dir():
            raise ConfigError("a track is a GPX file or a table, not a folder")
        with path.open("rb") as file:
            head = file.read(HEAD)
        if gpx.is_gpx(head):
            return gpx.parse_gpx(path.read_bytes())
        table = _table(path, head)
        findings = Findings()
        channels = Channels(table, DriveDescription(), findings)
        clock = read_clock(channels, findings)
        names = ("lat", "lon", "v", "s")
        columns = [channels.numbers(key) if key in channels else None for key in names]
        findings.raise_problems()
        assert clock is not None
        if all(x is None for x in columns):
            raise ConfigError(f"a track without positions and speed; {channels.list_columns()}")
        nothing = np.full(clock.t.size, np.nan)
        x = np.column_stack([nothing if c is None else c for c in columns])
        return Series(clock.t, x), clock.epoch
