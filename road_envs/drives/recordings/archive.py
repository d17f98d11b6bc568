"""Zip files and folders of recording apps, bounded whatever they claim, and tables in them."""

import io
import posixpath
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.core.reading import parsing
from road_envs.drives.logger_tables.table import Table, by_header, numeric_values, parse_text
from road_envs.drives.recordings.recording import Series, make_track
from road_envs.records import units

MAX_MEMBERS = 2000  # most files of an archive or a folder
MAX_UNPACKED = 2**29  # most bytes of all files together: an hour of six sensors at 400 Hz

MAX_RATIO, RATIO_FREE = 100, 2**20
"""Largest ratio of unpacked to packed bytes (3 to 10 of tables), of more than RATIO_FREE bytes."""

ZIP = b"PK\x03\x04"  # first bytes of a zip file
READ = (".csv", ".json", ".txt", ".gpx")  # ends of the names of members that are read


def is_zip(path: Path) -> bool:
    """Whether a file begins as a zip file does, and is no spreadsheet of one."""
    with path.open("rb") as file:
        if file.read(4) != ZIP:
            return False
    try:
        with zipfile.ZipFile(path) as archive:
            return "[Content_Types].xml" not in archive.namelist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError, OSError):
        return True  # damaged, or of a kind that zipfile does not read: `read_members` refuses it


def read_members(path: Path) -> Mapping[str, bytes]:
    """Return the tables in a zip file or a folder, by their path below the common folder.

    A damaged archive may raise an exception of any class: call it inside `parsing`.
    """
    members = _of_folder(path) if path.is_dir() else _of_zip(path.read_bytes())
    names = [PurePosixPath(name) for name in members]
    # apps put everything into one folder named after the recording, or into none
    common = posixpath.commonpath([name.parent for name in names] or [PurePosixPath()])
    names = [name.relative_to(common) for name in names]
    return dict(zip(map(str, names), members.values(), strict=True))


def _of_folder(folder: Path) -> dict[str, bytes]:
    files = [p for p in sorted(folder.rglob("*")) if p.suffix.lower() in READ]
    files = [p for p in files if p.is_file() and not p.is_symlink()]
    if len(files) > MAX_MEMBERS:
        raise ConfigError(f"a folder of {len(files)} tables; at most {MAX_MEMBERS} are read")
    _check_total(sum(p.stat().st_size for p in files))
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


def _of_zip(data: bytes) -> dict[str, bytes]:
    try:
        opened = zipfile.ZipFile(io.BytesIO(data))
    except zipfile.BadZipFile as error:
        raise ConfigError(f"a damaged zip file: {error}") from None
    with opened as archive:
        members = [m for m in archive.infolist() if not m.is_dir()]
        if len(members) > MAX_MEMBERS:
            raise ConfigError(f"an archive of {len(members)} files; at most {MAX_MEMBERS} are read")
        for name in (member.filename for member in members):
            inside = PurePosixPath(name.replace("\\", "/")).parts
            if ".." in inside or name.startswith(("/", "\\")) or ":" in name[:3]:
                raise ConfigError(f"the archive holds {name[:80]!r}, a path that leaves its folder")
        wanted = [m for m in members if PurePosixPath(m.filename).suffix.lower() in READ]
        wanted = [m for m in wanted if not m.filename.startswith("__MACOSX/")]
        if not wanted:
            nested = any(m.filename.lower().endswith(".zip") for m in members)
            hint = "; archives inside an archive are not opened: unpack it" if nested else ""
            raise ConfigError(f"an archive without tables ({', '.join(READ)}){hint}")
        _check_total(sum(m.file_size for m in wanted))
        for m in wanted:
            if m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ConfigError(f"{m.filename} is compressed by another method than deflate")
            if m.flag_bits & 1:
                raise ConfigError(f"{m.filename} is encrypted: unpack the archive")
            if m.file_size > max(RATIO_FREE, MAX_RATIO * m.compress_size):
                raise ConfigError(
                    f"{m.filename} is more than {MAX_RATIO} times as large when unpacked: no "
                    "recording"
                )
        # at most the stated size is unpacked: `read` ends there and compares the checksum
        return {m.filename: archive.read(m) for m in wanted}


def _check_total(size: int) -> None:
    if size > MAX_UNPACKED:
        raise ConfigError(
            f"{size / 2**20:.0f} MiB of tables; at most {MAX_UNPACKED / 2**20:.0f} MiB are read: "
            "cut the recording into shorter drives"
        )


def parse_member(name: str, data: bytes) -> Table:
    """Return the table in the bytes of a member. Raises ConfigError naming the member."""
    with parsing(name, ConfigError, "no readable table"):
        return by_header(parse_text(data))


def number_column(table: Table, wanted: str, kind: str, member: str) -> np.ndarray | None:
    """Return the column whose header is `wanted` but for case and unit, in SI units (N,), if any.

    Raises ConfigError.
    """
    for header in table:
        name, unit = units.split_header(header)
        if name.lower() == wanted.lower():
            try:
                x = numeric_values(table[header])
                return x * (units.factor(kind, unit) if unit else 1.0)
            except ValueError as error:
                raise ConfigError(f"{member}, column {header}: {error}") from None
    return None


def axis_columns(table: Table, axes: Iterable[str], member: str) -> np.ndarray | None:
    """Return the accelerations (N, 3) [m/s²] in the columns of three `axes`; None if one lacks."""
    found = [number_column(table, axis, "acceleration", member) for axis in axes]
    known = [x for x in found if x is not None]
    return np.column_stack(known) if len(known) == len(found) else None


def track_columns(table: Table, t: np.ndarray, speed: str, member: str) -> Series:
    """Return the track at the times `t` (N,) [s]: positions, and the column `speed`."""
    lat, lon = (number_column(table, key, "angle", member) for key in ("latitude", "longitude"))
    return make_track(t, lat, lon, number_column(table, speed, "speed", member))


def find_member(members: Mapping[str, bytes], *names: str) -> str | None:
    """Return the first member of one of these names, without case and folder; None if none is."""
    by_name = {path.rsplit("/", 1)[-1].lower(): path for path in sorted(members, reverse=True)}
    return next((by_name[name.lower()] for name in names if name.lower() in by_name), None)
